"""The slow, obvious renderer: Mitsuba's own `path` integrator, one light at a time.

`render.kernel.many_lights` is compared with it, statistically in the tests and in time by `make bench`.
"""

from collections.abc import Iterator
from typing import Any

import numpy as np

from render.backend import variant
from render.kernel.scene import build_mesh
from render.materials.kernels import surface_bsdf
from render.records.manifest import View
from render.shapes.geometry.mesh import TriangleMesh

mi = variant.load()


def scene_dict(
    mesh: TriangleMesh, view: View, material: str, size: int, spp: int, bounces: int, shape: str | None = None
) -> dict[str, Any]:
    """Describe the scene for `mi.load_dict`: orthographic camera, box filter, one directional emitter.

    The camera stands at +z and looks along -z, which makes image-right +x (see the frame tests).
    """
    depth = 4.0 * view.scale
    to_camera = np.eye(4)
    to_camera[:3, :3], to_camera[:2, 3] = view.matrix() * view.scale, view.offset
    bsdf = {"type": "ps_surface", "material": material, "to_object": mi.ScalarTransform4f(np.linalg.inv(to_camera))}
    if shape is not None:
        bsdf["shape"] = shape
    return {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": bounces + 2, "rr_depth": 1000},
        "sensor": {
            "type": "orthographic",
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
        "object": build_mesh(mesh.posed(view), bsdf),
        "light": {"type": "directional", "direction": [0, 0, -1], "irradiance": {"type": "rgb", "value": np.pi}},
    }


def render_each_light(
    mesh: TriangleMesh, view: View, material: str, lights: np.ndarray, *, size: int, spp: int, bounces: int,
    seed: int, shape: str | None = None,
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
    """
    surface_bsdf.register()
    scene = mi.load_dict(scene_dict(mesh, view, material, size, spp, bounces, shape))
    parameters = mi.traverse(scene)
    key = next(name for name in parameters.keys() if name.endswith("light.to_world"))  # noqa: SIM118
    for number, light in enumerate(np.asarray(lights, np.float64)):
        up = [0.0, 1.0, 0.0] if abs(light[1]) < 0.9 else [1.0, 0.0, 0.0]
        # An emitter shines along its local +z: from the light towards the surface, so minus the light vector.
        parameters[key] = mi.Transform4f().look_at(origin=[0, 0, 0], target=(-light).tolist(), up=up)
        parameters.update()
        yield np.array(mi.render(scene, seed=seed + number))
