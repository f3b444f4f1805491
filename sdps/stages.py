"""What each of the two stages asks of a batch: its network, its loss and its validation metrics.

The trainer (`sdps.training`) knows nothing else about them.
"""

from abc import ABC, abstractmethod
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from render.seeds import derived_seed
from sdps.checkpoint import TrainedModel
from sdps.config import LightingTraining, NormalTraining, TrainingConfig
from sdps.dataset import Batch, SampleOptions
from sdps.lighting import LightClasses
from sdps.losses import faithful_normal_loss, lighting_loss, masked_normal_loss
from sdps.metrics import angle_degrees, direction_mae, intensity_error
from sdps.models import registry
from sdps.models.lcnet import LCNet, resize_input

_TINY = 1e-8


class Stage(ABC):
    """A network in training. Subclasses give `loss` and `metrics`.

    Args:
        name: The network's name in the registry, which also names the weights file.
        config: The run's configuration.
        options: Options of the network.
    """

    def __init__(self, name: str, config: TrainingConfig, options: dict[str, Any]) -> None:
        self.name, self.config, self.options = name, config, options
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(derived_seed(config.seed, "weights", name))
            self.network: nn.Module = registry.create(name, **options)

    def to(self, device: torch.device) -> None:
        """Move all networks to `device`, in the memory layout the configuration asks for."""
        layout = torch.channels_last if self.config.channels_last else torch.contiguous_format
        self.network.to(device, memory_format=layout)

    def origin(self) -> dict[str, Any]:
        """Return what else these weights depend on, for their metadata."""
        return {}

    def sample_options(self) -> SampleOptions:
        """Return how training samples are made."""
        config = self.config
        return SampleOptions(seed=config.seed, images=config.images, size=config.size, augmentation=config.augmentation)

    def validation_options(self) -> SampleOptions:
        """Return how validation samples are made: whole images in the pose they were rendered."""
        options = self.sample_options()
        return replace(options, crop=0, augmentation=replace(options.augmentation, symmetries=False))

    @abstractmethod
    def loss(self, batch: Batch) -> tuple[Tensor, dict[str, Tensor]]:
        """Return the scalar to minimise, and named scalars to log."""

    @abstractmethod
    def metrics(self, batch: Batch) -> dict[str, float]:
        """Return validation metrics averaged over the batch's scenes; called without gradients."""


class LightingStage(Stage):
    """Stage 1: LCNet learns the classes of light direction and intensity."""

    config: LightingTraining

    def __init__(self, config: LightingTraining) -> None:
        options = {
            "direction_classes": config.direction_classes,
            "intensity_classes": config.intensity_classes,
            "use_mask": config.use_mask,
            "use_global": config.use_global,
        }
        super().__init__("lcnet", config, options)
        self.classes = config.classes()

    def loss(self, batch: Batch) -> tuple[Tensor, dict[str, Tensor]]:
        """Return the summed cross-entropies of azimuth, elevation and intensity."""
        logits = self.network(batch.images, batch.mask)
        terms = lighting_loss(logits, self.classes.encode(batch.directions, batch.intensities))
        return terms.total, {f"{name}_loss": value for name, value in terms._asdict().items() if name != "total"}

    def metrics(self, batch: Batch) -> dict[str, float]:
        """Return the loss, and direction and intensity errors of both read-outs."""
        logits = self.network(batch.images, batch.mask)
        total = lighting_loss(logits, self.classes.encode(batch.directions, batch.intensities)).total
        values = {"loss": float(total)}
        for how, suffix in (("centre", ""), ("expectation", "_expectation")):
            directions, intensities = (tensor.cpu().numpy() for tensor in self.classes.read_out(*logits, how))
            values |= _light_errors(directions, intensities, batch, suffix)
        return values


