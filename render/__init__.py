"""Physically based rendering of photometric-stereo scenes with Mitsuba 3.

Frame everywhere: x right, y up, z to the camera; light vectors point from the surface to the light; radiance is linear,
and a white Lambertian surface that faces a light has radiance 1.

`__all__` is the public interface. Everything else can be imported too, but may move. Importing this package loads
neither mitsuba nor torch; what needs mitsuba loads it when it is first called.
"""

from typing import TYPE_CHECKING

from render.shared import lazy_names

if TYPE_CHECKING:
    from render.api import fit_material, lights, material, render_plan, render_view, render_views, shape
    from render.checks.validate import validate
    from render.planning.data_config import DataConfig
    from render.planning.plan import plan
    from render.records.manifest import SceneSpec, read_manifest
    from render.records.shards import read_shard, write_shard
    from render.running.rendered_view import RenderedView
    from render.shared.errors import InputError
else:
    __getattr__, __dir__ = lazy_names(
        __name__,
        {
            "render.api": (
                "fit_material", "lights", "material", "render_plan", "render_view", "render_views", "shape",
            ),
            "render.checks.validate": ("validate",),
            "render.planning.data_config": ("DataConfig",),
            "render.planning.plan": ("plan",),
            "render.records.manifest": ("SceneSpec", "read_manifest"),
            "render.records.shards": ("read_shard", "write_shard"),
            "render.running.rendered_view": ("RenderedView",),
            "render.shared.errors": ("InputError",),
        },
    )  # fmt: skip

__all__ = [
    "DataConfig",
    "InputError",
    "RenderedView",
    "SceneSpec",
    "fit_material",
    "lights",
    "material",
    "plan",
    "read_manifest",
    "read_shard",
    "render_plan",
    "render_view",
    "render_views",
    "shape",
    "validate",
    "write_shard",
]
