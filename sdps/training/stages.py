"""What models of each role ask of a batch: the network, its loss and its validation metrics.

The trainer (`sdps.training.trainer`) knows nothing else about them.
"""

import math
from abc import ABC, abstractmethod
from dataclasses import replace
from typing import Any, NamedTuple, cast, get_args

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from render.shared.seeds import derive_seed, generator
from sdps.core.lighting import ReadOut
from sdps.core.losses import (
    chord_normal_loss,
    expected_error_loss,
    faithful_normal_loss,
    masked_normal_loss,
    normal_gradient_loss,
    shading_loss,
)
from sdps.core.metrics import angle_degrees, direction_mae, intensity_error
from sdps.data.dataset import Batch, SampleOptions
from sdps.models import registry
from sdps.models.attention import AttentionNet
from sdps.models.base import LightingNetwork, Lights, NormalNetwork, Observations
from sdps.models.checkpoint import TrainedModel
from sdps.models.frames import FrameNet
from sdps.models.lcnet import resize_input
from sdps.models.registry import TRUE_LIGHTS
from sdps.models.upsfcn import UPSFCNLight
from sdps.training.training_config import LightingTraining, NormalTraining, TrainingConfig


class Part(NamedTuple):
    """A network to be saved by itself."""

    name: str  # of the weights file
    model: str  # in the registry
    network: nn.Module
    options: dict[str, Any]


class Stage(ABC):
    """A network in training. Subclasses give `loss` and `metrics`.

    Args:
        name: The run's name, which also names the weights file.
        model: Name in the registry.
        config: The run's configuration.
        options: Options of the network.
    """

    goal = "direction_mae"
    """The metric, lower being better, by which the best weights are kept."""

    def __init__(self, name: str, model: str, config: TrainingConfig, options: dict[str, Any]) -> None:
        self.name, self.model, self.config, self.options = name, model, config, options
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(derive_seed(config.seed, "weights", model))
            self.network: nn.Module = self.build()

    def build(self) -> nn.Module:
        """Return the network with fresh weights."""
        return registry.create(self.model, **self.options)

    def frozen(self) -> list[nn.Module]:
        """Return the networks that are used but not trained."""
        return []

    def to(self, device: torch.device) -> None:
        """Move all networks to `device`, in the memory layout the configuration asks for."""
        layout = torch.channels_last if self.config.channels_last else torch.contiguous_format
        for network in (self.network, *self.frozen()):
            network.to(device, memory_format=layout)  # type: ignore[call-overload]  # torch's stubs lack it

    def origin(self) -> dict[str, Any]:
        """Return what else these weights depend on, for their metadata."""
        return {}

    def parts(self, network: nn.Module) -> list[Part]:
        """Return what is saved of `network`, which is `self.network` or an average of its weights."""
        return [Part(self.name, self.model, network, self.options)]

    def sample_options(self) -> SampleOptions:
        """Return how training samples are made."""
        config = self.config
        return SampleOptions(
            seed=config.seed, images=config.images, size=config.size, rescale=config.rescale,
            augmentation=config.augmentation,
        )  # fmt: skip

    def validation_options(self) -> SampleOptions:
        """Return how validation samples are made: whole images in the pose they were rendered."""
        options = self.sample_options()
        augmentation = replace(options.augmentation, symmetries=False, biased=0.0, frontal=0.0)
        images = self.config.validation_images or options.images
        return replace(options, images=images, crop=0, rescale=False, augmentation=augmentation)

    @abstractmethod
    def loss(self, batch: Batch) -> tuple[Tensor, dict[str, Tensor]]:
        """Return the scalar to minimise, and named scalars to log."""

    @abstractmethod
    def metrics(self, batch: Batch) -> dict[str, float]:
        """Return validation metrics averaged over the batch's scenes; called without gradients."""


