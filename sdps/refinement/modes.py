"""Finding the modes of an object: the numbers m of G in `reflectance`.

They are those that best explain what the rest of the model leaves of the images: weighted least squares of the
logarithms, with a normal prior. `lab/studies/reflectance_modes.py` measures the prior on spheres of materials fitted to
MERL.
"""

from functools import cache
from importlib import resources
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from render.shared.config import read_yaml
from sdps.refinement.image_model import Model
from sdps.refinement.reflectance import (
    MODES,
    MOST_LOG_FACTOR,
    Angles,
    evaluate_factor,
    measure_angles,
    mode_terms,
    reflect,
)
from sdps.refinement.sites import Seen, Sites

_OBSERVATIONS = 100.0
"""What all observations of an object count as together: errors of neighbouring pixels and lights correlate."""
_SPREAD = 0.04
"""Standard deviation of the logarithms, apart from G."""
LEAST_RADIANCE, _LEAST_LIT = 0.02, 0.1
"""Added to radiance before its logarithm; least n . l that counts."""
_LEAST_MOMENT = 1e-6
_PART = 4096
ASSET = Path(str(resources.files("assets"))) / "reflectance_modes.yaml"


def evaluate_modes(model: Model, modes: Tensor, sites: Sites | None = None) -> Tensor:  # (P, L)
    """Return G, some pixels at a time; without gradients."""
    model = Model(*(part.detach() for part in model))
    parts = (slice(start, start + _PART) for start in range(0, len(model.normals), _PART))
    seen = (model.see(sites, part) for part in parts)
    return torch.cat([evaluate_factor(measure_angles(some.normals, some.directions), modes) for some in seen])


def fit_modes(model: Model, images: Tensor, usable: Tensor, seen: Seen, angles: Angles) -> Tensor:  # (MODES,)
    """Return m.

    Args:
        model: The model.
        images: (P, 3, L), without bounced light.
        usable: (P, L), 0 for observations that are ignored.
        seen: Normals and lamps as the pixels see them.
        angles: Theirs.
    """
    left, weights = compare_logs(model, images, usable, seen, angles)
    terms = mode_terms(angles)
    shapes = torch.stack([torch.ones_like(left), *terms], dim=-1).flatten(0, 1)  # (P L, 1 + MODES)
    weighted = shapes.T * (weights.flatten() * (_OBSERVATIONS / _SPREAD**2))
    normal = (weighted @ shapes).double() + _load_precision()
    return torch.linalg.solve(normal, (weighted @ left.flatten()).double())[1:].float()


def compare_logs(
    model: Model, images: Tensor, usable: Tensor, seen: Seen, angles: Angles
) -> tuple[Tensor, Tensor]:  # fmt: skip
    """Return the logarithm of observed over predicted radiance (P, L), and its weights, which add up to 1."""
    cosine = seen.cosines  # (P, L)
    reflected = reflect(angles, model)
    predicted = (reflected * cosine.clamp_min(0.0)[:, None]).mean(dim=1)
    observed = seen.even_out(images * torch.exp(-model.log_intensities).T).mean(dim=1)
    left = torch.log((observed + LEAST_RADIANCE) / (predicted + LEAST_RADIANCE))
    weights = cosine * ((cosine > _LEAST_LIT) & (usable > 0.0) & (predicted > LEAST_RADIANCE))
    return left.clamp(-MOST_LOG_FACTOR, MOST_LOG_FACTOR), weights / weights.sum().clamp_min(1e-9)


@cache
def _load_precision() -> Tensor:
    """Return the inverse of the prior's second moments, preceded by a constant that is free."""
    moments = np.array(read_yaml(str(ASSET))["second_moments"])
    precision = np.zeros((1 + MODES, 1 + MODES))
    precision[1:, 1:] = np.linalg.inv(moments + _LEAST_MOMENT * np.eye(MODES))
    precision[0, 0] = _LEAST_MOMENT
    return torch.from_numpy(precision)
