"""Balls that stand nearer to the camera than the object, or farther: of one real size, the nearer is seen larger.

A ball is found as if its middle were at the object's mean depth. One that stands elsewhere is that ball made larger or
smaller about the pinhole, and so is all that it shows; directions stay. So of balls of radii r_b in the picture, those
of one real size stand at s_b f, with s_b in proportion to 1 / r_b. Rays tell whether they are of one size: they meet
better. They cannot tell how far the object is from the balls, whose mean distance is taken to be its own.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from sdps.core.geometry import Capture
from sdps.photos.analysis.balls.ball_flags import WHITE
from sdps.photos.analysis.balls.ball_lights import BallLights, BallRays, join_rays
from sdps.photos.analysis.balls.ball_near import correct_near

_UNLIKE = 1.03  # largest radius over smallest, from which on balls may stand at different depths
_ROUNDS = 3
_BETTER = 0.8  # of the degrees by which rays miss one another, if they are of one size


def join_balls(
    rays: Sequence[BallRays], capture: Capture, distant: bool = False, reach: float | None = None
) -> tuple[BallLights, np.ndarray | None]:
    """Join what balls say, at one depth or of one size, whichever makes their rays meet better.

    Args:
        rays: Of each ball.
        capture: The object.
        distant: The lamps are known to be far away.
        reach: Their distance from the object's middle in its sizes, where the user says it.

    Returns:
        The lights, and the balls' distances from the camera over the object's, (B,); None: all at its depth.
    """
    level = _join(rays, capture, distant, reach)
    sizes = np.array([ray.view.sphere.radius for ray in rays])
    if not capture.camera.is_perspective or sizes.max() < _UNLIKE * sizes.min() or level.distances is None:
        return level, None
    depths = len(sizes) / sizes / (1.0 / sizes).sum()
    pinhole = np.array([0.0, 0.0, capture.camera.focal])
    moved = [
        replace(ray, points=pinhole + depth * (ray.points - pinhole)) for ray, depth in zip(rays, depths, strict=True)
    ]
    alike = _join(moved, capture, distant, reach, depths)
    if level.apart is None or alike.apart is None or not alike.apart < _BETTER * level.apart:
        return level, None
    return alike, depths


def _join(
    rays: Sequence[BallRays], capture: Capture, distant: bool, reach: float | None, depths: np.ndarray | None = None
) -> BallLights:
    """Join what balls say, white ones corrected for lamps that turn out to be near; depths (B,), None: all 1."""
    found = join_rays(rays, capture, distant, reach)
    every = np.ones(len(rays)) if depths is None else depths
    for _ in range(_ROUNDS if any(ray.kind == WHITE for ray in rays) else 0):
        away = found.distances if reach is None else np.full(len(found.directions), reach)
        if away is None or distant:
            break
        with np.errstate(invalid="ignore"):
            lengths = np.where(np.isfinite(away), 2.0 * capture.radius * away, np.nan)
            lamps = capture.centre + lengths[:, None] * found.directions
        own = [correct_near(ray, lamps, depth) for ray, depth in zip(rays, every, strict=True)]
        found = join_rays(own, capture, distant, reach)
    return found