class LightingStage(Stage):
    """Models that tell lights from images and mask."""

    config: LightingTraining
    network: LightingNetwork

    def __init__(self, config: LightingTraining, *, model: str = "lcnet", name: str | None = None) -> None:
        super().__init__(name or model, model, config, lighting_options(model, config))

    def predict(self, batch: Batch) -> Any:
        """Return the network's prediction."""
        return self.network(batch.images, batch.mask)

    def loss(self, batch: Batch) -> tuple[Tensor, dict[str, Tensor]]:
        """Return the network's own loss."""
        terms = self.network.loss(self.predict(batch), batch.directions, batch.intensities)
        return terms["total"], {f"{name}_loss": value for name, value in terms.items() if name != "total"}

    def metrics(self, batch: Batch) -> dict[str, float]:
        """Return the loss, and direction and intensity errors of every read-out."""
        prediction = self.predict(batch)
        values = {"loss": float(self.network.loss(prediction, batch.directions, batch.intensities)["total"])}
        for how in get_args(ReadOut):
            suffix = "" if how == "centre" else f"_{how}"
            values |= light_errors(self.network.lights(prediction, how), batch, suffix)
        return values


class NormalStage(Stage):
    """Models that give normals, under the lights of a frozen lighting model, true ones, or none.

    Args:
        config: The run's configuration.
        lighting: Trained lighting model; may be absent for true lights, or a model that is told none.
        model: Name in the registry.
        name: Name of the run.
    """

    config: NormalTraining
    network: NormalNetwork
    goal = "normal_mae"
    usual = "nenet"
    """Name in the registry where no other is given."""

    def __init__(
        self,
        config: NormalTraining,
        lighting: TrainedModel | None = None,
        *,
        model: str | None = None,
        name: str | None = None,
    ) -> None:
        model = model or self.usual
        ranged = "intensity_range" in registry.network_options(model)
        decided = {"intensity_range": list(config.augmentation.intensity_range)} if ranged else {}
        super().__init__(name or model, model, config, decided | config.options)
        self.source = config.lights or registry.entry(model).lights
        assert lighting is not None or self.source in (TRUE_LIGHTS, ""), f"{model} needs a trained lighting model"
        self.lighting = freeze(lighting) if lighting and self.source not in (TRUE_LIGHTS, "") else None

    def frozen(self) -> list[nn.Module]:
        return [] if self.lighting is None else [self.lighting.network]

    def origin(self) -> dict[str, Any]:
        """Record the lights trained on, and the data and step of the model they came from."""
        if self.lighting is None:
            return {"lights": self.source or "none"}
        return {"lights": self.source, "lighting": described(self.lighting)}

    def sample_options(self) -> SampleOptions:
        return replace(super().sample_options(), crop=self.config.crop, min_object=self.config.min_object)

    @torch.no_grad()
    def lights(self, batch: Batch) -> Lights | None:
        """Return the lights the network is given."""
        if not self.source:
            return None
        if self.lighting is None:
            return Lights(batch.directions, batch.intensities)
        network = cast(LightingNetwork, self.lighting.network)
        return network.lights(network(*resize_input(batch.images, batch.mask)), self.config.read_out).doubted()

    def training_lights(self, batch: Batch) -> Lights | None:
        """Return the lights given in training: with drawn errors, then some of the way to the true ones."""
        lights, limit = self.lights(batch), self.config.light_blend
        if lights is not None and self.config.light_error:
            lights = disturbed(lights, batch.seed.tolist(), self.config.light_error)
        if self.lighting is None or lights is None or not limit:
            return lights
        drawn = [min(generator(seed, "light_blend").uniform(0.0, limit), 1.0) for seed in batch.seed.tolist()]
        share = torch.tensor(drawn, device=batch.images.device)[:, None]  # (B, 1)
        directions = torch.lerp(lights.directions.float(), batch.directions, share[..., None])  # (B, Q, 3)
        intensities = torch.lerp(lights.intensities.float(), batch.intensities, share)  # (B, Q)
        expected = None if lights.expected is None else (1.0 - share) * lights.expected.float()
        return Lights(functional.normalize(directions, dim=-1), intensities, expected=expected)

    def loss(self, batch: Batch) -> tuple[Tensor, dict[str, Tensor]]:
        """Return the configured normal loss on the crops, and the lighting loss of models that learn both."""
        lights = self.training_lights(batch)
        side = self.config.crop or self.config.size
        images, mask, truth = (crop(part, batch.corner, side) for part in (batch.images, batch.mask, batch.normals))
        seen = self.network.observe(images, mask, lights)
        if not isinstance(self.network, UPSFCNLight):
            return normal_loss(self.config, self.network, seen, truth, mask, batch.directions)
        normals, logits = self.network.with_lights(seen)
        loss, terms = plain_normal_loss(self.config, normals, truth, mask)
        terms["lighting_loss"] = self.network.lighting_loss(logits, batch.directions, batch.intensities)
        return loss + self.config.lighting_weight * terms["lighting_loss"], terms

    def metrics(self, batch: Batch) -> dict[str, float]:
        """Return the normal MAE on whole images, and the errors of lights that a model found or that were drawn."""
        lights = self.lights(batch)
        normals = self.network(self.network.observe(batch.images, batch.mask, lights))
        values = {
            "loss": float(masked_normal_loss(normals, batch.normals, batch.mask)),
            "normal_mae": normal_error(normals, batch),
        }
        if lights is not None and self.config.light_error:
            drawn = disturbed(lights, batch.seed.tolist(), self.config.light_error)
            seen = self.network.observe(batch.images, batch.mask, drawn)
            values |= light_errors(drawn, batch, "_drawn")
            values["normal_mae_drawn"] = normal_error(self.network(seen), batch)
        return values | self.light_scores(lights, batch)

    def light_scores(self, lights: Lights | None, batch: Batch) -> dict[str, float]:
        """Return the errors of the lights the network is given; none of those that are the true ones."""
        return {} if lights is None or self.lighting is None else light_errors(lights, batch, "")


