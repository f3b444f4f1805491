"""How models of each role are trained on a batch: the network, its loss and its validation metrics.

The trainer (`sdps.training.trainer`) knows nothing else about them.
"""

import math
from abc import ABC, abstractmethod
from dataclasses import replace
from typing import Any, cast, get_args

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from render.shared.seeds import derive_seed, generator
from sdps.core.lighting import ReadOut
from sdps.core.losses import NormalCriterion, masked_normal_loss
from sdps.core.metrics import angle_degrees, direction_mae, intensity_error
from sdps.data.dataset import Batch, SampleOptions
from sdps.models import registry
from sdps.models.base import FusionNetwork, LightingNetwork, Lights, Placement, Truth
from sdps.models.checkpoint import TrainedModel
from sdps.models.lcnet import resize_input
from sdps.models.registry import TRUE_LIGHTS
from sdps.training.training_config import LightingTraining, NormalTraining, TrainingConfig


class Stage(ABC):
    """A network in training. Subclasses give `loss` and `metrics`.

    Args:
        name: The run's name, which also names the weights file.
        model: Name in the registry.
        config: The run's configuration.
        options: Options of the network.

    Attributes:
        added: Names of weights that the start it was given lacks.
    """

    goal = "direction_mae"
    """The metric, lower being better, by which the best weights are kept."""

    def __init__(self, name: str, model: str, config: TrainingConfig, options: dict[str, Any]) -> None:
        self.name, self.model, self.config, self.options = name, model, config, options
        self.added: frozenset[str] = frozenset()
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(derive_seed(config.seed, "weights", model))
            self.network: nn.Module = registry.create(model, **options)

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

    def sample_options(self) -> SampleOptions:
        """Return how training samples are made."""
        config = self.config
        return SampleOptions(
            seed=config.seed, images=config.images, fewest=config.fewest_images, size=config.size,
            rescale=config.rescale, augmentation=config.augmentation,
        )  # fmt: skip

    def validation_options(self) -> SampleOptions:
        """Return how validation samples are made: whole images in the pose they were rendered."""
        options = self.sample_options()
        augmentation = replace(options.augmentation, symmetries=False, biased=0.0, frontal=0.0)
        images = self.config.validation_images or options.images
        return replace(options, images=images, fewest=0, crop=0, rescale=False, augmentation=augmentation)

    def validations(self) -> dict[str, SampleOptions]:
        """Return what is validated on, by how its metrics end: where light is mixed, single lamps as well."""
        options = self.validation_options()
        mixed = options.augmentation.mixed
        if mixed is None or not mixed.single:
            return {"": options}
        alone = replace(options.augmentation, mixed=replace(mixed, single=1.0, surrounded=0.0))
        return {"": options, "_single": replace(options, augmentation=alone)}

    def draw_count(self, batch: Batch) -> Batch:
        """Return a batch with as many images as `fewest_images` lets be drawn; on a device they were drawn so."""
        few = self.config.fewest_images
        return leave_out(batch, few) if few and not self.config.resident else batch

    @abstractmethod
    def loss(self, batch: Batch) -> tuple[Tensor, dict[str, Tensor]]:
        """Return the scalar to minimise, and named scalars to log."""

    @abstractmethod
    def metrics(self, batch: Batch) -> dict[str, float]:
        """Return validation metrics averaged over the batch's scenes; called without gradients."""


class LightingStage(Stage):
    """Models that find lights from images and mask."""

    config: LightingTraining
    network: LightingNetwork

    def __init__(self, config: LightingTraining, *, model: str = "lcnet", name: str | None = None) -> None:
        super().__init__(name or model, model, config, lighting_options(model, config))

    def loss(self, batch: Batch) -> tuple[Tensor, dict[str, Tensor]]:
        """Return the network's own loss."""
        batch = self.draw_count(batch)
        terms = self.network.loss(self.network(batch.images, batch.mask), true_lights(batch))
        return terms["total"], {f"{name}_loss": value for name, value in terms.items() if name != "total"}

    def metrics(self, batch: Batch) -> dict[str, float]:
        """Return the loss, and direction and intensity errors of every read-out."""
        prediction = self.network(batch.images, batch.mask)
        values = {"loss": float(self.network.loss(prediction, true_lights(batch))["total"])}
        for how in get_args(ReadOut):
            suffix = "" if how == "centre" else f"_{how}"
            values |= light_errors(self.network.read_lights(prediction, how), batch, suffix)
        return values


