"""A ball's outline, to parts of a pixel: fitted to the steepest places of the brightness along its radii."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import ndimage

from sdps.photos.analysis.balls.ball_spheres import Sphere
from sdps.photos.analysis.balls.ball_views import BallView

_RAYS = 360
_NEAR = 0.006, 0.8  # how far edges may lie from it, in radii and pixels of the picture looked at; the larger counts
_BANDS = (0.1, 2.5), (0.06, 1.5), (0.04, 1.0)  # about the outline, in radii, where edges are looked for; times `_NEAR`
_ACROSS = 1.5  # slope across the outline over that along it
_FAINT = 0.01  # slope per pixel, of brightness from 0 to 1, that is not an edge
_ARC, _GAP = 15, 2  # rays of an arc that counts, and that may be missing in it
_WEAK = 0.5  # of the steepest edge about the outline
_FEW = 0.1  # share of the outline that is seen under which it is none
_SEEN = 0.75  # and above which it moves a circle that was named
_ALSO = 0.8  # of what logarithms show that brightness must show as well
_MOST = 0.03, 2.0  # how far: radii, and pixels; the larger counts


@dataclass(frozen=True, eq=False)
class Edges:
    """Where pictures (h, w) are steep: their slopes down rows and along columns.

    Attributes:
        slopes: (down, along) of each; both (h, w).
        first: Row and column of their first pixel in the whole picture.
        step: Its pixels per pixel here.
    """

    slopes: tuple[tuple[np.ndarray, np.ndarray], ...]
    first: tuple[float, float]
    step: float

    @classmethod
    def of(cls, fields: Sequence[np.ndarray], first: tuple[float, float], step: float) -> "Edges":
        """Return the edges of brightness (h, w) from 0 to 1."""

        def slope(field: np.ndarray, order: tuple[int, int]) -> np.ndarray:
            found: np.ndarray = ndimage.gaussian_filter(field, 1.0, order)
            return found

        return cls(tuple((slope(field, (1, 0)), slope(field, (0, 1))) for field in fields), first, step)

    def along(self, rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
        """Return the steepness along radii, at their places (steps, rays); 0 where the edge is not across them."""
        here = [(places - start) / self.step for places, start in zip((rows, columns), self.first, strict=True)]
        way = np.stack([rows[-1] - rows[0], columns[-1] - columns[0]])
        way = way / np.linalg.norm(way, axis=0)
        best = np.zeros(rows.shape)
        for pair in self.slopes:
            down, right = (ndimage.map_coordinates(slope, here, order=1, mode="nearest") for slope in pair)
            across, beside = np.abs(down * way[0] + right * way[1]), np.abs(down * way[1] - right * way[0])
            best = np.maximum(best, np.where(across > _ACROSS * beside, across, 0.0))
        return best


def refine_outline(edges: Edges, sphere: Sphere) -> tuple[Sphere, float]:
    """Fit a ball to the edges around its outline.

    Args:
        edges: In which it shows.
        sphere: About where it is.

    Returns:
        The ball, and the share of its outline that has an edge on it.
    """
    share = 0.0
    for band, wide in _BANDS:
        near = wide * max(_NEAR[0] * sphere.radius, _NEAR[1] * edges.step)
        half = int(np.ceil(2 * band * sphere.radius / edges.step)) + 3
        reaches = 1.0 + np.arange(-half, half + 1) * band / (half - 3)
        lines = [sphere.outline(_RAYS, reach) for reach in reaches]
        rows, columns = (np.array([line[axis] for line in lines]) for axis in (0, 1))  # (steps, rays)
        steep = edges.along(rows, columns)
        at, there = _nearest_peaks(steep, half)
        rows, columns = (_between(places, at) for places in (rows, columns))
        there &= (rows >= 0) & (rows <= sphere.shape[0] - 1) & (columns >= 0) & (columns <= sphere.shape[1] - 1)
        if there.sum() < _RAYS // 5:
            return sphere, 0.0
        seen = np.flatnonzero(there)
        sphere, on = _fit(sphere, (rows[there], columns[there]), near)
        share = _measure_arcs(np.isin(np.arange(_RAYS), seen[on]))
        if share < _FEW:
            break
    return sphere, share


def _nearest_peaks(steep: np.ndarray, middle: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the place along each radius (steps, rays) of the peak nearest to a step, and whether there is one."""
    inner = steep[1:-1]
    peaks = (inner >= steep[:-2]) & (inner > steep[2:]) & (inner > np.maximum(_FAINT, _WEAK * steep.max(0)))
    off = np.where(peaks, np.abs(np.arange(1, len(steep) - 1) - middle)[:, None], len(steep))
    best = np.argmin(off, axis=0) + 1
    rays = np.arange(steep.shape[1])
    low, high, top = steep[best - 1, rays], steep[best + 1, rays], steep[best, rays]
    bend = np.maximum(2.0 * top - low - high, 1e-12)
    return best + np.clip(0.5 * (high - low) / bend, -0.5, 0.5), peaks.any(0)