def normal_loss(
    config: NormalTraining, network: NormalNetwork, seen: Observations, truth: Tensor, mask: Tensor, directions: Tensor
) -> tuple[Tensor, dict[str, Tensor]]:
    """Return the scalar to minimise of a normal network, and named parts.

    Args:
        config: Names the loss, and weighs the others beside it.
        network: In training.
        seen: What it is shown.
        truth: (B, 3, H, W) unit normals.
        mask: (B, 1, H, W), 0 or 1.
        directions: (B, Q, 3), the true ones.
    """
    if isinstance(network, FrameNet):
        staged = network.staged(seen)
        loss, terms = plain_normal_loss(config, staged.normals, truth, mask)
        terms["pixel_loss"], _ = plain_normal_loss(config, staged.alone, truth, mask)
        terms["expected_loss"] = expected_error_loss(staged.expected, staged.normals, truth, mask)
        return loss + terms["pixel_loss"] + config.expected_weight * terms["expected_loss"], terms
    if not (isinstance(network, AttentionNet) and network.shades and config.shading_weight):
        return plain_normal_loss(config, network(seen), truth, mask)
    normals, maps = network.with_shading(seen)
    loss, terms = plain_normal_loss(config, normals, truth, mask)
    terms["shading_loss"] = torch.stack([shading_loss(shading, truth, mask, directions) for shading in maps]).mean()
    return loss + config.shading_weight * terms["shading_loss"], terms


def plain_normal_loss(
    config: NormalTraining, normals: Tensor, truth: Tensor, mask: Tensor
) -> tuple[Tensor, dict[str, Tensor]]:
    """Return the loss of estimated normals alone, and named parts; see `normal_loss`."""
    masked = masked_normal_loss(normals, truth, mask)
    loss, terms = masked, {"masked_loss": masked}
    if config.loss == "chord":
        loss = chord_normal_loss(normals, truth, mask)
    elif config.loss == "faithful":
        loss = faithful_normal_loss(normals, truth)
    if config.gradient_weight:
        terms["gradient_loss"] = normal_gradient_loss(normals, truth, mask)
        loss = loss + config.gradient_weight * terms["gradient_loss"]
    return loss, terms


