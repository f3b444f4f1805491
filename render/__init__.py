"""Physically based rendering of photometric-stereo scenes with Mitsuba 3.

Importing this package loads neither mitsuba nor torch; `render.variant.load` does when first needed.
"""
