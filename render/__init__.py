"""Physically based rendering of photometric-stereo scenes with Mitsuba 3.

Importing this package loads neither mitsuba nor torch; `render.backend.variant.load` does when first needed.
"""
