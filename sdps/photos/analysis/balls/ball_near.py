"""White balls under near lamps, whose direction and strength differ over the ball.

Lambert's law for one direction, fitted to such a ball, finds one that is turned away from the camera: by 4 degrees if
the lamp stands 20 radii away. How far the lamp is tells by how much: a ball is shaded by a lamp there and fitted in the
same way, and the direction is moved until that fit gives what the pictures gave.
"""

from dataclasses import replace

import numpy as np

from sdps.photos.analysis.balls.ball_flags import WHITE
from sdps.photos.analysis.balls.ball_lights import BallRays
from sdps.photos.analysis.balls.ball_views import fit_shading

_GRID = 28  # rows and columns of the ball that is shaded, about
_STEPS = 3
_NEAREST, _FARTHEST = 1.5, 500.0  # radii from the ball's middle between which lamps are near ones


def correct_near(ray: BallRays, lamps: np.ndarray, depth: float = 1.0) -> BallRays:
    """Return what a white ball says of lamps that are near; of a chrome ball what it says.

    Args:
        ray: As it was found, for distant lamps.
        lamps: (L, 3) about where they stand; NaN: distant.
        depth: The ball's distance from the camera over that at which it was found; `ray.points` are there.
    """
    if ray.kind != WHITE or ray.intensities is None:
        return ray
    directions, strengths = ray.directions.copy(), ray.intensities.copy()
    away = np.linalg.norm(lamps - ray.points, axis=-1) / (depth * ray.view.sphere.radius)
    near = np.isfinite(directions[:, 0]) & (away > _NEAREST) & (away < _FARTHEST)
    every = max(1, min(ray.view.rows.shape) // _GRID)
    rows, columns = (places[::every, ::every] for places in (ray.view.rows, ray.view.columns))
    clipped = ray.view.clipped[:, ::every, ::every]  # what the pictures' fit left out
    normals = ray.view.sphere.hit(rows, columns)[1]
    for number in np.flatnonzero(near):
        seen = np.zeros(3)
        for _ in range(_STEPS):
            off = away[number] * directions[number] - normals
            lit = np.maximum((normals * off).sum(-1), 0.0) / np.linalg.norm(off, axis=-1) ** 3 * away[number] ** 2
            grey = np.repeat(lit[..., None], 3, axis=-1)
            fitted = fit_shading(ray.view.sphere, rows, columns, grey, clipped[number])[0]
            if not np.isfinite(fitted).all():
                break
            seen = fitted.mean(axis=0)
            moved = directions[number] + ray.directions[number] - seen / np.linalg.norm(seen)
            directions[number] = moved / np.linalg.norm(moved)
        strengths[number] /= np.linalg.norm(seen) or 1.0
    return replace(ray, directions=directions, intensities=strengths)
