"""A first normal of every pixel by robust least squares, the frame that goes with it, and that of a line of sight.

Legend: N pixels, Q lights.
"""

import torch
from torch import Tensor
from torch.nn import functional

_ROUNDS = 3
_RIDGE = 2e-3
_LEAST_Z = 0.05
"""A visible surface does not turn away from the camera."""


def first_normals(values: Tensor, directions: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Fit a Lambertian surface to each pixel, by least squares reweighted for small absolute errors.

    Args:
        values: (N, Q, 3) float32, radiance over the light intensities.
        directions: (N, Q, 3) float32, unit.

    Returns:
        Unit normals (N, 3); the radiance (N, 3) of the surface where it faces the light; and the mean absolute error
        (N,) relative to its grey.
    """
    grey = values.mean(dim=-1)  # (N, Q)
    pairs = (directions[..., :, None] * directions[..., None, :]).flatten(2)  # (N, Q, 9)
    weights = torch.ones_like(grey)
    ridge = torch.eye(3, device=grey.device)
    for _ in range(_ROUNDS + 1):
        moments = (weights[:, None] @ pairs).view(-1, 3, 3)
        mean = moments.diagonal(dim1=1, dim2=2).mean(dim=-1).clamp(min=1e-6)[:, None, None]
        right = (weights * grey)[:, None] @ directions  # (N, 1, 3)
        found = torch.linalg.solve(moments + _RIDGE * mean * ridge, right[:, 0])  # (N, 3)
        shading = (directions @ found[..., None])[..., 0]  # (N, Q)
        error = (grey - shading.clamp(min=0.0)).abs()
        usual = error.mean(dim=1, keepdim=True)
        # A light below the surface says nothing of it.
        weights = (shading > 0) / (error / (usual + 1e-6) + 0.3) + 1e-3
    found = torch.cat([found[:, :2], found[:, 2:].clamp(min=1e-4)], dim=1)
    normals = functional.normalize(found, dim=1)
    normals = functional.normalize(torch.cat([normals[:, :2], normals[:, 2:].clamp(min=_LEAST_Z)], dim=1), dim=1)
    lit = (directions @ normals[..., None])[..., 0].clamp(min=0.0) * weights  # (N, Q)
    cosine = (directions @ normals[..., None])[..., 0].clamp(min=0.0)
    scale = (lit[:, None] @ values)[:, 0] / ((lit * cosine).sum(dim=1, keepdim=True) + 1e-6)
    scale = scale.clamp(min=0.0)
    error = (grey - cosine * scale.mean(dim=1, keepdim=True)).abs().mean(dim=1)
    return normals, scale, error / (scale.mean(dim=1) + 1e-3)


def frames(normals: Tensor) -> Tensor:
    """Return the frame of each normal (N, 3) as rows x, y, z of (N, 3, 3): z along it, the view in the x-z plane.

    Where the normal looks at the camera, x is the camera's.
    """
    x, y, z = normals.unbind(dim=-1)
    tangent = torch.stack([-x * z, -y * z, 1.0 - z * z], dim=-1)  # the view's part across the normal
    facing = (tangent.norm(dim=-1, keepdim=True) < 1e-4).to(normals.dtype)
    tangent = tangent + facing * torch.stack([z, torch.zeros_like(z), -x], dim=-1)
    first = functional.normalize(tangent, dim=-1)
    return torch.stack([first, torch.linalg.cross(normals, first), normals], dim=1)


def turn_to_sight(sights: Tensor) -> Tensor:  # (P, 3, 3)
    """Return the smallest rotations that bring vectors (P, 3) with z = 1 to the z axis."""
    x, y, z = functional.normalize(sights, dim=-1).unbind(dim=-1)
    share = 1.0 / (1.0 + z)
    rows = [1.0 - x * x * share, -x * y * share, -x, -x * y * share, 1.0 - y * y * share, -y, x, y, z]
    return torch.stack(rows, dim=-1).unflatten(-1, (3, 3))
