"""Textured materials inside Dr.Jit kernels: patterns with derivatives, maps, relief, and their reflectance."""
