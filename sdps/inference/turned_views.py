"""Test-time augmentation: networks answer turned and mirrored views of a scene, and the answers are averaged.

Networks are trained on all eight views (`sdps.core.symmetry`) but answer each a little differently; the mean of the
answers, each turned back, is nearer to the truth than one of them.

Legend: L images, h and w the sides of an image.
"""

from collections.abc import Iterator, Sequence

import torch
from torch import Tensor
from torch.nn import functional

from sdps.core.symmetry import Symmetry
from sdps.inference.image_source import View
from sdps.models.base import Lights


def turn_lights(symmetry: Symmetry, lights: Lights | None) -> Lights | None:
    """Turn the directions of lights, and how they spread."""
    if lights is None:
        return None
    covariance = None if lights.covariance is None else symmetry.matrices(lights.covariance)
    return lights._replace(directions=symmetry.vectors(lights.directions), covariance=covariance)


class TurnedView:
    """A view as one of the eight would show it; a `View` for what goes through it."""

    def __init__(self, view: "View | KeptView", symmetry: Symmetry) -> None:
        self.view, self.symmetry = view, symmetry

    def __len__(self) -> int:
        return len(self.view)

    @property
    def mask(self) -> Tensor:
        """The mask, (1, 1, h', w')."""
        return self.symmetry.images(self.view.mask)

    @property
    def placed(self) -> tuple[Tensor, ...] | None:
        """Where the turned pixels lie, as `View.placed`; None: it does not matter."""
        if isinstance(self.view, KeptView) or self.view.placed is None:
            return None
        return tuple(self.symmetry.vectors(self.symmetry.images(each), dim=1) for each in self.view.placed)

    def __iter__(self) -> Iterator[tuple[slice, Tensor]]:
        """Yield which images, and these, (1, n, 3, h', w')."""
        for part, images in self.view:
            yield part, self.symmetry.images(images)


class KeptView:
    """A view that is read once and kept: 0.1 MB per image of 128x128 in half precision."""

    def __init__(self, view: View) -> None:
        self.mask, self._parts = view.mask, [(part, images.half()) for part, images in view]

    def __len__(self) -> int:
        return sum(images.shape[1] for _, images in self._parts)

    def __iter__(self) -> Iterator[tuple[slice, Tensor]]:
        """Yield which images, and these, (1, n, 3, h, w) float32."""
        for part, images in self._parts:
            yield part, images.float()


AnyView = View | KeptView | TurnedView


def mean_lights(found: list[tuple[Symmetry, Lights]]) -> Lights:
    """Return the mean of lights found in turned views, each turned back: directions of unit length.

    The error to expect of the mean is less than of one view, by what averages out: squared, by the mean squared
    distance of the views' directions from their mean. At least a share of 1 / sqrt(views) is left.
    """
    if len(found) == 1:
        return found[0][1]
    directions = torch.stack([symmetry.back.vectors(lights.directions.float()) for symmetry, lights in found])
    mean = functional.normalize(directions.mean(0), dim=-1)  # (B, Q, 3)
    intensities = torch.stack([lights.intensities.float() for _, lights in found]).mean(0)
    sure = [lights.confidence.float() for _, lights in found if lights.confidence is not None]
    errors = [lights.expected_error.float() for _, lights in found if lights.expected_error is not None]
    confidence, expected = (torch.stack(values).mean(0) if values else None for values in (sure, errors))
    if expected is not None:
        spread = torch.rad2deg((directions - mean).square().sum(-1).mean(0).sqrt())  # (B, Q)
        expected = (expected.square() - spread.square()).clamp(min=expected.square() / len(found)).sqrt()
    near = [lights.nearness.float() for _, lights in found if lights.nearness is not None]
    wide = [each.back.matrices(lights.covariance.float()) for each, lights in found if lights.covariance is not None]
    nearness, covariance = (torch.stack(values).mean(0) if values else None for values in (near, wide))
    return Lights(mean, intensities, confidence, expected, nearness, covariance)


def mean_normals(
    symmetries: Sequence[Symmetry], answers: Sequence[tuple[Tensor, Tensor | None]]
) -> tuple[Tensor, Tensor | None]:
    """Return the mean of normals (1, 3, h, w) found in turned views, each turned back, and of the errors to expect."""
    pairs = list(zip(symmetries, answers, strict=True))
    normals = [symmetry.back.vectors(symmetry.back.images(found.float()), dim=1) for symmetry, (found, _) in pairs]
    errors = [symmetry.back.images(expected) for symmetry, (_, expected) in pairs if expected is not None]
    mean = functional.normalize(torch.stack(normals).mean(0), dim=1) if len(normals) > 1 else normals[0]
    return mean, torch.stack(errors).mean(0) if errors else None
