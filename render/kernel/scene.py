"""Meshes as Mitsuba scenes; the only module that touches Mitsuba's mesh parameters, which 3.10 renames."""

from typing import Any, NamedTuple

import numpy as np

from render.backend.arrays import integers, table
from render.backend.jit import dr, mi
from render.shapes.geometry.mesh import TriangleMesh


class Triangles(NamedTuple):
    """Corners of N triangles: positions and vertex normals, object frame."""

    positions: tuple  # 3 Point3f (N)
    normals: tuple  # 3 Vector3f (N)


class Scene:
    """One object, ready to be hit by rays.

    Args:
        mesh: Object in the unit sphere.
    """

    def __init__(self, mesh: TriangleMesh) -> None:
        self.mesh = mesh
        self._scene = mi.load_dict({"type": "scene", "object": build_mesh(mesh)})
        self._corners: tuple | None = None

    def ray_intersect(self, ray: Any, coherent: bool) -> tuple:
        """Return the surface interaction with its shading frame, and the barycentric coordinates (u, v) of the hit."""
        hit = self._scene.ray_intersect_preliminary(ray, coherent)
        return hit.compute_surface_interaction(ray, +mi.RayFlags.ShadingFrame), hit.prim_uv

    def ray_test(self, ray: Any, coherent: bool, active: Any = True) -> "mi.Bool":
        """Return which rays meet the object."""
        return self._scene.ray_test(ray, coherent, active)

    def triangles(self, prim: "mi.UInt32") -> Triangles:
        """Return the triangles of the given numbers."""
        if self._corners is None:
            self._corners = (table(self.mesh.vertices), table(self.mesh.normals), integers(self.mesh.faces))
        vertices, normals, faces = self._corners
        corners = [dr.gather(mi.UInt32, faces, 3 * prim + k) for k in range(3)]
        return Triangles(
            tuple(dr.gather(mi.Point3f, vertices, corner) for corner in corners),
            tuple(dr.gather(mi.Vector3f, normals, corner) for corner in corners),
        )


def build_mesh(mesh: TriangleMesh, bsdf: dict[str, Any] | None = None) -> "mi.Mesh":
    """Turn a triangle mesh into a Mitsuba mesh with its vertex normals.

    Args:
        mesh: Object in the unit sphere.
        bsdf: Mitsuba BSDF description; Mitsuba's diffuse default when omitted.
    """
    properties = mi.Properties()
    if bsdf is not None:
        properties["bsdf"] = mi.load_dict(bsdf)
    shape = mi.Mesh("object", len(mesh.vertices), len(mesh.faces), has_vertex_normals=True, props=properties)
    parameters = mi.traverse(shape)
    parameters["vertex_positions"] = mi.Float(np.ascontiguousarray(mesh.vertices, np.float32).ravel())
    parameters["vertex_normals"] = mi.Float(np.ascontiguousarray(mesh.normals, np.float32).ravel())
    parameters["faces"] = mi.UInt32(np.ascontiguousarray(mesh.faces, np.uint32).ravel())
    parameters.update()
    return shape


def build(mesh: TriangleMesh) -> Scene:
    """Return a scene that holds only `mesh`: all that `render.kernel.many_lights` traces rays against."""
    return Scene(mesh)
