"""How samples of tests are made."""

import numpy as np
import torch
from torch import Tensor

from sdps.data.augment import Augmentation
from sdps.data.dataset import SampleOptions

PLAIN = Augmentation(
    exposure="paper", exposure_range=(1.0, 1.0), intensity_range=(1.0, 1.0), noise=0.0, clip=1e6
)  # nothing happens


def options(**changes: object) -> SampleOptions:
    return SampleOptions(**{"seed": 0, "images": 4, "size": 32, "augmentation": Augmentation(), **changes})


def rng(seed: int = 0) -> np.random.Generator:
    return np.random.default_rng(seed)


def distant_layout(images: Tensor) -> dict[str, Tensor]:
    """Return the fields of a `Batch` that say where pixels and lamps lie: far, and seen orthographically."""
    scenes, count, _, *sides = images.shape
    sights = torch.zeros(scenes, 3, *sides)
    sights[:, 2] = 1.0
    lamps = {"nearness": torch.zeros(scenes, count), "covariance": torch.zeros(scenes, count, 3, 3)}
    return {**lamps, "places": torch.zeros(scenes, 3, *sides), "sights": sights}
