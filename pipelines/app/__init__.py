"""`sdps app`: a local page for photographs, scenes and data."""
