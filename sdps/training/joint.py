"""Stages of models that depend on two others: the second lighting pass, and fine-tuning a pair together."""

from dataclasses import replace
from typing import Any, cast

import torch
from torch import Tensor, nn

from render.shared.errors import InputError
from sdps.core.losses import masked_normal_loss
from sdps.data.dataset import Batch, SampleOptions
from sdps.models.base import LightingNetwork, Lights, NormalNetwork, Observations
from sdps.models.checkpoint import TrainedModel
from sdps.models.lcnet import INPUT_SIZE, resize_input
from sdps.models.lighting_variants import LCNetSecond
from sdps.training.stages import (
    LightingStage,
    Part,
    Stage,
    crop,
    described,
    freeze,
    light_errors,
    normal_error,
    normal_loss,
)
from sdps.training.training_config import JointTraining, LightingTraining


class SecondStage(LightingStage):
    """A second lighting pass learns from the normals and lights of a frozen first pass.

    Args:
        config: The run's configuration.
        lighting, normals: The first pass.
        model: Name in the registry.
        name: Name of the run.

    Raises:
        InputError: a size other than that of the first pass.
    """

    def __init__(
        self,
        config: LightingTraining,
        lighting: TrainedModel,
        normals: TrainedModel,
        *,
        model: str = "lcnet-second",
        name: str | None = None,
    ) -> None:
        if config.size != INPUT_SIZE:
            raise InputError(f"size must be {INPUT_SIZE} for {model}, as its first pass has it, got {config.size}")
        super().__init__(config, model=model, name=name)
        self.lighting, self.normals = freeze(lighting), freeze(normals)

    def frozen(self) -> list[nn.Module]:
        return [self.lighting.network, self.normals.network]

    def origin(self) -> dict[str, Any]:
        """Record the first pass."""
        return {"lighting": described(self.lighting), "normals": described(self.normals)}

    def predict(self, batch: Batch) -> Any:
        """Return the prediction that knows the first pass's normals and shading."""
        return self.network(batch.images, batch.mask, self.context(batch))

    @torch.no_grad()
    def context(self, batch: Batch) -> Tensor:
        """Return normals and shading (B, Q, 4, S, S) of the first pass."""
        images, mask = resize_input(batch.images, batch.mask)
        network = cast(LightingNetwork, self.lighting.network)
        lights = network.lights(network(images, mask), "expectation")
        estimator = cast(NormalNetwork, self.normals.network)
        return LCNetSecond.context(estimator(estimator.observe(images, mask, lights)), mask, lights.directions)


class JointStage(Stage):
    """A trained pair is fine-tuned end to end: the normals' error reaches the lighting network through its lights.

    Args:
        config: The run's configuration.
        lighting, normals: The pair to start from.
        name: Name of the run.
    """

    config: JointTraining
    network: Any  # a ModuleDict of both, whose entries have no types
    goal = "normal_mae"

    def __init__(
        self, config: JointTraining, lighting: TrainedModel, normals: TrainedModel, *, name: str = "sdps-joint"
    ) -> None:
        self.lighting, self.normals = lighting, normals
        super().__init__(name, name, config, {})

    def build(self) -> nn.Module:
        pair = {"lighting": self.lighting.network, "normals": self.normals.network}
        return nn.ModuleDict(pair).requires_grad_(True)

    def parts(self, network: Any) -> list[Part]:
        """Return both networks, saved as `lcnet-joint` and `nenet-joint` by the names of the runs they start from."""
        pairs = zip((self.config.lights, self.config.normals), (self.lighting, self.normals), strict=True)
        return [
            Part(f"{run}-joint", model.name, network[key], model.options)
            for (run, model), key in zip(pairs, ("lighting", "normals"), strict=True)
        ]

    def origin(self) -> dict[str, Any]:
        """Record the pair at the start."""
        return {"lighting": described(self.lighting), "normals": described(self.normals)}

    def sample_options(self) -> SampleOptions:
        return replace(super().sample_options(), crop=self.config.crop, min_object=self.config.min_object)

    def _pass(self, batch: Batch, side: int) -> tuple[Any, Lights, Observations]:
        """Return the lighting prediction, its lights, and what the normal network sees of the crops."""
        lighting, normals = self.network["lighting"], self.network["normals"]
        prediction = lighting(*resize_input(batch.images, batch.mask))
        lights = lighting.lights(prediction, self.config.read_out)
        images, mask = (crop(part, batch.corner, side) for part in (batch.images, batch.mask))
        return prediction, lights, normals.observe(images, mask, lights)

    def loss(self, batch: Batch) -> tuple[Tensor, dict[str, Tensor]]:
        """Return the weighted sum of both stages' losses."""
        side = self.config.crop or self.config.size
        prediction, _, seen = self._pass(batch, side)
        mask, truth = (crop(part, batch.corner, side) for part in (batch.mask, batch.normals))
        loss, terms = normal_loss(self.config, self.network["normals"], seen, truth, mask, batch.directions)
        lighting = self.network["lighting"].loss(prediction, batch.directions, batch.intensities)["total"]
        total = self.config.normal_weight * loss + self.config.lighting_weight * lighting
        return total, terms | {"lighting_loss": lighting}

    def metrics(self, batch: Batch) -> dict[str, float]:
        """Return the normal MAE on whole images and the errors of the lights."""
        _, lights, seen = self._pass(batch, batch.images.shape[-1])
        normals = self.network["normals"](seen)
        values = {"loss": float(masked_normal_loss(normals, batch.normals, batch.mask))}
        return values | {"normal_mae": normal_error(normals, batch)} | light_errors(lights, batch, "")
