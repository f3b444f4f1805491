"""Trained networks applied to images, a few at a time."""
