"""What networks of one role have in common, so that any lighting network works with any normal network.

Legend: B scenes, Q images of a scene, H and W the image's sides.
"""

from abc import ABC, abstractmethod
from typing import Any, Literal, NamedTuple, get_args

import torch
from torch import Tensor, nn

from sdps.core.lighting import LightClasses, ReadOut
from sdps.core.symmetry import Symmetry
from sdps.models.blocks import max_over_images

Division = Literal["none", "norm", "max"]
"""What each pixel of the images is divided by; see `NormalNetwork`."""
DIVISIONS: tuple[Division, ...] = get_args(Division)

USUAL_LIGHT_ERROR = 6.0
"""Degrees to expect of the directions of lighting networks that tell no error themselves."""
_TINY = 1e-8
_SCALE_FLOOR = 1e-4
"""Added to what a pixel is divided by: far below any lit pixel, but keeps black ones from dividing by zero."""


class Lights(NamedTuple):
    """The light of every image."""

    directions: Tensor  # (B, Q, 3) float32, unit, from the surface to the light
    intensities: Tensor  # (B, Q) float32, positive, relative
    confidence: Tensor | None = None  # (B, Q) float32 in [0, 1], the product of the likeliest direction classes
    expected: Tensor | None = None  # (B, Q) float32, the error of the direction to expect, in degrees; None: not told

    def part(self, some: slice) -> "Lights":
        """Return the lights of some images."""
        sure, expected = (None if each is None else each[:, some] for each in (self.confidence, self.expected))
        return Lights(self.directions[:, some], self.intensities[:, some], sure, expected)

    def doubted(self) -> "Lights":
        """Return estimated lights with errors to expect, the usual ones where none are told."""
        if self.expected is not None:
            return self
        return self._replace(expected=torch.full_like(self.intensities, USUAL_LIGHT_ERROR))


class LightingNetwork(nn.Module, ABC):
    """Estimates the light of every image of a scene.

    `encode` looks at images one by one, `predict` at their features and the maximum over all of them, so that a caller
    can go through any number of images in chunks. Subclasses set `extractor` and `classes`.

    Attributes:
        use_mask: The mask is a fourth input channel.
        use_global: The feature shared by all images is seen beside each image's own.
        classes: The discretised lighting space.
    """

    use_mask: bool = True
    use_global: bool = True
    extractor: nn.Module
    classes: LightClasses

    def encode(
        self,
        images: Tensor,  # (B, Q, 3, 128, 128)
        mask: Tensor,  # (B, 1, 128, 128)
        context: Tensor | None = None,  # (B, Q, C, 128, 128), further channels
    ) -> Tensor:
        """Return the local features (B, Q, F, 8, 8)."""
        parts = [images]
        if self.use_mask:
            parts.append(mask[:, None].expand(-1, images.shape[1], -1, -1, -1))
        if context is not None:
            parts.append(context)
        inputs = torch.cat(parts, dim=2) if len(parts) > 1 else images
        return self.extractor(inputs.flatten(0, 1)).unflatten(0, images.shape[:2])

    @abstractmethod
    def predict(
        self,
        local: Tensor,  # (B, Q, F, 8, 8)
        shared: Tensor,  # (B, 1, F, 8, 8), the maximum over all images
    ) -> Any:
        """Return the prediction of every image, whatever form `loss` and `lights` want."""

    @abstractmethod
    def loss(
        self,
        prediction: Any,
        directions: Tensor,  # (B, Q, 3)
        intensities: Tensor,  # (B, Q)
    ) -> dict[str, Tensor]:
        """Return named losses, means over all images; `total` is the one to minimise."""

    @abstractmethod
    def lights(self, prediction: Any, read_out: ReadOut = "centre") -> Lights:
        """Return directions, intensities and confidence of a prediction."""

    def forward(self, images: Tensor, mask: Tensor, context: Tensor | None = None) -> Any:
        """Return the prediction of every image; the order of the images does not matter."""
        local = self.encode(images, mask, context)
        return self.predict(local, max_over_images(local, keepdim=True))


class MeetingNetwork(LightingNetwork):
    """A lighting network whose images meet more than once: `predict` is given all their features, and no maximum."""

    @abstractmethod
    def predict(self, local: Tensor, shared: Tensor | None = None) -> Any:
        """Return the prediction of every image from the features (B, Q, F, ...) of all of them."""

    def forward(self, images: Tensor, mask: Tensor, context: Tensor | None = None) -> Any:
        """Return the prediction of every image; the order of the images does not matter."""
        return self.predict(self.encode(images, mask, context))

    def predict_many(self, local: Tensor, seed: int) -> Any:
        """Return the prediction of a scene that may have more images than scenes of training.

        Args:
            local: (1, L, F, ...), features of all its images.
            seed: For what is drawn; another for each turned view.
        """
        return self.predict(local)


