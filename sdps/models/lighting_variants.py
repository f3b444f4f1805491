"""Variants of LCNet: the paper's regression baseline, and one that goes beyond the paper."""

from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional

from sdps.core.lighting import LightClasses, ReadOut
from sdps.core.losses import soft_class_loss
from sdps.models.base import Lights
from sdps.models.blocks import initialise
from sdps.models.lcnet import LCNet, LightingLogits, LightingTrunk, head

_LEAST_INTENSITY = 0.02
"""Regressed intensities are kept above this, a tenth of the least drawn in training, before dividing by them."""

_EXPECTATION_WEIGHT = 4.0
"""Weight of the errors of the expected light in the loss of `LCNetSoft`."""


class RegressedLights(NamedTuple):
    """What `LCNetReg` predicts."""

    directions: Tensor  # (B, Q, 3) float32, unit
    intensities: Tensor  # (B, Q) float32, any sign


class LCNetReg(LightingTrunk):
    """Regresses directions and intensities directly: the paper's baseline A1.

    A reconstruction: the paper leaves the design to a supplement. The trunk is LCNet's; the heads are 64 -> 3 (brought
    to unit length) and 64 -> 1; the loss is the one the authors' code keeps for regressed lights, (1 - cosine) plus the
    squared error of the intensity. 4,387,524 parameters; with its normal network the paper gives 6.6 M.
    """

    def __init__(self, *, intensity_range: tuple[float, float] = (0.2, 2.0)) -> None:
        super().__init__(use_mask=True, use_global=True)
        self.classes = LightClasses(low=intensity_range[0], high=intensity_range[1])
        self.direction = head(256, 3)
        self.intensity = head(256, 1)
        initialise(self)

    def predict(self, local: Tensor, shared: Tensor | None = None) -> RegressedLights:
        """Return unit directions and intensities, float32."""
        feature = self.fuse(local, shared).float()
        # Never under autocast: a direction rounded to bfloat16's 8 bits moves in steps of a fifth of a degree.
        with torch.autocast(feature.device.type, enabled=False):
            vectors, scalars = (part(feature).flatten(1) for part in (self.direction, self.intensity))
        directions = functional.normalize(vectors, dim=1).unflatten(0, local.shape[:2])
        return RegressedLights(directions, scalars[:, 0].unflatten(0, local.shape[:2]))

    def loss(self, prediction: RegressedLights, truth: Lights) -> dict[str, Tensor]:
        """Return 1 - cosine of the directions and the squared error of the intensities."""
        direction = (1.0 - (prediction.directions * truth.directions).sum(-1)).mean()
        intensity = (prediction.intensities - truth.intensities).square().mean()
        return {"total": direction + intensity, "direction": direction, "intensity": intensity}

    def read_lights(self, prediction: RegressedLights, read_out: ReadOut = "centre") -> Lights:
        """Return the regressed lights; there are no classes to read out."""
        return Lights(prediction.directions, prediction.intensities.clamp(min=_LEAST_INTENSITY))


class LCNetSoft(LCNet):
    """LCNet whose light is the expectation over its classes, and trained for that: no quantisation floor.

    The idea is GCNet's (Chen et al., ECCV 2020): a soft-argmax over the same classes. Labels share their weight between
    the two nearest classes, so that their expectation is the exact angle; to their cross-entropy come the chord between
    expected and true direction and the relative error of the expected intensity. Same layers as LCNet.
    """

    def loss(self, prediction: LightingLogits, truth: Lights) -> dict[str, Tensor]:
        """Return soft cross-entropies, the errors of the expectation, and their weighted sum."""
        targets = self.classes.encode_soft(truth.directions, truth.intensities)
        pairs = zip(prediction._asdict().items(), targets, strict=True)
        terms = {name: soft_class_loss(logits, target) for (name, logits), target in pairs}
        expected = self.read_lights(prediction)
        # The tiny constant keeps the gradient of the length finite where the estimate is perfect.
        chord = ((expected.directions - truth.directions).square().sum(-1) + 1e-8).sqrt().mean()
        relative = ((expected.intensities - truth.intensities).abs() / truth.intensities).mean()
        total = torch.stack(list(terms.values())).sum() + _EXPECTATION_WEIGHT * (chord + relative)
        return {"total": total, **terms, "chord": chord, "relative": relative}

    def read_lights(self, prediction: LightingLogits, read_out: ReadOut = "expectation") -> Lights:
        """Return the expectation over the classes, whichever read-out is asked for."""
        return super().read_lights(prediction, "expectation")
