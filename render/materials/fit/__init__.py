"""Fitting the library: measured reflectance in, material files out."""