class Observations(NamedTuple):
    """What a normal network sees of a scene; made by `NormalNetwork.observe`."""

    images: Tensor  # (B, Q, 3, H, W), divided by the light intensities if the network is told the lights
    directions: Tensor | None = None  # (B, Q, 3)
    mask: Tensor | None = None  # (B, 1, H, W)
    light_errors: Tensor | None = None  # (B, Q), degrees to expect of the directions; None: they are exact


class NormalNetwork(nn.Module, ABC):
    """Estimates normals from any number of images, in any order, by the maximum over their features.

    `encode` followed by `regress` lets a caller keep a running maximum, so that memory does not grow with the number
    of images. A network with a `division` also needs each pixel's `brightness` over all images beforehand. One
    whose lights meet earlier needs all images at once (`KeepingNetwork`).

    Attributes:
        needs_lights: The network is told directions, and its images are divided by the intensities.
        needs_mask: The mask is an input channel.
        division: Images are divided by each pixel's `norm` over all lights and channels (PS-FCN (Norm.), Chen et al.,
            TPAMI 2020), or by its `max`imum (ESSENCE-Net), which takes albedo away and leaves shading.
        size_multiple: Sides of images must be multiples of it.
        reach: Pixels around a pixel that its normal depends on, at most: the halo of tiles.
        kept_bytes: Memory per pixel and image for what is kept until all images were seen.
    """

    needs_lights: bool = True
    needs_mask: bool = False
    division: Division = "none"
    size_multiple: int = 4
    reach: int = 32
    kept_bytes: int = 0

    def observe(
        self,
        images: Tensor,  # (B, Q, 3, H, W)
        mask: Tensor,  # (B, 1, H, W)
        lights: Lights | None,
        brightness: Tensor | None = None,  # (B, 1, 1, H, W)
    ) -> Observations:
        """Prepare images for `encode`.

        Args:
            images: Exposed images, under lights of the intensities in `lights`.
            mask: 0 or 1.
            lights: May be None for networks that are not told the lights. Those that tell no errors count as exact.
            brightness: `brightness(...)` of all images of the scene where `images` are only some; see `division`.
        """
        directions = light_errors = None
        if self.needs_lights:
            assert lights is not None
            images, directions = divide(images, lights.intensities), lights.directions
            light_errors = lights.expected
        if self.division != "none":
            found = brightness if brightness is not None else self.brightness(images)
            # The published norm is that of 32 images of 3 channels, whatever the number of images here.
            scale = (32 * 3 * found).sqrt() if self.division == "norm" else found
            images = images / (scale + _SCALE_FLOOR)
        return Observations(images, directions, mask if self.needs_mask else None, light_errors)

    def brightness(self, images: Tensor) -> Tensor:
        """Return what a pixel is divided by, (B, 1, 1, H, W), of images (B, Q, 3, H, W) over their intensities.

        The mean over images and channels of the squares where the division is by the `norm`, the maximum otherwise.
        """
        # Before any autocast region: squares of bfloat16 would carry errors of a per cent.
        if self.division == "max":
            return images.float().amax(dim=(1, 2), keepdim=True).clamp(min=0.0)
        # The tiny floor keeps the square root's gradient finite at pixels that are black under every light.
        return images.float().square().mean(dim=(1, 2), keepdim=True).clamp(min=1e-14)

    @abstractmethod
    def encode(self, seen: Observations) -> Any:
        """Return the feature of the given images, a maximum over theirs but for a `KeepingNetwork`."""

    @abstractmethod
    def regress(self, feature: Any) -> Tensor:
        """Return unit normals (B, 3, H, W), float32, of the aggregated feature."""

    def regress_with_error(self, feature: Any) -> tuple[Tensor, Tensor | None]:
        """Return the normals, and the angles to the true ones to expect, (B, 1, H, W) degrees, if it tells them."""
        return self.regress(feature), None

    def forward(self, seen: Observations) -> Tensor:
        """Return unit normals (B, 3, H, W)."""
        return self.regress(self.encode(seen))


class KeepingNetwork(NormalNetwork):
    """A normal network whose lights meet pixel by pixel, so that a running maximum over the images does not do."""

    @abstractmethod
    def kept(self, seen: Observations) -> Any:
        """Return what `fused` needs of some of a scene's images."""

    @abstractmethod
    def fused(self, parts: list[Any]) -> Any:
        """Return the feature of all of a scene's images, of what `kept` gave, without gradients."""


class TurningNetwork(NormalNetwork):
    """A normal network whose feature turns with the scene, so that turned views need none of their own."""

    @abstractmethod
    def turned(self, feature: Any, symmetry: Symmetry) -> Any:
        """Return the feature that the turned scene would have had."""


def divide(images: Tensor, intensities: Tensor) -> Tensor:
    """Divide images (B, Q, 3, H, W) by intensities (B, Q)."""
    return images / (intensities[..., None, None, None] + _TINY)
