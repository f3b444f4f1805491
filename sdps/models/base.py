"""What the networks of one role have in common, so that any lighting network works with any normal network.

A network brings what depends on it: its loss, how it takes in the images of a scene chunk by chunk, whether its
features turn with the scene, and what it costs. Training and inference ask it, and know no network by name.

Legend: B scenes, Q images of a scene, H and W the image's sides.
"""

from abc import ABC, abstractmethod
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from sdps.core.lighting import LightClasses, ReadOut
from sdps.core.losses import NormalCriterion
from sdps.core.symmetry import Symmetry

USUAL_LIGHT_ERROR = 6.0
"""Degrees to expect of the directions of lighting networks that predict no error themselves."""
_TINY = 1e-8
_SCALE_FLOOR = 1e-4
"""Added to what a pixel is divided by: far below any lit pixel, but keeps black ones from dividing by zero."""


class Lights(NamedTuple):
    """The light of every image."""

    directions: Tensor  # (B, Q, 3) float32, unit, from the surface to the light
    intensities: Tensor  # (B, Q) float32, positive, relative
    confidence: Tensor | None = None  # (B, Q) float32 in [0, 1], the product of the likeliest direction classes
    expected_error: Tensor | None = None  # (B, Q) float32, degrees to expect of the direction; None: not predicted
    nearness: Tensor | None = None  # (B, Q) float32, rho of the lamps (`sdps.core.geometry`); None: taken for distant
    covariance: Tensor | None = None  # (B, Q, 3, 3) float32, of the directions light comes from; None: single lamps

    def select(self, images: slice) -> "Lights":
        """Return the lights of some images."""
        return Lights(*(None if each is None else each[:, images] for each in self))  # type: ignore[arg-type]

    def with_errors(self) -> "Lights":
        """Return estimated lights with errors to expect, the usual ones where none are predicted."""
        if self.expected_error is not None:
            return self
        return self._replace(expected_error=torch.full_like(self.intensities, USUAL_LIGHT_ERROR))


class LightingNetwork(nn.Module, ABC):
    """Estimates the light of every image of a scene.

    `encode` looks at images one by one, `predict` at their features and the maximum over all of them, so that a caller
    can go through any number of images in chunks.

    Attributes:
        use_mask: The mask is an input.
        classes: The discretised lighting space.
    """

    use_mask: bool = True
    classes: LightClasses

    @abstractmethod
    def encode(
        self,
        images: Tensor,  # (B, Q, 3, 128, 128)
        mask: Tensor,  # (B, 1, 128, 128)
    ) -> Tensor:
        """Return the local features (B, Q, F, 8, 8)."""

    @abstractmethod
    def predict(
        self,
        local: Tensor,  # (B, Q, F, 8, 8)
        shared: Tensor | None = None,  # (B, 1, F, 8, 8)
    ) -> Any:
        """Return the prediction of every image, a named tuple in the form that `loss` and `read_lights` take.

        Args:
            local: Features of images.
            shared: The maximum over all images of the scene; None where `local` is of all of them.
        """

    def predict_parts(self, parts: list[Tensor], seed: int) -> Any:
        """Return the prediction of a scene whose images were encoded in parts, without gradients.

        Args:
            parts: (1, q, F, 8, 8) each.
            seed: For networks that draw something; another for each turned view.
        """
        shared = torch.cat([local.amax(dim=1, keepdim=True) for local in parts], dim=1).amax(dim=1, keepdim=True)
        predictions = [self.predict(local, shared) for local in parts]
        return type(predictions[0])(*(torch.cat(each, dim=1) for each in zip(*predictions, strict=True)))

    @abstractmethod
    def loss(self, prediction: Any, truth: Lights) -> dict[str, Tensor]:
        """Return named losses, means over all images; `total` is the one to minimise."""

    @abstractmethod
    def read_lights(self, prediction: Any, read_out: ReadOut = "centre") -> Lights:
        """Return directions, intensities and confidence of a prediction."""

    def forward(self, images: Tensor, mask: Tensor) -> Any:
        """Return the prediction of every image; the order of the images does not matter."""
        return self.predict(self.encode(images, mask))


class NormalNetwork(nn.Module):
    """What a caller needs to know of any network that gives normals.

    Attributes:
        needs_lights: It is given directions, and images divided by the intensities.
        needs_mask: The mask is an input channel.
        size_multiple: Sides of images must be multiples of it.
        reach: Pixels around a pixel that its normal depends on, at most: the halo of tiles.
        kept_bytes: Memory per pixel and image for what is kept until all images were seen.
        equivariant: Its feature of a turned scene is that of the scene, turned (`FusionNetwork.turn`).
        tells_errors: It predicts the errors to expect of its normals.
    """

    needs_lights: bool = True
    needs_mask: bool = False
    size_multiple: int = 1
    reach: int = 0
    kept_bytes: int = 0
    equivariant: bool = False
    tells_errors: bool = False

    def inference_seconds(self, images: int, pixels: float, box: float, views: int) -> float:
        """Return about how long inference takes on one core of a server (AMD EPYC, AVX-512).

        Args:
            images: How many.
            pixels: Of the object.
            box: Pixels of the rectangle around it.
            views: Turned views that are averaged.
        """
        return 1.2e-6 * views * images * box


class Placement(NamedTuple):
    """Where the pixels of scenes lie (`sdps.core.geometry`), for networks that see near lamps and perspective."""

    places: Tensor  # (B, 3, H, W), (X - C) / R
    sights: Tensor  # (B, 3, H, W), v'


