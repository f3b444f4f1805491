"""Meshes as Mitsuba scenes; the only module that touches Mitsuba's mesh parameters, which 3.10 renames."""

import numpy as np

from render import variant
from render.shapes.mesh import TriangleMesh

mi = variant.load()


def build_mesh(mesh: TriangleMesh, bsdf: dict | None = None) -> "mi.Mesh":
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


def build(mesh: TriangleMesh) -> "mi.Scene":
    """Return a scene that holds only `mesh`: all that `render.many_lights` traces rays against."""
    return mi.load_dict({"type": "scene", "object": build_mesh(mesh)})
