"""SDPS-Net: self-calibrating deep photometric stereo (Chen et al., CVPR 2019), its training and its use.

Frame everywhere: x right, y up, z to the camera; light vectors point from the surface to the light;
radiance is linear, and a white Lambertian surface facing a light is 1.0.

`__all__` is the public interface. Everything else can be imported too, but may move. Importing this package does not
load torch; what needs torch loads it when it is first used.
"""

from typing import TYPE_CHECKING

from render.shared import lazy_names

if TYPE_CHECKING:
    from render.shared.errors import InputError
    from sdps.api import available_methods, estimate, infer, plan, train
    from sdps.core.estimate import Estimate
    from sdps.core.geometry import Camera
    from sdps.core.integration import integrate
    from sdps.core.metrics import score
    from sdps.inference.inference_config import InferenceConfig
    from sdps.photos.reading import load
    from sdps.surface.inferred import Inference
    from sdps.surface.meshing import mesh, write_mesh
    from sdps.surface.relight import relit
else:
    __getattr__, __dir__ = lazy_names(
        __name__,
        {
            "render.shared.errors": ("InputError",),
            "sdps.api": ("available_methods", "estimate", "infer", "plan", "train"),
            "sdps.core.estimate": ("Estimate",),
            "sdps.core.geometry": ("Camera",),
            "sdps.core.metrics": ("score",),
            "sdps.inference.inference_config": ("InferenceConfig",),
            "sdps.surface.inferred": ("Inference",),
            "sdps.photos.reading": ("load",),
            "sdps.core.integration": ("integrate",),
            "sdps.surface.meshing": ("mesh", "write_mesh"),
            "sdps.surface.relight": ("relit",),
        },
    )

__all__ = [
    "Camera",
    "Estimate",
    "Inference",
    "InferenceConfig",
    "InputError",
    "available_methods",
    "estimate",
    "infer",
    "integrate",
    "load",
    "mesh",
    "plan",
    "relit",
    "score",
    "train",
    "write_mesh",
]