class Observations(NamedTuple):
    """What a normal network sees of a scene; made by `FusionNetwork.observe`."""

    images: Tensor  # (B, Q, 3, H, W), divided by the light intensities if the network is given the lights
    directions: Tensor | None = None  # (B, Q, 3)
    mask: Tensor | None = None  # (B, 1, H, W)
    light_errors: Tensor | None = None  # (B, Q), degrees to expect of the directions; None: they are exact
    nearness: Tensor | None = None  # (B, Q), rho of the lamps
    placement: Placement | None = None  # None: lamps are distant, the camera is orthographic
    covariance: Tensor | None = None  # (B, Q, 3, 3), of the directions light comes from


class Truth(NamedTuple):
    """What is true of a scene that a normal network learns from."""

    normals: Tensor  # (B, 3, H, W), unit, zero outside the object
    mask: Tensor  # (B, 1, H, W), 0 or 1
    directions: Tensor  # (B, Q, 3), unit
    intensities: Tensor  # (B, Q)


class FusionNetwork(NormalNetwork, ABC):
    """Estimates normals from any number of images, in any order, by the maximum over their features.

    `encode` followed by `regress` serves scenes of training. In inference `accumulate` takes in images a few at a time
    and `aggregate` makes the feature of all of them, by default with a running maximum, so that memory does not grow
    with the number of images. A network that is `normalised` also needs each pixel's `brightness` beforehand.

    Attributes:
        normalised: Images are divided by each pixel's norm over all lights and channels, as in PS-FCN (Norm.) (Chen et
            al., TPAMI 2020), which takes albedo away and leaves shading.
        sees_places: It sees near lamps and perspective; others take lamps for distant and cameras for orthographic.
    """

    size_multiple = 4
    reach = 32
    normalised: bool = False
    sees_places: bool = False

    def observe(
        self,
        images: Tensor,  # (B, Q, 3, H, W)
        mask: Tensor,  # (B, 1, H, W)
        lights: Lights | None,
        brightness: Tensor | None = None,  # (B, 1, 1, H, W)
        placement: Placement | None = None,
    ) -> Observations:
        """Prepare images for `encode`.

        Args:
            images: Exposed images, under lights of the intensities in `lights`.
            mask: 0 or 1.
            lights: May be None for networks that are not given them. Those without errors count as exact.
            brightness: `brightness(...)` of all images of the scene where `images` are only some; see `normalised`.
            placement: Where pixels lie; None: lamps are distant, the camera is orthographic.
        """
        directions = light_errors = nearness = covariance = None
        if self.needs_lights:
            assert lights is not None
            images, directions = divide(images, lights.intensities), lights.directions
            light_errors, nearness, covariance = lights.expected_error, lights.nearness, lights.covariance
        if self.normalised:
            found = brightness if brightness is not None else self.brightness(images)
            # The published norm is that of 32 images of 3 channels, whatever the number of images here.
            images = images / ((32 * 3 * found).sqrt() + _SCALE_FLOOR)
        seen = Observations(images, directions, mask if self.needs_mask else None, light_errors)
        if not self.sees_places:
            return seen
        return seen._replace(nearness=nearness, placement=placement, covariance=covariance)

    @staticmethod
    def brightness(images: Tensor) -> Tensor:
        """Return the mean square (B, 1, 1, H, W) over images and channels of images (B, Q, 3, H, W)."""
        # Before any autocast region: squares of bfloat16 would carry errors of a per cent.
        # The tiny floor keeps the square root's gradient finite at pixels that are black under every light.
        return images.float().square().mean(dim=(1, 2), keepdim=True).clamp(min=1e-14)

    @abstractmethod
    def encode(self, seen: Observations) -> Any:
        """Return the feature of all the images given."""

    def accumulate(self, so_far: Any, seen: Observations) -> Any:
        """Return what `aggregate` needs of the images of a scene: those before (None at first) and these."""
        feature = self.encode(seen)
        return feature if so_far is None else torch.maximum(so_far, feature)

    def aggregate(self, accumulated: Any) -> Any:
        """Return the feature of all images, as `encode` would, without gradients."""
        return accumulated

    def turn(self, feature: Any, symmetry: Symmetry) -> Any:
        """Return the feature that the turned scene would have had; only of networks that are `equivariant`."""
        raise NotImplementedError

    @abstractmethod
    def regress(self, feature: Any) -> Tensor:
        """Return unit normals (B, 3, H, W), float32, of the aggregated feature."""

    def regress_with_error(self, feature: Any) -> tuple[Tensor, Tensor | None]:
        """Return the normals and, if predicted, the angles to the true ones to expect, (B, 1, H, W) degrees."""
        return self.regress(feature), None

    def loss(self, seen: Observations, truth: Truth, criterion: NormalCriterion) -> tuple[Tensor, dict[str, Tensor]]:
        """Return the scalar to minimise, and named parts of it."""
        return criterion(self(seen), truth.normals, truth.mask)

    def forward(self, seen: Observations) -> Tensor:
        """Return unit normals (B, 3, H, W)."""
        return self.regress(self.encode(seen))


def divide(images: Tensor, intensities: Tensor) -> Tensor:
    """Divide images (B, Q, 3, H, W) by intensities (B, Q)."""
    return images / (intensities[..., None, None, None] + _TINY)
