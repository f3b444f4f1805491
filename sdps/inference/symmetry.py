"""The eight ways to turn and mirror a scene about the view axis, and back.

Reflectance is isotropic, so a turned scene is one a camera could have seen, with its turned lights and normals.
Networks are trained on all eight views but answer each a little differently; the mean of the answers, each turned
back, is nearer to the truth than one of them.

Legend: L images, h and w the sides of an image.
"""

from collections.abc import Callable, Iterator
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional

from sdps.inference.image_source import View
from sdps.models.base import Lights


class Symmetry(NamedTuple):
    """A mirror in x, if any, and quarter turns counter-clockwise after it; as `sdps.data.augment.apply_symmetry`."""

    turns: int = 0
    mirror: bool = False

    def images(self, images: Tensor) -> Tensor:
        """Turn images (..., h, w)."""
        images = images.flip(-1) if self.mirror else images
        # Not by zero turns: that copies, out of the memory layout that networks are fast in.
        return torch.rot90(images, self.turns, (-2, -1)) if self.turns else images

    def vectors(self, vectors: Tensor, dim: int = -1) -> Tensor:
        """Turn vectors whose x, y and z lie along dimension `dim`."""
        x, y, z = vectors.unbind(dim)
        x = -x if self.mirror else x
        for _ in range(self.turns % 4):
            x, y = -y, x
        return torch.stack([x, y, z], dim)

    @property
    def back(self) -> "Symmetry":
        """What undoes it; a mirrored turn undoes itself."""
        return self if self.mirror else Symmetry(-self.turns % 4)

    def lights(self, lights: Lights | None) -> Lights | None:
        """Turn the directions of lights."""
        return None if lights is None else lights._replace(directions=self.vectors(lights.directions))


SYMMETRIES = tuple(Symmetry(turns, mirror) for turns in (0, 2, 1, 3) for mirror in (False, True))
"""The first 1, 2, 4 or 8 of them are a group each."""


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


def turned_context(symmetry: Symmetry, context: Callable[[slice], Tensor] | None) -> Callable[[slice], Tensor] | None:
    """Return what gives the turned channels of a second pass: normals and shading (1, n, 4, h, w)."""
    if context is None:
        return None

    def turned(part: slice) -> Tensor:
        channels = symmetry.images(context(part))
        return torch.cat([symmetry.vectors(channels[:, :, :3], dim=2), channels[:, :, 3:]], dim=2)

    return turned


def mean_lights(found: list[tuple[Symmetry, Lights]]) -> Lights:
    """Return the mean of lights found in turned views, each turned back: directions of unit length."""
    if len(found) == 1:
        return found[0][1]
    directions = torch.stack([symmetry.back.vectors(lights.directions.float()) for symmetry, lights in found]).mean(0)
    intensities = torch.stack([lights.intensities.float() for _, lights in found]).mean(0)
    sure = [lights.confidence.float() for _, lights in found if lights.confidence is not None]
    confidence = torch.stack(sure).mean(0) if sure else None
    return Lights(functional.normalize(directions, dim=-1), intensities, confidence)
