"""What both witnesses say of an object: refinement, and the network, asked again under the lights refinement found.

Legend: H, W sides of the picture, h, w those of the object's box.
"""

from dataclasses import dataclass, fields

import numpy as np

from sdps.core.estimate import Estimate
from sdps.core.metrics import angle_degrees
from sdps.inference.image_source import find_box
from sdps.refinement.image_model import Refined
from sdps.refinement.trust import Trust, measure_spread

_ROOM = 4
"""Pixels kept around the object."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Evidence:
    """What is known of an object, float32; degrees are angles to the true normals, or lights, to expect.

    Attributes:
        mask: (h, w) bool.
        network: (h, w, 3) normals of the network under refined lights; all normals are zero outside the mask.
        refined: (h, w, 3) normals of refinement.
        start: (h, w, 3) normals of the network under the lights it found, or was given.
        told: (h, w) degrees, by the network.
        told_first: (h, w) degrees, by the network at the start.
        expected: (h, w) degrees, of refined normals, by their residuals alone.
        residual: (h, w) what refinement did not explain.
        albedo: (h, w) of refinement, over its mean.
        gloss: (h, w) strength of highlights.
        used: (h, w) share of the images that are not in shadow or clipped.
        images: Their number.
        spread: Of the lights, root mean square distance from their mean.
        nearness: Of the lamps, their mean.
        turned: Degrees by which refinement turned the lights, their mean.
        lit: Light directions were given.
    """

    mask: np.ndarray
    network: np.ndarray
    refined: np.ndarray
    start: np.ndarray
    told: np.ndarray
    told_first: np.ndarray
    expected: np.ndarray
    residual: np.ndarray
    albedo: np.ndarray
    gloss: np.ndarray
    used: np.ndarray
    images: float
    spread: float
    nearness: float
    turned: float
    lit: float

    @property
    def numbers(self) -> tuple[float, ...]:
        """What is one number of the whole object."""
        return self.images, self.spread, self.nearness, self.turned, self.lit

    def part(self, rows: slice, columns: slice) -> "Evidence":
        """Return the evidence of a part of the box."""
        values = {name: each[rows, columns] if each.ndim > 1 else each for name, each in self.arrays().items()}
        return Evidence(**values)  # type: ignore[arg-type]  # numbers stay numbers

    def arrays(self) -> dict[str, np.ndarray]:
        """Return all of it by name, for a file."""
        return {field.name: np.asarray(getattr(self, field.name)) for field in fields(self)}


def find_place(mask: np.ndarray) -> tuple[slice, slice]:
    """Return the rows and columns of a picture (H, W) that are an object's evidence."""
    return find_box(mask, _ROOM)


def gather(
    mask: np.ndarray, start: Estimate, refined: Refined, again: Estimate, trust: Trust, *, lit: bool
) -> Evidence:  # fmt: skip
    """Return the evidence of an object's box.

    Args:
        mask: (H, W) bool.
        start: What the network found first; it tells the error to expect.
        refined: What refinement made of it.
        again: What the network finds under refined lights.
        trust: What refinement says of itself.
        lit: Light directions were given.
    """
    box = find_place(mask)
    inside, grey = mask[box], refined.albedo[box].mean(axis=2)
    assert start.expected_error is not None and again.expected_error is not None  # only such networks are asked
    return Evidence(
        mask=inside,
        network=again.normals[box],
        refined=refined.normals[box],
        start=start.normals[box],
        told=again.expected_error[box],
        told_first=start.expected_error[box],
        expected=trust.plain[box],
        residual=refined.pixel_residual[box],
        albedo=grey / max(float(grey[inside].mean()), 1e-9),
        gloss=refined.strength[box],
        used=refined.used[box],
        images=float(len(refined.light_directions)),
        spread=measure_spread(refined.light_directions),
        nearness=float(refined.nearness.mean()),
        turned=float(angle_degrees(refined.light_directions, start.light_directions).mean()),
        lit=float(lit),
    )
