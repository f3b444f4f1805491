"""LCNet, the Lighting Calibration Network: images and mask to light directions and intensities.

Legend: B scenes, Q images of a scene, K classes.
"""

from typing import Any, NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional

from sdps.core.lighting import LightClasses, ReadOut
from sdps.core.losses import class_loss
from sdps.models.base import LightingNetwork, Lights
from sdps.models.blocks import conv, initialise, max_over_images

INPUT_SIZE = 128
EARLY_SIZE = 64
"""A quarter of the work: for the first part of training. The last convolutions then see 4x4 features, 2x2, 1x1, 1x1."""


class LightingLogits(NamedTuple):
    """Unnormalised log-probabilities of the light classes of every image."""

    azimuth: Tensor  # (B, Q, K_d)
    elevation: Tensor  # (B, Q, K_d)
    intensity: Tensor  # (B, Q, K_e)


class LightingTrunk(LightingNetwork):
    """The layers that LCNet and its variants share: extractor, local-global fusion, and convolutions down to 1x1.

    Args:
        use_mask: The object mask is a fourth input channel.
        use_global: Concatenate the feature shared by all images to each image's own.
    """

    def __init__(self, *, use_mask: bool, use_global: bool) -> None:
        super().__init__()
        self.use_mask, self.use_global = use_mask, use_global
        self.extractor = nn.Sequential(
            conv(3 + use_mask, 64, stride=2),  # 64 x 64
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

    def encode(self, images: Tensor, mask: Tensor) -> Tensor:
        """Return the local features (B, Q, F, 8, 8) of images (B, Q, 3, 128, 128); half of both sides is possible."""
        assert images.shape[-2:] in {(side, side) for side in (EARLY_SIZE, INPUT_SIZE)}, images.shape
        inputs = images
        if self.use_mask:
            inputs = torch.cat([images, mask[:, None].expand(-1, images.shape[1], -1, -1, -1)], dim=2)
        return self.extractor(inputs.flatten(0, 1)).unflatten(0, images.shape[:2])

    def fuse(self, local: Tensor, shared: Tensor | None) -> Tensor:
        """Return one vector per image, (B Q, F', 1, 1); arguments as of `predict`."""
        if not self.use_global:
            return self.classifier(local.flatten(0, 1))
        if shared is None:
            shared = max_over_images(local, keepdim=True)
        # The first convolution sees [local, shared]. What it makes of the shared half is the same for every image of a
        # scene, so it is computed once per scene and added.
        begin: Any = self.classifier[0]
        (first, activation), rest = begin, self.classifier[1:]
        width = local.shape[2]
        own = functional.conv2d(local.flatten(0, 1), first.weight[:, :width], first.bias, padding=1)
        common = functional.conv2d(shared.flatten(0, 1), first.weight[:, width:], padding=1)  # (B, F', 8, 8)
        own = own.unflatten(0, local.shape[:2]) + common[:, None]
        return rest(activation(own.flatten(0, 1)))


def head(inputs: int, outputs: int) -> nn.Sequential:
    """Two fully connected layers, written as 1x1 convolutions on the 1x1 map."""
    return nn.Sequential(conv(inputs, 64, kernel=1), nn.Conv2d(64, outputs, 1))


class LCNet(LightingTrunk):
    """Classifies the light of every image from its local feature and the maximum over all images (SDPS-Net, sec. 4.1).

    Args:
        direction_classes: K_d, classes of azimuth and of elevation.
        intensity_classes: K_e.
        intensity_range: Relative intensities the classes cover.
        use_mask: Give the object mask as a fourth input channel (off: the paper's ablation A2).
        use_global: Concatenate the feature shared by all images (off: the paper's ablation A3).
    """

    def __init__(
        self,
        *,
        direction_classes: int = 36,
        intensity_classes: int = 20,
        intensity_range: tuple[float, float] = (0.2, 2.0),
        use_mask: bool = True,
        use_global: bool = True,
    ) -> None:
        super().__init__(use_mask=use_mask, use_global=use_global)
        low, high = intensity_range
        self.classes = LightClasses(directions=direction_classes, intensities=intensity_classes, low=low, high=high)
        self.azimuth = head(256, direction_classes)
        self.elevation = head(256, direction_classes)
        self.intensity = head(256, intensity_classes)
        initialise(self)

    def predict(self, local: Tensor, shared: Tensor | None = None) -> LightingLogits:
        """Return the class logits of every image."""
        feature = self.fuse(local, shared)
        heads = (self.azimuth, self.elevation, self.intensity)
        return LightingLogits(*(part(feature).flatten(1).unflatten(0, local.shape[:2]) for part in heads))

    def loss(self, prediction: LightingLogits, truth: Lights) -> dict[str, Tensor]:
        """Return the cross-entropies of the true classes and their sum (SDPS-Net, eq. 2)."""
        targets = self.classes.encode(truth.directions, truth.intensities)
        pairs = zip(prediction._asdict().items(), targets, strict=True)
        terms = {name: class_loss(logits, target) for (name, logits), target in pairs}
        return {"total": torch.stack(list(terms.values())).sum(), **terms}

    def read_lights(self, prediction: LightingLogits, read_out: ReadOut = "centre") -> Lights:
        """Return the lights of the likeliest classes, or another read-out of the class probabilities."""
        directions, intensities = self.classes.read_out(*prediction, read_out)
        peaks = [values.float().softmax(-1).amax(-1) for values in (prediction.azimuth, prediction.elevation)]
        return Lights(directions, intensities, peaks[0] * peaks[1])


def resize_input(images: Tensor, mask: Tensor) -> tuple[Tensor, Tensor]:
    """Bring images (B, Q, 3, H, W) and mask (B, 1, H, W) to the 128x128 that LCNet's last layers need.

    Bilinear, without keeping the aspect ratio, as the authors' test code, but averaged when shrinking, which is what a
    rendered 128-pixel image is.
    """
    size = (INPUT_SIZE, INPUT_SIZE)
    if images.shape[-2:] == size:
        return images, mask
    shrink = max(images.shape[-2:]) > INPUT_SIZE
    resized = functional.interpolate(images.flatten(0, 1), size, mode="bilinear", antialias=shrink)
    mask = functional.interpolate(mask, size, mode="bilinear", antialias=shrink)
    return resized.unflatten(0, images.shape[:2]), mask
