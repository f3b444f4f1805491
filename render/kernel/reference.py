"""The slow, obvious renderer: Mitsuba's own `path` integrator, one light at a time.

`render.kernel.many_lights` is compared with it, statistically in the tests and in time by `make bench`.
"""

from collections.abc import Iterator
from typing import Any

import numpy as np

from render.backend.jit import mi
from render.kernel.scene import build_mesh
from render.materials.kernels import surface_bsdf
from render.records.manifest import View
from render.shapes.geometry.mesh import TriangleMesh

_DIRECTIONAL = {"type": "directional", "direction": [0, 0, -1], "irradiance": {"type": "rgb", "value": np.pi}}
_POINT = {"type": "point", "position": [0, 0, 9], "intensity": {"type": "rgb", "value": 1.0}}


def scene_dict(
    mesh: TriangleMesh,
    view: View,
    material: str,
    size: int,
    spp: int,
    bounces: int,
    shape: str | None = None,
    near: bool = False,
) -> dict[str, Any]:
    """Describe the scene for `mi.load_dict`: the view's camera, box filter, one emitter, directional or a point.

    The camera stands at +z and looks along -z, which makes image-right +x (see the frame tests).
    """
    depth = view.camera_distance or 4.0 * view.scale
    to_camera = np.eye(4)
    to_camera[:3, :3], to_camera[:2, 3] = view.matrix() * view.scale, view.offset
    bsdf = {"type": "ps_surface", "material": material, "to_object": mi.ScalarTransform4f(np.linalg.inv(to_camera))}
    if shape is not None:
        bsdf["shape"] = shape
    return {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": bounces + 2, "rr_depth": 1000},
        "sensor": {
            **_sensor(view),
            "to_world": mi.ScalarTransform4f().look_at(origin=[0, 0, depth], target=[0, 0, 0], up=[0, 1, 0]),
            "near_clip": 1e-3,
            "far_clip": 2 * depth,
            "film": {
                "type": "hdrfilm",
                "width": size,
                "height": size,
                "rfilter": {"type": "box"},
                "pixel_format": "rgb",
                "component_format": "float32",
            },
            "sampler": {"type": "independent", "sample_count": spp},
        },
        "object": build_mesh(mesh.pose(view), bsdf),
        "light": _POINT if near else _DIRECTIONAL,
    }


def _sensor(view: View) -> dict[str, Any]:
    """Return the type of the camera, and the field of view of a perspective one."""
    if view.camera_distance is None:
        return {"type": "orthographic"}
    return {"type": "perspective", "fov": float(np.degrees(2 * np.arctan(1 / view.camera_distance)))}


def render_each_light(
    mesh: TriangleMesh, view: View, material: str, lights: np.ndarray, *, size: int, spp: int, bounces: int,
    seed: int, shape: str | None = None, distances: np.ndarray | None = None,
) -> Iterator[np.ndarray]:  # fmt: skip
    """Yield one image (size, size, 3) float32 per light, updating the emitter of a scene loaded once.

    Args:
        mesh: Object in the unit sphere.
        view: Pose.
        material: Any surface name (see `render.materials.surfaces.load`).
        lights: (L, 3) unit vectors to the lights, camera frame.
        size: Image side in pixels.
        spp: Samples per pixel.
        bounces: Interreflection bounces; Mitsuba's `max_depth` is this plus two.
        seed: Seed of the first light's image; the next ones follow.
        shape: Name of the shape, which patterns that follow a mesh's pieces need.
        distances: (L,) of near lights from the object's centre, in half image widths; None for distant lights.
    """
    surface_bsdf.register()
    scene = mi.load_dict(scene_dict(mesh, view, material, size, spp, bounces, shape, distances is not None))
    parameters = mi.traverse(scene)
    for number, light in enumerate(np.asarray(lights, np.float64)):
        if distances is not None:
            position = np.array([*view.offset, 0.0]) + distances[number] * light / np.linalg.norm(light)
            parameters["light.position"] = mi.Point3f(*position.tolist())
            parameters["light.intensity.value"] = mi.Color3f(float(np.pi * distances[number] ** 2))
        else:
            up = [0.0, 1.0, 0.0] if abs(light[1]) < 0.9 else [1.0, 0.0, 0.0]
            # An emitter shines along its local +z: from the light towards the surface, so minus the light vector.
            parameters["light.to_world"] = mi.Transform4f().look_at([0, 0, 0], (-light).tolist(), up)
        parameters.update()
        yield np.array(mi.render(scene, seed=seed + number))
