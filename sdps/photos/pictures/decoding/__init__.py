"""Decoders of picture files: pixels as they are, and what the file says of them."""
