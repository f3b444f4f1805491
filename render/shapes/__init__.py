"""Shapes to render: seeded families, the test's sphere and bunny, and meshes from files."""

from render.shapes.geometry.mesh import TriangleMesh
from render.shapes.registry import families, load

__all__ = ["TriangleMesh", "families", "load"]