def _between(places: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Return values (steps, rays) at parts of a step, (rays,)."""
    low = np.clip(np.floor(at).astype(int), 0, len(places) - 2)
    rays = np.arange(places.shape[1])
    return places[low, rays] + (at - low) * (places[low + 1, rays] - places[low, rays])


def _fit(sphere: Sphere, points: tuple[np.ndarray, np.ndarray], near: float) -> tuple[Sphere, np.ndarray]:
    """Fit a ball to the points (N,) that agree with one, and say which do."""
    rows, columns = points
    sphere = Sphere.through(sphere.camera, sphere.shape, rows, columns, sphere, 0.5 * near)
    for wide in (2.0, 1.4, 1.0):
        on = sphere.radius * np.abs(sphere.offsets(rows, columns) - 1.0) <= wide * near
        if on.sum() >= _RAYS // 6:
            sphere = Sphere.through(sphere.camera, sphere.shape, rows[on], columns[on], sphere, near)
    return sphere, sphere.radius * np.abs(sphere.offsets(rows, columns) - 1.0) <= near


def _measure_arcs(on: np.ndarray) -> float:
    """Return the share of an outline that is seen in arcs; places (N,) bool that hit it by chance make up none."""
    around = np.concatenate([on, on, on])
    closed = ndimage.binary_closing(around, np.ones(_GAP + 1, bool))
    return float(ndimage.binary_opening(closed, np.ones(_ARC, bool))[len(on) : 2 * len(on)].mean())


def settle(view: BallView) -> BallView:
    """Move a ball onto the outline that its window shows, if that is near and nearly all of it is seen.

    Logarithms show it where it is dark, but their steepest place lies on the dark side of a blurred edge; that of the
    brightness itself is looked for last.
    """
    grey, old, step = view.grey, view.sphere, float(view.rows[1, 0] - view.rows[0, 0])
    fields, first = [grey.mean(0), grey.max(0), grey.std(0)], (float(view.rows[0, 0]), float(view.columns[0, 0]))
    new, share = refine_outline(Edges.of([flatten(field) for field in fields], first, step), old)
    rim = np.abs(view.offsets - 1.0) < _BANDS[0][0]
    plain = [np.clip(field / max(float(np.percentile(field[rim], 95)), 1e-9), 0.0, 1.0) for field in fields]
    last, seen = refine_outline(Edges.of(plain, first, step), new)
    if seen > _ALSO * share:
        new, share = last, seen
    moved = max(float(np.hypot(new.x - old.x, new.y - old.y)), abs(new.radius - old.radius))
    far = moved > max(_MOST[0] * old.radius, _MOST[1])
    if share < _SEEN or far:
        return replace(view, outlined=0.0 if far else share)
    return replace(view, sphere=new, outlined=share)


def flatten(field: np.ndarray) -> np.ndarray:
    """Return brightness (h, w) as its logarithm, of which a dark outline is a part as much as a bright one, 0 to 1."""
    floor = max(float(np.percentile(field, 99)) * 2e-3, 1e-7)
    logarithm = np.log(field + floor)
    low, high = np.percentile(logarithm, (1, 99))
    return np.clip((logarithm - low) / max(high - low, 1e-9), 0.0, 1.0)
