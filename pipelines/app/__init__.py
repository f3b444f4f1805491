"""`sdps app`: local web pages for photographs, scenes and data."""
