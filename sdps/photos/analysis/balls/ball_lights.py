"""From what balls show to the lights of the pictures: directions, intensities of white balls, positions of several.

Two rays from two balls, l_b from the point p_b, meet at the lamp; the point X closest to all of them solves
sum_b (I - l_b l_b^T) (X - p_b) = 0.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from sdps.core.geometry import Capture
from sdps.photos.analysis.balls.ball_flags import CHROME, WHITE
from sdps.photos.analysis.balls.ball_highlights import MISSING, Highlights, find_highlights
from sdps.photos.analysis.balls.ball_views import BallView

_MATT = 0.6  # share of the variance that Lambert's law must explain on a white ball, in most pictures
OUTLINED = 0.15
"""Share of a ball's outline that should be seen."""
_UNLIT = "too little of the white ball is lit"
_FARTHEST = 50.0  # object sizes, beyond which a lamp is distant


@dataclass(frozen=True, eq=False)
class BallRays:
    """What one ball says of the lights.

    Attributes:
        kind: `chrome` or `white`.
        view: It in the pictures.
        points: (L, 3) where the rays to the lamps begin.
        directions: (L, 3) unit; NaN where the picture shows none.
        intensities: (L, 3) of a white ball, relative; None of a chrome one.
        faults: (L,) why a picture shows none; empty where it does.
        highlights: (L, 2) column and row of the highlight on a chrome ball, else NaN.
        millimetres: The ball's real radius; None: not known.
    """

    kind: str
    view: BallView
    points: np.ndarray
    directions: np.ndarray
    intensities: np.ndarray | None
    faults: tuple[str, ...]
    highlights: np.ndarray
    millimetres: float | None = None

    def take(self, order: Sequence[int]) -> "BallRays":
        """Return it for some pictures, in another order."""
        chosen, strengths = list(order), self.intensities
        view = replace(self.view, colours=self.view.colours[chosen], clipped=self.view.clipped[chosen])
        return replace(
            self, view=view, points=self.points[chosen], directions=self.directions[chosen],
            highlights=self.highlights[chosen],
            faults=tuple(self.faults[number] for number in chosen),
            intensities=None if strengths is None else strengths[chosen],
        )  # fmt: skip

    @property
    def share(self) -> float:
        """Share of the pictures that show a light."""
        return float(np.isfinite(self.directions[:, 0]).mean())


@dataclass(frozen=True, eq=False)
class BallLights:
    """What all balls say of the lights; the pictures of `kept` alone have one.

    Attributes:
        directions: (L, 3) unit, from the object's middle; NaN elsewhere.
        intensities: (L, 3) relative; None without a white ball.
        distances: (L,) of the lamps from the object's middle, in its sizes, inf of distant ones; None of one ball.
        apart: RMS degrees by which the balls' rays miss one another; None of one ball.
        faults: (L,) why a picture has none; empty where it has.
    """

    directions: np.ndarray
    intensities: np.ndarray | None = None
    distances: np.ndarray | None = None
    apart: float | None = None
    faults: tuple[str, ...] = field(default=())

    @property
    def kept(self) -> np.ndarray:
        """Pictures with a light, (L,) bool."""
        return np.isfinite(self.directions[:, 0])


def trace_rays(view: BallView, kind: str = "") -> BallRays:
    """Return what a ball says of the lights.

    Args:
        view: It in the pictures.
        kind: `chrome` or `white`; empty: as the pictures tell.
    """
    if (kind or tell_kind(view)) == WHITE:
        return _trace_white(view)
    found: Highlights = find_highlights(view)
    return BallRays(CHROME, view, found.points, found.directions, None, found.faults, found.places)


def tell_kind(view: BallView) -> str:
    """Return `white` where Lambert's law explains what the ball shows in most pictures, else `chrome`.

    It explains a part of a matt object nearly as well, so that some of a white ball's outline must be seen.
    """
    return WHITE if view.outlined >= OUTLINED and np.median(view.shaded[1]) >= _MATT else CHROME


def _trace_white(view: BallView) -> BallRays:
    shading, explained = view.shaded
    count = len(shading)
    sums = shading.mean(1)
    lengths = np.linalg.norm(sums, axis=-1, keepdims=True)
    with np.errstate(invalid="ignore", divide="ignore"):
        directions = sums / lengths
        strengths = np.linalg.norm(shading, axis=-1)
        good = (explained > 0.0) & (directions[:, 2] > 0.0) & (strengths > 0.0).all(-1)
    directions[~good], strengths[~good] = np.nan, np.nan
    faults = tuple("" if fine else _UNLIT for fine in good.tolist())
    points = np.repeat(view.sphere.middle[None], count, 0)
    return BallRays(WHITE, view, points, directions, strengths, faults, np.full((count, 2), np.nan))