class NormalStage(Stage):
    """Models that give normals, under the lights of a frozen lighting model, true ones, or none.

    Args:
        config: The run's configuration.
        lighting: Trained lighting model; may be absent for true lights, or a model that is given none.
        model: Name in the registry.
        name: Name of the run.
    """

    config: NormalTraining
    network: FusionNetwork
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
        return {"lights": self.source, "lighting": model_identity(self.lighting)}

    def sample_options(self) -> SampleOptions:
        return replace(super().sample_options(), crop=self.config.crop, min_object=self.config.min_object)

    @torch.no_grad()
    def lights(self, batch: Batch) -> Lights | None:
        """Return the lights the network is given."""
        if not self.source:
            return None
        if self.lighting is None:
            return true_lights(batch)
        network = cast(LightingNetwork, self.lighting.network)
        prediction = network(*resize_input(batch.images, batch.mask))
        return network.read_lights(prediction, self.config.read_out).with_errors()

    def training_lights(self, batch: Batch) -> Lights | None:
        """Return the lights given in training: with drawn errors, then some of the way to the true ones."""
        lights, limit = self.lights(batch), self.config.light_blend
        if lights is not None and self.config.light_error:
            lights = disturb(lights, batch.seed.tolist(), self.config.light_error)
        if self.lighting is None or lights is None or not limit:
            return lights
        drawn = [min(generator(seed, "light_blend").uniform(0.0, limit), 1.0) for seed in batch.seed.tolist()]
        share = torch.tensor(drawn, device=batch.images.device)[:, None]  # (B, 1)
        directions = torch.lerp(lights.directions.float(), batch.directions, share[..., None])  # (B, Q, 3)
        intensities = torch.lerp(lights.intensities.float(), batch.intensities, share)  # (B, Q)
        found = torch.zeros_like(batch.nearness) if lights.nearness is None else lights.nearness.float()
        nearness = torch.lerp(found, batch.nearness, share)
        error = None if lights.expected_error is None else (1.0 - share) * lights.expected_error.float()
        flat = torch.zeros_like(batch.covariance) if lights.covariance is None else lights.covariance.float()
        covariance = torch.lerp(flat, batch.covariance, share[..., None, None])
        directions = functional.normalize(directions, dim=-1)
        return Lights(directions, intensities, expected_error=error, nearness=nearness, covariance=covariance)

    def loss(self, batch: Batch) -> tuple[Tensor, dict[str, Tensor]]:
        """Return the network's own loss on the crops, as configured."""
        batch = self.draw_count(batch)
        lights, config = self.training_lights(batch), self.config
        side = config.crop or config.size
        images, mask, normals = (crop(part, batch.corner, side) for part in (batch.images, batch.mask, batch.normals))
        placement = Placement(*(crop(part, batch.corner, side) for part in flatten_some(placed(batch), batch.seed)))
        seen = self.network.observe(images, mask, lights, placement=placement)
        weights = config.gradient_weight, config.lighting_weight, config.expected_weight
        truth = Truth(normals, mask, batch.directions, batch.intensities)
        return self.network.loss(seen, truth, NormalCriterion(config.loss, *weights))

    def metrics(self, batch: Batch) -> dict[str, float]:
        """Return the normal MAE on whole images, and the errors of lights that a model found or that were drawn."""
        lights = self.lights(batch)
        normals = self.network(self.network.observe(batch.images, batch.mask, lights, placement=placed(batch)))
        values = {
            "loss": float(masked_normal_loss(normals, batch.normals, batch.mask)),
            "normal_mae": normal_error(normals, batch),
        }
        if lights is not None and self.config.light_error:
            drawn = disturb(lights, batch.seed.tolist(), self.config.light_error)
            seen = self.network.observe(batch.images, batch.mask, drawn, placement=placed(batch))
            values |= light_errors(drawn, batch, "_drawn")
            values["normal_mae_drawn"] = normal_error(self.network(seen), batch)
        return values | self.light_scores(lights, batch)

    def light_scores(self, lights: Lights | None, batch: Batch) -> dict[str, float]:
        """Return the errors of the lights the network is given; none of those that are the true ones."""
        return {} if lights is None or self.lighting is None else light_errors(lights, batch, "")


_FLAT = 0.3
"""Share of the training samples whose depth is not known."""
_BENT, _SCATTERED, _UNEVEN = 0.10, 0.06, 0.08
"""How far `disturb` moves lights: all alike, each by itself, and in intensity."""
_STRAYED = math.degrees(math.sqrt(math.pi / 2 * (_BENT**2 + _SCATTERED**2)))
"""Mean error of directions that `disturb` moves by the share 1: both parts move them across by Gaussian steps."""


