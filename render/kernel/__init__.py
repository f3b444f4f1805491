"""From rays to images: all lights of a view in one kernel, and the slow reference."""