def join_rays(
    rays: Sequence[BallRays], capture: Capture, distant: bool = False, reach: float | None = None
) -> BallLights:
    """Join what balls say: positions where several see a lamp, directions where one does.

    Args:
        rays: Of each ball.
        capture: The object.
        distant: The lamps are known to be far away.
        reach: Their distance from the object's middle in its sizes, where the user says it.
    """
    directions = np.stack([ray.directions for ray in rays])  # (B, L, 3)
    seen = np.isfinite(directions[..., 0])
    with np.errstate(invalid="ignore"):
        sums = np.nansum(directions, axis=0)
        mean = sums / np.linalg.norm(sums, axis=-1, keepdims=True)
    mean[~seen.any(0)] = np.nan
    faults = tuple(
        "" if any(column) else next((ray.faults[number] for ray in rays if ray.faults[number]), MISSING)
        for number, column in enumerate(seen.T.tolist())
    )
    points = np.stack([ray.points for ray in rays])
    size = 2.0 * capture.radius
    lamps = None
    if len(rays) > 1 and not distant and reach is None and (seen.sum(0) > 1).any():
        lamps = _meet(points, directions, seen, capture.centre, _FARTHEST * size)
        known = np.isfinite(lamps[:, 0])
        away = np.linalg.norm(lamps[known] - capture.centre, axis=-1)
        if known.any():  # a lamp that one ball alone sees stands as far away as the others
            lamps = _reach(points, directions, seen, lamps, capture.centre, float(np.median(away)))
    elif reach is not None and not distant:
        lamps = _reach(points, directions, seen, np.full_like(mean, np.nan), capture.centre, reach * size)
    distances, apart, strengths = None, None, _mean_intensities(rays, lamps, capture.centre)
    if len(rays) > 1:
        apart = _measure_apart(points, directions, mean, lamps)
    if lamps is not None:
        off = lamps - capture.centre
        away = np.linalg.norm(off, axis=-1)
        mean = np.where(np.isfinite(away)[:, None], off / away[:, None], mean)
        distances = None if reach is not None else np.where(np.isfinite(away), away / size, np.inf)
    return BallLights(mean, strengths, distances, apart, faults)


def _meet(
    points: np.ndarray, directions: np.ndarray, seen: np.ndarray, centre: np.ndarray, farthest: float
) -> np.ndarray:  # (L, 3)
    """Return where the rays of each lamp meet; NaN where fewer than two are there, or they do not meet before them."""
    lamps = np.full(directions.shape[1:], np.nan)
    for number in np.flatnonzero(seen.sum(0) > 1):
        start, ray = points[seen[:, number], number], directions[seen[:, number], number]
        across = np.eye(3) - ray[:, :, None] * ray[:, None]  # (B, 3, 3)
        where = np.linalg.lstsq(across.sum(0), (across @ start[..., None]).sum(0)[:, 0], rcond=None)[0]
        ahead = ((where - start) * ray).sum(-1)
        if (ahead > 0.0).all() and np.linalg.norm(where - centre) < farthest:
            lamps[number] = where
    return lamps


def _reach(
    points: np.ndarray, directions: np.ndarray, seen: np.ndarray, lamps: np.ndarray, centre: np.ndarray, away: float
) -> np.ndarray:  # (L, 3)
    """Place lamps that one ball sees at a distance from the object's middle; several: the mean of their places."""
    one = seen.sum(0) == 1 if np.isfinite(lamps).any() else seen.any(0)
    start = points - centre
    along = (start * directions).sum(-1)
    inside = along**2 - (start**2).sum(-1) + away**2
    with np.errstate(invalid="ignore"):
        places = points + (np.sqrt(inside) - along)[..., None] * directions
    lamps = lamps.copy()
    for number in np.flatnonzero(one & (seen & (inside > 0.0)).any(0)):
        lamps[number] = places[seen[:, number] & (inside[:, number] > 0.0), number].mean(0)
    return lamps


def _measure_apart(points: np.ndarray, directions: np.ndarray, mean: np.ndarray, lamps: np.ndarray | None) -> float:
    """Return the RMS degrees between the balls' rays and the lamps they are joined to."""
    to = np.broadcast_to(mean, directions.shape).copy()
    if lamps is not None:
        known = np.isfinite(lamps[:, 0])
        to[:, known] = lamps[known] - points[:, known]
    cosines = (to * directions).sum(-1) / np.linalg.norm(to, axis=-1)
    several = np.isfinite(directions[..., 0]).sum(0) > 1
    return float(np.degrees(np.sqrt(np.nanmean(np.arccos(np.clip(cosines[:, several], -1.0, 1.0)) ** 2))))


def _mean_intensities(rays: Sequence[BallRays], lamps: np.ndarray | None, centre: np.ndarray) -> np.ndarray | None:
    """Return intensities (L, 3) at the object's middle, each channel's mean 1; None without a white ball that sees all
    lamps that are seen.
    """
    found = []
    for ray in rays:
        if ray.intensities is None:
            continue
        values = ray.intensities / np.nanmean(ray.intensities, axis=0)
        if lamps is not None:
            known = np.isfinite(lamps[:, 0])
            near = ((lamps[known] - ray.points[known]) ** 2).sum(-1) / ((lamps[known] - centre) ** 2).sum(-1)
            values[known] *= near[:, None]
        found.append(values)
    if not found:
        return None
    every = np.stack(found)
    seen, lit = np.isfinite(every[..., 0]).any(0), np.isfinite([ray.directions[:, 0] for ray in rays]).any(0)
    if (lit & ~seen).any():
        return None
    total = np.nansum(every, axis=0) / np.maximum(np.isfinite(every).sum(0), 1)
    return total / total[seen].mean(0)
