"""Surface reflectance: one tabulated analytic model, the library of fitted materials and their Mitsuba plugin."""
