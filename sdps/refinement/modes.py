"""What reflectance of real materials adds to the model of `image_model`: a factor G over light and normal.

    G_pi = exp(sum_j m_j B_j(n_p, l_i)),    v = (0, 0, 1), h = (l + v) / |l + v|
    B = (x + y) o,  w o,  (x + y) x y,  (x + y) (x - y)^2,  t^2,  sqrt(t)
    w = 1 - l . v,  t = 1 - n . h

with x, y and o of `image_model`. The terms were chosen one by one: each explains most of what those before it leave of
the 100 materials fitted to MERL. The numbers m of an object are those that explain best what the rest of the model
leaves of its images: weighted least squares of the logarithms, with a normal distribution in front of them. That
distribution is of such materials on a sphere: `lab/studies/reflectance_modes.py` measures it.
"""

from functools import cache
from importlib import resources
from pathlib import Path

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import normalize

from render.shared.config import read_yaml
from sdps.refinement.image_model import Factors, grazing, reflectance

MODES = 6
_OBSERVATIONS = 100.0
"""Observations all of an object's count as: what neighbouring pixels and lights differ by is the same error again."""
_SPREAD = 0.04
"""Of the logarithms, beside G."""
_LEAST_RADIANCE, _LEAST_LIT = 0.02, 0.1
_MOST = 0.7
"""No logarithm counts for more."""
_LEAST_MOMENT = 1e-6
_PART = 4096
ASSET = Path(str(resources.files("assets"))) / "reflectance_modes.yaml"


def terms(normals: Tensor, directions: Tensor) -> Tensor:  # (P, L, MODES)
    """Return B of the module's text.

    Args:
        normals: (P, 3) unit.
        directions: (L, 3) unit.
    """
    half = normalize(directions + directions.new_tensor([0.0, 0.0, 1.0]), dim=1)
    x, y, o = grazing(normals, directions)
    s, t = x + y, (1.0 - normals @ half.T).clamp_min(0.0)
    return torch.stack([s * o, (1.0 - directions[:, 2]) * o, s * x * y, s * (x - y) ** 2, t**2, t.sqrt()], dim=-1)


def factor(normals: Tensor, directions: Tensor, modes: Tensor) -> Tensor:  # (P, L)
    """Return G, between exp(-0.7) and exp(0.7); arguments as of `terms`, and m (MODES,)."""
    parts = [terms(part, directions) @ modes for part in normals.split(_PART)]
    return torch.cat(parts).clamp(-_MOST, _MOST).exp()


def fitted(made: Factors, images: Tensor, kept: Tensor) -> Tensor:  # (MODES,)
    """Return m.

    Args:
        made: The model.
        images: (P, 3, L), without light that bounced.
        kept: (P, L), 0 for observations that count for nothing.
    """
    left, weights = left_over(made, images, kept)
    shapes = terms(made.normals, made.directions)
    shapes = torch.cat([torch.ones_like(shapes[..., :1]), shapes], dim=-1).flatten(0, 1)  # (P L, 1 + MODES)
    weighted = shapes.T * (weights.flatten() * (_OBSERVATIONS / _SPREAD**2))
    normal = (weighted @ shapes).double() + _precision()
    return torch.linalg.solve(normal, (weighted @ left.flatten()).double())[1:].float()


def left_over(made: Factors, images: Tensor, kept: Tensor) -> tuple[Tensor, Tensor]:
    """Return the logarithm of observed over predicted radiance (P, L), and its weights, which add up to 1."""
    cosine = made.normals @ made.directions.T  # (P, L)
    predicted = (reflectance(made) * cosine.clamp_min(0.0)[:, None]).mean(dim=1)
    observed = (images * torch.exp(-made.log_intensities).T).mean(dim=1)
    left = torch.log((observed + _LEAST_RADIANCE) / (predicted + _LEAST_RADIANCE)).clamp(-_MOST, _MOST)
    weights = cosine * ((cosine > _LEAST_LIT) & (kept > 0.0) & (predicted > _LEAST_RADIANCE))
    return left, weights / weights.sum().clamp_min(1e-9)


@cache
def _precision() -> Tensor:
    """Return the inverse of the second moments, with a constant in front that is free."""
    moments = np.array(read_yaml(str(ASSET))["second_moments"])
    precision = np.zeros((1 + MODES, 1 + MODES))
    precision[1:, 1:] = np.linalg.inv(moments + _LEAST_MOMENT * np.eye(MODES))
    precision[0, 0] = _LEAST_MOMENT
    return torch.from_numpy(precision)
