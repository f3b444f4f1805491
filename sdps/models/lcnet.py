"""LCNet, the Lighting Calibration Network: images and mask to light directions and intensities.

Legend: B scenes, Q images of a scene, K classes.
"""

from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional

from sdps.models.blocks import conv, initialise

INPUT_SIZE = 128


class LightingLogits(NamedTuple):
    """Unnormalised log-probabilities of the light classes of every image."""

    azimuth: Tensor  # (B, Q, K_d)
    elevation: Tensor  # (B, Q, K_d)
    intensity: Tensor  # (B, Q, K_e)


def _head(classes: int) -> nn.Sequential:
    """Two fully connected layers, written as 1x1 convolutions on the 1x1 map."""
    return nn.Sequential(conv(256, 64, kernel=1), nn.Conv2d(64, classes, 1))


class LCNet(nn.Module):
    """Classifies the light of every image from its local feature and the maximum over all images.

    Args:
        direction_classes: K_d, classes of azimuth and of elevation.
        intensity_classes: K_e.
        use_mask: Give the object mask as a fourth input channel (off: the paper's ablation).
        use_global: Concatenate the feature shared by all images (off: the paper's ablation).
    """

    def __init__(
        self,
        *,
        direction_classes: int = 36,
        intensity_classes: int = 20,
        use_mask: bool = True,
        use_global: bool = True,
    ) -> None:
        super().__init__()
        self.use_mask = use_mask
        self.use_global = use_global
        self.extractor = nn.Sequential(
            conv(4 if use_mask else 3, 64, stride=2),  # 64 x 64
            conv(64, 128, stride=2),  # 32 x 32
            conv(128, 128),
            conv(128, 128, stride=2),  # 16 x 16
            conv(128, 128),
            conv(128, 256, stride=2),  # 8 x 8
            conv(256, 256),
        )
        self.classifier = nn.Sequential(
            conv(512 if use_global else 256, 256),
            conv(256, 256, stride=2),  # 4 x 4
            conv(256, 256, stride=2),  # 2 x 2
            conv(256, 256, stride=2),  # 1 x 1
        )
        self.azimuth = _head(direction_classes)
        self.elevation = _head(direction_classes)
        self.intensity = _head(intensity_classes)
        initialise(self)

    def forward(
        self,
        images: Tensor,  # (B, Q, 3, 128, 128)
        mask: Tensor,  # (B, 1, 128, 128)
    ) -> LightingLogits:
        """Return the class logits of every image; the order of the images does not matter."""
        scenes, count = images.shape[:2]
        assert images.shape[-2:] == (INPUT_SIZE, INPUT_SIZE), images.shape
        inputs = images
        if self.use_mask:
            inputs = torch.cat([images, mask[:, None].expand(-1, count, -1, -1, -1)], dim=2)
        local = self.extractor(inputs.flatten(0, 1)).unflatten(0, (scenes, count))  # (B, Q, 256, 8, 8)
        if self.use_global:
            shared = local.amax(dim=1, keepdim=True).expand_as(local)
            local = torch.cat([local, shared], dim=2)  # (B, Q, 512, 8, 8)
        feature = self.classifier(local.flatten(0, 1))  # (B Q, 256, 1, 1)
        return LightingLogits(
            *(
                head(feature).flatten(1).unflatten(0, (scenes, count))
                for head in (self.azimuth, self.elevation, self.intensity)
            )
        )


def resize_input(images: Tensor, mask: Tensor, antialias: bool = True) -> tuple[Tensor, Tensor]:
    """Bring images (B, Q, 3, H, W) and mask (B, 1, H, W) to the 128x128 that LCNet's last layers need.

    Bilinear, without keeping the aspect ratio, as the authors' test code. `antialias` averages when
    shrinking, which is what a rendered 128-pixel image is; the authors' code does not.
    """
    size = (INPUT_SIZE, INPUT_SIZE)
    if images.shape[-2:] == size:
        return images, mask
    shrink = antialias and max(images.shape[-2:]) > INPUT_SIZE
    resized = functional.interpolate(images.flatten(0, 1), size, mode="bilinear", antialias=shrink)
    mask = functional.interpolate(mask, size, mode="bilinear", antialias=shrink)
    return resized.unflatten(0, images.shape[:2]), mask