_BENT, _SCATTERED, _UNEVEN = 0.10, 0.06, 0.08
"""How far `disturbed` moves lights: all alike, each by itself, and in intensity."""
_STRAYED = math.degrees(math.sqrt(math.pi / 2 * (_BENT**2 + _SCATTERED**2)))
"""Mean error of directions that `disturbed` moves by the share 1: both parts move them across by Gaussian steps."""


def disturbed(lights: Lights, seeds: list[int], limit: float) -> Lights:
    """Return lights with errors like those of estimated ones, drawn for each scene.

    A linear map bends the directions of a scene alike, as a relief that is taken too flat or too deep does; each light
    strays by itself; intensities err with the direction, and by themselves. A scene's share of all that is drawn
    evenly from 0 to `limit`.
    """
    directions, intensities, expected = [], [], []
    for scene, seed in enumerate(seeds):
        rng = generator(seed, "light_error")
        share, count = rng.uniform(0.0, limit), lights.directions.shape[1]
        bend = np.eye(3) + share * _BENT * rng.standard_normal((3, 3))
        own = share * _SCATTERED * rng.standard_normal((count, 3))
        slope, noise = share * _UNEVEN * rng.standard_normal(3), share * _UNEVEN * rng.standard_normal(count)
        given = lights.directions[scene].cpu().numpy()
        directions.append(given @ bend.T + own)
        intensities.append(np.exp(given @ slope + noise))
        expected.append(np.full(count, share * _STRAYED))
    moved = torch.from_numpy(np.stack(directions)).to(lights.directions)
    factors = torch.from_numpy(np.stack(intensities)).to(lights.intensities)
    errors = torch.from_numpy(np.stack(expected)).to(lights.intensities)
    return Lights(functional.normalize(moved, dim=-1), lights.intensities * factors, expected=errors)


def lighting_options(model: str, config: LightingTraining) -> dict[str, Any]:
    """Return the options of a lighting network that the configuration decides."""
    low, high = config.intensity_range()
    values = {
        "direction_classes": config.direction_classes,
        "intensity_classes": config.intensity_classes,
        "intensity_range": [low, high],
    }
    return {name: value for name, value in values.items() if name in registry.network_options(model)}


def freeze(model: TrainedModel) -> TrainedModel:
    """Make a trained model's weights constant."""
    model.network.requires_grad_(False).eval()
    return model


def described(model: TrainedModel) -> dict[str, Any]:
    """Return what tells one trained model from another."""
    return {"model": model.name, **{key: model.metadata.get(key) for key in ("data", "step", "metrics")}}


def normal_error(normals: Tensor, batch: Batch) -> float:
    """Return the mean angular error in degrees of normals (B, 3, H, W) over the mask's pixels."""
    inside = batch.mask[:, 0].bool()
    pairs = [tensor.permute(0, 2, 3, 1)[inside].cpu().numpy() for tensor in (normals, batch.normals)]
    return float(angle_degrees(*pairs).mean()) if len(pairs[0]) else 0.0


def light_errors(lights: Lights, batch: Batch, suffix: str) -> dict[str, float]:
    """Return direction and intensity errors, each averaged over the scenes."""
    directions, intensities = (tensor.float().cpu().numpy() for tensor in lights[:2])
    true_directions, true_intensities = batch.directions.cpu().numpy(), batch.intensities.cpu().numpy()
    errors = [intensity_error(*pair) for pair in zip(intensities, true_intensities, strict=True)]
    return {
        f"direction_mae{suffix}": direction_mae(directions, true_directions),
        f"intensity_error{suffix}": float(np.mean(errors)),
    }


def crop(tensor: Tensor, corner: Tensor, side: int) -> Tensor:
    """Cut (B, ..., S, S) to (B, ..., side, side) at each sample's own corner (B, 2)."""
    if tensor.shape[-1] == side:
        return tensor
    corners = corner.tolist()
    return torch.stack([item[..., r : r + side, c : c + side] for item, (r, c) in zip(tensor, corners, strict=True)])