class NormalStage(Stage):
    """Stage 2: NENet learns normals under the lights a frozen LCNet estimates.

    Args:
        config: The run's configuration.
        lighting: Trained LCNet; may be absent when `config.lights` is `true`.
    """

    config: NormalTraining

    def __init__(self, config: NormalTraining, lighting: TrainedModel | None = None) -> None:
        assert lighting is not None or config.lights == "true", "estimated lights need a trained LCNet"
        super().__init__("nenet", config, {})
        self.lighting = lighting if config.lights == "estimated" else None
        if self.lighting is not None:
            self.lighting.network.requires_grad_(False).eval()
            self.classes = lighting_classes(self.lighting)

    def to(self, device: torch.device) -> None:
        super().to(device)
        if self.lighting is not None:
            self.lighting.network.to(device)

    def origin(self) -> dict[str, Any]:
        """Record the data and step of the LCNet whose lights were used."""
        if self.lighting is None:
            return {"lights": "true"}
        metadata = self.lighting.metadata
        return {"lights": "estimated", "lcnet": {key: metadata.get(key) for key in ("data", "step", "metrics")}}

    def sample_options(self) -> SampleOptions:
        config = self.config
        return SampleOptions(
            seed=config.seed,
            images=config.images,
            size=config.size,
            augmentation=config.augmentation,
            crop=config.crop,
            min_object=config.min_object,
        )

    @torch.no_grad()
    def lights(self, batch: Batch) -> tuple[Tensor, Tensor]:
        """Return the directions (B, Q, 3) and intensities (B, Q) that NENet is given."""
        if self.lighting is None:
            return batch.directions, batch.intensities
        network: LCNet = self.lighting.network
        logits = network(*resize_input(batch.images, batch.mask))
        return self.classes.read_out(*logits, self.config.read_out)

    def loss(self, batch: Batch) -> tuple[Tensor, dict[str, Tensor]]:
        """Return the configured normal loss on the crops."""
        directions, intensities = self.lights(batch)
        side = self.config.crop or self.config.size
        images, mask, truth = (_crop(part, batch.corner, side) for part in (batch.images, batch.mask, batch.normals))
        normals = self.network(images / (intensities[..., None, None, None] + _TINY), directions)
        masked = masked_normal_loss(normals, truth, mask)
        loss = masked if self.config.loss == "masked" else faithful_normal_loss(normals, truth)
        return loss, {"masked_loss": masked}

    def metrics(self, batch: Batch) -> dict[str, float]:
        """Return the normal MAE on whole images and the errors of the lights used."""
        directions, intensities = self.lights(batch)
        normals = self.network(batch.images / (intensities[..., None, None, None] + _TINY), directions)
        inside = batch.mask[:, 0].bool()
        pairs = [tensor.permute(0, 2, 3, 1)[inside].cpu().numpy() for tensor in (normals, batch.normals)]
        values = {
            "loss": float(masked_normal_loss(normals, batch.normals, batch.mask)),
            "normal_mae": float(angle_degrees(*pairs).mean()),
        }
        return values | _light_errors(directions.cpu().numpy(), intensities.cpu().numpy(), batch, "")


def lighting_classes(model: TrainedModel) -> LightClasses:
    """Return the discretised lighting space a trained LCNet predicts."""
    low, high = model.augmentation().intensity_range
    return LightClasses(
        directions=model.options["direction_classes"],
        intensities=model.options["intensity_classes"],
        low=low,
        high=max(high, low + 1e-3),
    )


def _light_errors(directions: np.ndarray, intensities: np.ndarray, batch: Batch, suffix: str) -> dict[str, float]:
    """Return direction and intensity errors, (B, Q, 3) and (B, Q), each averaged over the scenes."""
    true_directions, true_intensities = batch.directions.cpu().numpy(), batch.intensities.cpu().numpy()
    errors = [intensity_error(*pair) for pair in zip(intensities, true_intensities, strict=True)]
    return {
        f"direction_mae{suffix}": direction_mae(directions, true_directions),
        f"intensity_error{suffix}": float(np.mean(errors)),
    }


def _crop(tensor: Tensor, corner: Tensor, side: int) -> Tensor:
    """Cut (B, ..., S, S) to (B, ..., side, side) at each sample's own corner (B, 2)."""
    if tensor.shape[-1] == side:
        return tensor
    corners = corner.tolist()
    return torch.stack([item[..., r : r + side, c : c + side] for item, (r, c) in zip(tensor, corners, strict=True)])
