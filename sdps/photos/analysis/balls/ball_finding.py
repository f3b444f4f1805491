"""Balls that are found in the pictures: a round outline, and within it what only a ball shows.

The pictures' mean, maximum and spread are looked at, since one light alone leaves a part of a ball's outline dark.
Hough's transform proposes circles; each is fitted to the steepest places of the brightness along its radii, and kept if
enough of these lie on one ball's outline. Then every picture is asked: a chrome ball has one small highlight, which
moves; on a white one Lambert's law explains the shading.
"""

from collections.abc import Iterator, Sequence

import cv2
import numpy as np

from render.shared.imaging.reducing import reduce_image
from sdps.core.geometry import Camera
from sdps.photos.analysis.balls.ball_flags import CHROME, WHITE
from sdps.photos.analysis.balls.ball_highlights import find_highlights
from sdps.photos.analysis.balls.ball_lights import BallRays, trace_rays
from sdps.photos.analysis.balls.ball_outlines import Edges, flatten, refine_outline, settle
from sdps.photos.analysis.balls.ball_spheres import Circle, Sphere
from sdps.photos.analysis.balls.ball_views import BallView, Pictures, view_balls

_SIDE = 640  # of the picture in which circles are looked for
_SMALLEST, _LARGEST = 0.02, 0.5  # radius over the picture's shorter side
_FEWEST_PIXELS = 8.0  # radius
_PROPOSED = 12  # circles that are looked at closely
_PART, _VOTED = 1.7, 4  # of the radii: highest over lowest; and how many circles of each
_AGAIN = 0.02  # radii by which circles that are one and the same may differ
_ON = 0.35  # share of the radii with an edge on the outline
_SAME = 0.35  # radii between the middles of one and the same ball
_SHOWN = 0.8  # share of the pictures that must show a light
_MATT = 0.85  # share of the variance that Lambert's law explains on a white ball that is found
_MOVES = 0.02  # spread of a chrome ball's highlights, in radii
_MIRROR = 0.12  # mean share of a chrome ball that is brighter than a quarter of its highlight


def find_balls(
    pictures: Pictures, camera: Camera, shape: tuple[int, int], saturation: float, kind: str = ""
) -> list[BallRays]:
    """Find the balls in pictures, the surest first, and what they say of the lights; none where there is none.

    Args:
        pictures: L of them, which are read twice.
        camera: It.
        shape: (H, W).
        saturation: Radiance from which on a channel is clipped.
        kind: `chrome` or `white` if no other is wanted.
    """
    factor = min(1.0, _SIDE / max(shape))
    small = tuple(max(1, round(side * factor)) for side in shape)
    fields = _gather(pictures, (small[0], small[1]))
    found = _propose(fields, camera, shape, small[1] / shape[1])
    if not found:
        return []
    views = view_balls(pictures, [sphere for sphere, _ in found], saturation)
    good = [rays for rays in (_verify(settle(view), kind) for view in views) if rays is not None]
    kept: list[BallRays] = []
    for rays in good:
        if not any(_overlap(rays.view.sphere, other.view.sphere) for other in kept):
            kept.append(rays)
    return kept


def _gather(pictures: Pictures, small: tuple[int, int]) -> list[np.ndarray]:
    """Return what circles are looked for in: logarithms of the pictures' mean and maximum, and their spread."""
    total, squares, most = np.zeros(small), np.zeros(small), np.zeros(small)
    for number in range(len(pictures)):
        grey = reduce_image(pictures.window(slice(number, number + 1), slice(None), slice(None))[0].mean(-1), small)
        total, squares, most = total + grey, squares + grey.astype(np.float64) ** 2, np.maximum(most, grey)
    mean = total / len(pictures)
    spread = np.sqrt(np.maximum(squares / len(pictures) - mean**2, 0.0))
    return [flatten(field) for field in (mean, most, spread)]


def _propose(
    fields: Sequence[np.ndarray], camera: Camera, shape: tuple[int, int], factor: float
) -> list[tuple[Sphere, float]]:
    """Return balls of whose outlines enough is seen, and how much, the most first."""
    shorter = min(fields[0].shape)
    low = max(_SMALLEST * shorter, _FEWEST_PIXELS * factor, 5.0)
    edges = Edges.of(fields, (0.5 / factor - 0.5,) * 2, 1.0 / factor)
    tried: list[Circle] = []
    found: list[tuple[Sphere, float]] = []
    for x, y, radius in (circle for field in fields for circle in _vote(field, low, _LARGEST * shorter)):
        circle = Circle((x + 0.5) / factor - 0.5, (y + 0.5) / factor - 0.5, radius / factor)
        if any(max(np.abs(np.subtract(circle, other))) < _AGAIN * radius / factor for other in tried):
            continue
        tried.append(circle)
        sphere, share = refine_outline(edges, Sphere.of(circle, camera, shape))
        if share >= _ON and sphere.radius * factor >= low:
            found.append((sphere, share))
    found.sort(key=lambda item: -item[1])
    kept: list[tuple[Sphere, float]] = []
    for sphere, share in found:
        if not any(_overlap(sphere, other) and abs(sphere.radius / other.radius - 1.0) < 0.1 for other, _ in kept):
            kept.append((sphere, share))
    return kept[:_PROPOSED]


def _vote(field: np.ndarray, low: float, high: float) -> Iterator[np.ndarray]:
    """Yield circles (x, y, radius) of a field (h, w), whose radii are looked for part by part; one alone would win."""
    picture = cv2.GaussianBlur((field * 255).astype(np.uint8), (0, 0), 1.2)

    def transform(way: int, least: float, most: float, steep: float, votes: float, apart: float) -> np.ndarray:
        circles = cv2.HoughCircles(
            picture, way, 1.5, apart, param1=steep, param2=votes, minRadius=int(least), maxRadius=int(most) + 1
        )
        return np.empty((0, 3)) if circles is None else circles.reshape(-1, circles.shape[-1])[:, :3].astype(np.float64)

    yield from transform(cv2.HOUGH_GRADIENT_ALT, low, high, 150.0, 0.3, 2.0 * low)[:_PROPOSED]
    while low < high:
        most = min(_PART * low, high)
        yield from transform(cv2.HOUGH_GRADIENT, low, most, 60.0, 20.0, max(0.3 * low, 5.0))[:_VOTED]
        low = most


def _overlap(one: Sphere, other: Sphere) -> bool:
    """Return whether the middle of one lies inside the other."""
    small, large = sorted((one.radius, other.radius))
    apart = float(np.hypot(one.x - other.x, one.y - other.y))
    return apart < max(_SAME * large, 0.9 * large - 0.1 * small)


def _verify(view: BallView, kind: str) -> BallRays | None:
    """Return what a ball says of the lights; None if it is not a ball."""
    if kind != CHROME and np.mean(view.shaded[1] >= _MATT) >= _SHOWN:
        rays = trace_rays(view, WHITE)
        return rays if rays.share >= _SHOWN else None
    if kind == WHITE:
        return None
    found = find_highlights(view)
    rays = trace_rays(view, CHROME)
    if rays.share < _SHOWN:
        return None
    off = (found.places - np.nanmean(found.places, axis=0)) / view.sphere.radius
    if np.sqrt(np.nanmean((off**2).sum(-1))) < _MOVES:
        return None
    inside = view.offsets <= 0.95
    moving = (view.grey - view.grey.min(0))[:, inside]
    bright = (moving > 0.25 * moving.max(1, keepdims=True)).mean(1)
    return rays if float(np.median(bright)) < _MIRROR else None
