"""Balls that stand nearer to the camera than the object, or farther: of one real size, the nearer is seen larger.

A ball is found as if its middle were at the object's mean depth. One that stands elsewhere is that ball made larger or
smaller about the pinhole, and so is all that it shows; directions stay. So of balls of radii r_b in the picture, those
of one real size stand at s_b f, with s_b in proportion to 1 / r_b. Rays tell whether they are of one size: they meet
better. They cannot tell how far the object is from the balls, whose mean distance is taken to be its own. Balls whose
real radii R_b are known need no such test: R_b / r_b is in proportion to s_b, whatever their sizes, and is the size of
a pixel at the object where s_b is 1. With that size known as well, it tells s_b of one ball alone.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from render.shared.errors import InputError
from sdps.core.geometry import Capture
from sdps.photos.analysis.balls.ball_flags import RADIUS_FLAG, WHITE
from sdps.photos.analysis.balls.ball_lights import BallLights, BallRays, join_rays
from sdps.photos.analysis.balls.ball_near import correct_near

_UNLIKE = 1.03  # largest radius over smallest, from which on balls may stand at different depths
_ROUNDS = 3
_DEEPEST = 3.0  # times as far from the camera as the object, or as near, that a ball may stand
_LEVEL = 0.005  # of the object's distance, by which balls at its depth may miss it
_BETTER = 0.8  # of the degrees by which rays miss one another, if they are of one size


def join_balls(
    rays: Sequence[BallRays], capture: Capture, distant: bool = False, reach: float | None = None,
    pixel_size: float | None = None,
) -> tuple[BallLights, np.ndarray | None]:  # fmt: skip
    """Join what balls say: where their radii say that they stand, else at one depth or of one size, whichever makes
    their rays meet better.

    Args:
        rays: Of each ball.
        capture: The object.
        distant: The lamps are known to be far away.
        reach: Their distance from the object's middle in its sizes, where the user says it.
        pixel_size: Millimetres per pixel at the object's mean depth; None: not known.

    Returns:
        The lights, and the balls' distances from the camera over the object's, (B,); None: all at its depth.

    Raises:
        InputError: a ball so far from the object's depth that its radius must be wrong.
    """
    known = _find_depths(rays, capture, pixel_size)
    if known is not None:
        apart = known if np.abs(known - 1.0).max() > _LEVEL else None
        return _join(rays if apart is None else _move(rays, capture, apart), capture, distant, reach, apart), apart
    level = _join(rays, capture, distant, reach)
    sizes = np.array([ray.view.sphere.radius for ray in rays])
    if not capture.camera.is_perspective or sizes.max() < _UNLIKE * sizes.min() or level.distances is None:
        return level, None
    depths = len(sizes) / sizes / (1.0 / sizes).sum()
    alike = _join(_move(rays, capture, depths), capture, distant, reach, depths)
    if level.apart is None or alike.apart is None or not alike.apart < _BETTER * level.apart:
        return level, None
    return alike, depths


def measure_pixel(
    rays: Sequence[BallRays], capture: Capture, given: float | None
) -> tuple[float | None, tuple[str, ...]]:
    """Return millimetres per pixel at the object's mean depth by the balls' real radii, and what to say of it.

    Args:
        rays: Of each ball.
        capture: The object.
        given: The same by the user, who is believed; None: not known.
    """
    sides = _pixel_sizes(rays)
    if sides is None:
        return given, ()
    size = float(sides.mean()) if given is None else given
    notes = [f"a pixel shows {size:.4g} mm on the object, by the balls' radii"] if given is None else []
    if not capture.camera.is_perspective and np.abs(sides / size - 1.0).max() > _UNLIKE - 1.0:
        said = " and ".join(f"{side:.4g}" for side in sides)
        notes.append(f"by the balls' radii a pixel is {said} mm, not {size:.4g}; correct one, or give --focal")
    return size, tuple(notes)


def _pixel_sizes(rays: Sequence[BallRays]) -> np.ndarray | None:
    """Return millimetres per pixel at each ball's depth, (B,); None where a real radius is not known."""
    radii = [ray.millimetres for ray in rays]
    known = [radius / ray.view.sphere.radius for radius, ray in zip(radii, rays, strict=True) if radius is not None]
    return np.array(known) if known and len(known) == len(radii) else None


def _find_depths(rays: Sequence[BallRays], capture: Capture, pixel_size: float | None) -> np.ndarray | None:
    """Return the balls' distances from the camera over the object's, (B,), by their real radii; None: not known."""
    sides = _pixel_sizes(rays)
    if sides is None or not capture.camera.is_perspective:
        return None
    depths = sides / (pixel_size or sides.mean())
    for number in np.flatnonzero((depths > _DEEPEST) | (depths < 1.0 / _DEEPEST)):
        raise InputError(
            f"{RADIUS_FLAG}: ball {number + 1} would stand {depths[number]:.2g} times as far from the camera as the "
            "object; correct its radius in millimetres, its circle, or --pixel-size"
        )
    return depths


def _move(rays: Sequence[BallRays], capture: Capture, depths: np.ndarray) -> list[BallRays]:
    """Return rays of balls at `depths` (B,) times the object's distance from the camera."""
    pinhole = np.array([0.0, 0.0, capture.camera.focal])
    return [
        replace(ray, points=pinhole + depth * (ray.points - pinhole)) for ray, depth in zip(rays, depths, strict=True)
    ]


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
