"""Sculpture: one shape family, a file per kind of figure."""
