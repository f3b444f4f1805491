"""Textured materials: the procedural family by name, folders of maps, and the reflectance model they drive."""
