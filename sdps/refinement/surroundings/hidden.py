"""What an object hides of the light around it.

A Lambertian surface of normal n sees of each harmonic k of light the irradiance IRRADIANCE_k H_k(n)
(`sdps.core.lighting`), if nothing stands in the way. The directions w that the object itself blocks are missing:

    B_pk(n) = IRRADIANCE_k H_k(n) - C_pk . n,    C_pk = 4 / D sum over blocked w with n . w > 0 of H_k(w) w

over D directions spread evenly over the sphere. C . n is linear in n, since on the horizon, where the set of
directions changes, they light nothing. Such products of harmonics with visibility are what precomputed radiance
transfer keeps (Sloan et al., SIGGRAPH 2002); here they belong to the surface that the normals integrate to.
"""

import numpy as np
import torch
from torch import Tensor

from render.shared.imaging.vectors import spiral
from sdps.core.geometry import ORTHOGRAPHIC, Camera
from sdps.core.lighting import IRRADIANCE, harmonics
from sdps.refinement.shape.transport import trace_shadows

DIRECTIONS = 128
"""Directions that are traced."""


def find_hidden(
    heights: np.ndarray, mask: np.ndarray, normals: np.ndarray, camera: Camera = ORTHOGRAPHIC, count: int = DIRECTIONS
) -> Tensor:
    """Return C, what the surface hides of each harmonic at each pixel, (P, 9, 3) float32.

    Args:
        heights: (H, W), towards the camera, in pixels; not read outside the mask.
        mask: (H, W) bool, P true.
        normals: (P, 3) unit.
        camera: Of this picture.
        count: D, directions that are traced.
    """
    ways = spiral(count)
    lit = trace_shadows(heights, mask, normals, ways.astype(np.float32), camera)
    blocked = ~lit & (normals @ ways.T > 0.0)  # (P, D)
    products = (harmonics(ways)[:, :, None] * ways[:, None]).reshape(count, 27) * (4.0 / count)
    return torch.from_numpy((blocked.astype(np.float32) @ products.astype(np.float32)).reshape(-1, 9, 3))


def visible_harmonics(normals: Tensor, hidden: Tensor) -> Tensor:
    """Return B, the irradiance of each harmonic of light, (P, 9), of unit normals (P, 3) and C (P, 9, 3)."""
    return harmonics(normals) * normals.new_tensor(IRRADIANCE) - (hidden * normals[:, None]).sum(dim=2)
