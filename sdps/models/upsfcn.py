"""UPS-FCN and the paper's larger single-stage networks: images to normals, with no lights in between (B5 to B9)."""

from typing import NamedTuple

import torch
from torch import Tensor, nn

from sdps.core.lighting import LightClasses
from sdps.core.losses import NormalCriterion, class_loss
from sdps.models.base import Observations, Truth
from sdps.models.blocks import conv, initialise, max_over_images
from sdps.models.lcnet import LightingLogits, head
from sdps.models.nenet import MaxFusionNet

_WIDTHS = (64, 128, 256)


class UPSFCN(MaxFusionNet):
    """PS-FCN without lights: images as they are, of unknown intensities.

    `deep` and `width` are reconstructions that meet the published counts; the supplement with the tables is not
    available. `width=1.7` widens every layer alike (6.39 M; published 6.4 M). `deep` adds six convolutions to the
    extractor at quarter size and two to the regressor at half size (6.04 M; published 6.1 M).

    Args:
        width: Factor on the channels of every layer.
        deep: More layers.
        use_mask: Give the object mask as a fourth input channel.
    """

    needs_lights = False

    def __init__(self, *, width: float = 1.0, deep: bool = False, use_mask: bool = False) -> None:
        first, second, third = (round(width * channels) for channels in _WIDTHS)
        super().__init__(3 + use_mask, widths=(first, second, third), deeper=(6, 2) if deep else (0, 0))
        self.needs_mask = use_mask
        initialise(self)


class NormalsAndLights(NamedTuple):
    """What `UPSFCNLight` predicts while it is trained."""

    normals: Tensor  # (B, 3, H, W)
    lights: LightingLogits


class UPSFCNLight(MaxFusionNet):
    """UPS-FCN that also learns to predict the lights, as additional supervision (B8).

    A reconstruction: the 3-channel UPS-FCN plus, on each image's feature and the fused one, six convolutions of
    stride 2 and LCNet's three heads. 5.80 M parameters; published 5.7 M. The lights are not used at test.

    Args:
        direction_classes: K_d.
        intensity_classes: K_e.
        intensity_range: Relative intensities the classes cover.
    """

    needs_lights = False

    def __init__(
        self,
        *,
        direction_classes: int = 36,
        intensity_classes: int = 20,
        intensity_range: tuple[float, float] = (0.2, 2.0),
    ) -> None:
        super().__init__(3)
        low, high = intensity_range
        self.classes = LightClasses(directions=direction_classes, intensities=intensity_classes, low=low, high=high)
        self.lighting = nn.Sequential(*(conv(256, 256, stride=2) for _ in range(6)))  # 1 x 1 for 128 x 128 images
        self.azimuth = head(256, direction_classes)
        self.elevation = head(256, direction_classes)
        self.intensity = head(256, intensity_classes)
        initialise(self)

    def with_lights(self, seen: Observations) -> NormalsAndLights:
        """Return normals and the logits of every image's light."""
        local = self.local(seen)  # (B, Q, 128, H/2, W/2)
        fused = max_over_images(local)
        both = torch.cat([local, fused[:, None].expand_as(local)], dim=2)
        vector = self.lighting(both.flatten(0, 1)).mean(dim=(2, 3), keepdim=True)  # of larger images: their average
        heads = (self.azimuth, self.elevation, self.intensity)
        logits = LightingLogits(*(part(vector).flatten(1).unflatten(0, local.shape[:2]) for part in heads))
        return NormalsAndLights(self.regress(fused), logits)

    def loss(self, seen: Observations, truth: Truth, criterion: NormalCriterion) -> tuple[Tensor, dict[str, Tensor]]:
        """Return the loss of the normals plus, weighted, that of the lights."""
        normals, logits = self.with_lights(seen)
        loss, terms = criterion(normals, truth.normals, truth.mask)
        terms["lighting_loss"] = self.lighting_loss(logits, truth.directions, truth.intensities)
        return loss + criterion.lighting_weight * terms["lighting_loss"], terms

    def lighting_loss(self, logits: LightingLogits, directions: Tensor, intensities: Tensor) -> Tensor:
        """Return the summed cross-entropies of the true classes of directions (B, Q, 3) and intensities (B, Q)."""
        targets = self.classes.encode(directions, intensities)
        return torch.stack([class_loss(*pair) for pair in zip(logits, targets, strict=True)]).sum()
