"""Lamps that stand near: every pixel has directions and irradiances of its own, which depend on the depth.

The depth is that of the normals, the normals are those of the directions: both are found in turns.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from render.shared.progress import repeat
from sdps.core.estimate import Estimate
from sdps.core.geometry import Camera, Capture, reach
from sdps.core.integration import integrate
from sdps.core.metrics import angle_degrees

_ROUNDS = 6
_SETTLED = 0.1
"""Degrees that normals move, on average, in a round that is the last."""


@dataclass(frozen=True, eq=False)
class NearLamps:
    """How near lamps stand to the pixels of an object.

    Attributes:
        places: (H, W, 3) or (P, 3) float64, positions of the pixels (`sdps.core.geometry.Capture.places`).
        nearness: (L,) rho of the lamps.
    """

    places: np.ndarray
    nearness: np.ndarray

    def at(self, pixels: np.ndarray | slice | tuple[slice, ...]) -> "NearLamps":
        """Return the same for a part of the pixels."""
        return NearLamps(self.places[pixels], self.nearness)

    def reach(self, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:  # (P, L, 3), (P, L)
        """Return directions and falloff at every pixel (P, 3), of the lamps' directions (L, 3) from the middle."""
        return reach(self.places, directions, np.asarray(self.nearness, np.float64))


def settle(solve: Callable[[NearLamps], Estimate], mask: np.ndarray, nearness: np.ndarray, camera: Camera) -> Estimate:
    """Solve and integrate in turns until the normals stay.

    Args:
        solve: Gives the estimate for pixels at known places (H, W, 3), first those of a flat object.
        mask: (H, W) bool.
        nearness: (L,) of the lamps.
        camera: What the images were taken with.
    """
    capture = Capture.of(mask, camera)
    estimate: Estimate | None = None
    heights: np.ndarray | None = None
    for number in range(_ROUNDS):
        before = estimate
        with repeat(number, _ROUNDS):
            estimate = solve(NearLamps(capture.places(heights), nearness))
            if before is not None and _movement(before, estimate, mask) < _SETTLED:
                break
            if number < _ROUNDS - 1:
                heights = integrate(estimate.normals, mask, camera=camera).z
    assert estimate is not None  # there are rounds
    return estimate


def _movement(before: Estimate, after: Estimate, mask: np.ndarray) -> float:
    """Return how far normals moved, on average, in degrees."""
    return float(angle_degrees(before.normals[mask], after.normals[mask]).mean())