def disturb(lights: Lights, seeds: list[int], limit: float) -> Lights:
    """Return lights with errors like those of estimated ones, drawn for each scene.

    A linear map bends the directions of a scene alike, as a relief that is taken too flat or too deep does; each light
    strays by itself; intensities err with the direction, and by themselves. A scene's share of all that is drawn
    evenly from 0 to `limit`.
    """
    bent, strengths, expected = [], [], []
    for scene, seed in enumerate(seeds):
        rng = generator(seed, "light_error")
        share, count = rng.uniform(0.0, limit), lights.directions.shape[1]
        bend = np.eye(3) + share * _BENT * rng.standard_normal((3, 3))
        own = share * _SCATTERED * rng.standard_normal((count, 3))
        slope, noise = share * _UNEVEN * rng.standard_normal(3), share * _UNEVEN * rng.standard_normal(count)
        given = lights.directions[scene].cpu().numpy()
        bent.append(given @ bend.T + own)
        strengths.append(np.exp(given @ slope + noise))
        expected.append(np.full(count, share * _STRAYED))
    moved = torch.from_numpy(np.stack(bent)).to(lights.directions)
    factors = torch.from_numpy(np.stack(strengths)).to(lights.intensities)
    errors = torch.from_numpy(np.stack(expected)).to(lights.intensities)
    directions = functional.normalize(moved, dim=-1)
    return lights._replace(directions=directions, intensities=lights.intensities * factors, expected_error=errors)


def leave_out(batch: Batch, fewest: int) -> Batch:
    """Return a batch with so many images of each scene or more, as its first scene's seed draws."""
    most = batch.images.shape[1]
    count = int(generator(int(batch.seed[0]), "images").integers(min(fewest, most), most, endpoint=True))
    names = "images", "directions", "intensities", "nearness", "covariance"
    some = {name: getattr(batch, name)[:, :count] for name in names}
    return batch._replace(**some)


def placed(batch: Batch) -> Placement:
    """Return where the pixels of a batch's scenes lie."""
    return Placement(batch.places, batch.sights)


def flatten_some(placement: Placement, seeds: Tensor) -> Placement:
    """Return where pixels are taken to lie: of some scenes nothing is known of their depth yet, as at first in use."""
    drawn = [float(generator(seed, "flat").random() >= _FLAT) for seed in seeds.tolist()]
    known = torch.tensor([[1.0, 1.0, share] for share in drawn]).to(placement.places)  # (B, 3)
    return placement._replace(places=placement.places * known[..., None, None])


def true_lights(batch: Batch) -> Lights:
    """Return the lights of a batch's scenes."""
    return Lights(batch.directions, batch.intensities, nearness=batch.nearness, covariance=batch.covariance)


def lighting_options(model: str, config: LightingTraining) -> dict[str, Any]:
    """Return the options of a lighting network that the configuration decides."""
    low, high = config.intensity_range()
    values = {
        "direction_classes": config.direction_classes,
        "intensity_classes": config.intensity_classes,
        "intensity_range": [low, high],
    }
    return {name: value for name, value in values.items() if name in registry.network_options(model)} | config.options


def freeze(model: TrainedModel) -> TrainedModel:
    """Make a trained model's weights constant."""
    model.network.requires_grad_(False).eval()
    return model


def model_identity(model: TrainedModel) -> dict[str, Any]:
    """Return what distinguishes one trained model from another."""
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
    values = {
        f"direction_mae{suffix}": direction_mae(directions, true_directions),
        f"intensity_error{suffix}": float(np.mean(errors)),
    }
    if lights.nearness is not None:
        values[f"nearness_error{suffix}"] = float((lights.nearness.float() - batch.nearness).abs().mean())
    if lights.covariance is not None:
        off = (lights.covariance.float() - batch.covariance).square().sum(dim=(-2, -1)).sqrt()
        values[f"covariance_error{suffix}"] = float(off.mean())
    return values


def crop(tensor: Tensor, corner: Tensor, side: int) -> Tensor:
    """Cut (B, ..., S, S) to (B, ..., side, side) at each sample's own corner (B, 2)."""
    if tensor.shape[-1] == side:
        return tensor
    corners = corner.tolist()
    return torch.stack([item[..., r : r + side, c : c + side] for item, (r, c) in zip(tensor, corners, strict=True)])
