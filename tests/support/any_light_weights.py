"""Small networks for any light, never trained."""

from pathlib import Path
from typing import Any

import torch

from render.shared.config import to_plain
from sdps.data.augment import Augmentation
from sdps.models.checkpoint import TrainedModel, save_weights
from sdps.models.covariance import pack
from sdps.models.lightset import LightSetNet
from sdps.models.registry import create

SMALL: dict[str, dict[str, Any]] = {
    "lightset-any": {"width": 16, "blocks": 1, "breadth": 0.2},
    "frames-any": {"width": 8, "blocks": 1, "heads": 0, "context": 0},
}


def write_weights(out: Path, spread: float | None = 0.0) -> Path:
    """Write the networks of `anylight`; return the folder of runs.

    Args:
        out: Folder of what training writes.
        spread: What they tell of all light, the variance of its directions; None: networks that tell nothing of it.
    """
    for name, small in SMALL.items():
        options = small | {"covariance": spread is not None}
        network = create(name, **options)
        if isinstance(network, LightSetNet) and network.about is not None and spread is not None:
            network.about.bias.data = spread / 3.0 * pack(torch.eye(3))
        model = TrainedModel(name, network, options, {"config": {"augmentation": to_plain(Augmentation())}})
        place = out / "models" / name
        place.mkdir(parents=True)
        save_weights(place / f"{name}.safetensors", model)
    return out
