"""Small networks for any light, never trained."""

from pathlib import Path
from typing import Any

from render.shared.config import to_plain
from sdps.data.augment import Augmentation
from sdps.models.checkpoint import TrainedModel, save_weights
from sdps.models.registry import create

SMALL: dict[str, dict[str, Any]] = {
    "lightset-any": {"width": 16, "blocks": 1, "breadth": 0.2},
    "frames-any": {"width": 8, "blocks": 1, "heads": 0, "context": 0},
}


def write_weights(out: Path) -> Path:
    """Write the networks of `anylight`; return the folder of runs."""
    for name, options in SMALL.items():
        model = TrainedModel(
            name, create(name, **options), options, {"config": {"augmentation": to_plain(Augmentation())}}
        )
        place = out / "models" / name
        place.mkdir(parents=True)
        save_weights(place / f"{name}.safetensors", model)
    return out
