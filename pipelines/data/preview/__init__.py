"""What `preview.html` of a data folder shows: a sample of its scenes, plots, and the page."""
