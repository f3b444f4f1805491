"""Refinement by inverse rendering: normals, lights and reflectance of an object, until they explain its photographs."""
