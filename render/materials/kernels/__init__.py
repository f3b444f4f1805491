"""Reflectance inside Dr.Jit kernels, and as Mitsuba BSDF plugins."""
