"""Trained weights into the package, and the tables of what they do."""
