"""The highlight of a lamp on a chrome ball: where it is in each picture, and from where its light comes.

What does not change between the pictures is the room and is taken off. Of what is left, the brightest part is the
highlight. Its pixels are turned into mirror directions one by one, and their mean counts: every pixel of an
orthographic picture shows a part of the surroundings of one size, so that this is the middle of the lamp, whatever
its shape on the ball, and bloom around it counts little.
"""

from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from sdps.photos.analysis.balls.ball_views import BallView

_EDGE = 0.5  # of the peak, above which a pixel belongs to the highlight
_FAINT = 0.1  # of the usual peak, below which there is none
_SMALL, _SLOPE = 40, 0.1  # pixels of a highlight whose slopes count, and the part of the peak that is taken off them
_NOISE = 8.0  # standard deviations
_SECOND = 0.5  # light of a second highlight over that of the first, from which on neither can be believed
_APART = 0.05  # radii between highlights that are not one
_LARGE = 0.15  # share of the ball above which it is not the highlight of a lamp
_RIM = 0.97  # radii

MISSING = "no highlight of a lamp on the ball"
SEVERAL = "several highlights on the ball: switch other lights off"
AT_RIM = "the highlight lies at the ball's rim: the lamp stood beside or behind it"
SPREAD = "no small highlight on the ball"


@dataclass(frozen=True, eq=False)
class Highlights:
    """Highlights on a ball.

    Attributes:
        places: (L, 2) column and row, to parts of a pixel; NaN where there is none.
        points: (L, 3) where they lie on the ball.
        directions: (L, 3) unit, to the lamps; NaN where there is none.
        faults: (L,) why there is none; empty where there is one.
        shares: (L,) of the ball's outline, how much each covers.
    """

    places: np.ndarray
    points: np.ndarray
    directions: np.ndarray
    faults: tuple[str, ...]
    shares: np.ndarray


def find_highlights(view: BallView) -> Highlights:
    """Find the highlight of every picture."""
    offsets = view.offsets
    inside = offsets <= 1.0
    moving = np.where(inside, view.grey - view.grey.min(0), 0.0)
    peaks = moving.max((1, 2))
    usual = float(np.median(peaks))
    count = len(moving)
    places, points = np.full((count, 2), np.nan), np.full((count, 3), np.nan)
    directions, shares, faults = np.full((count, 3), np.nan), np.zeros(count), []
    for number, (light, peak) in enumerate(zip(moving, peaks, strict=True)):
        level = np.median(light[inside])
        spread = 1.4826 * np.median(np.abs(light[inside] - level))
        if peak <= max(_FAINT * usual, level + _NOISE * spread, 1e-9):
            faults.append(MISSING)
            continue
        blob, fault = _take_highlight(view, light, peak, offsets)
        faults.append(fault)
        if fault:
            continue
        blob, weights = _weigh(blob, light, peak)
        rows, columns = view.rows[blob], view.columns[blob]
        mean = np.average(view.sphere.mirror(rows, columns), axis=0, weights=weights)
        places[number] = np.average(columns, weights=weights), np.average(rows, weights=weights)
        points[number] = view.sphere.hit(places[number, 1], places[number, 0])[0]
        directions[number] = mean / np.linalg.norm(mean)
        shares[number] = blob.sum() / inside.sum()
        if directions[number, 2] <= 0.0:
            faults[-1], directions[number] = AT_RIM, np.nan
    return Highlights(places, points, directions, tuple(faults), shares)


def _weigh(blob: np.ndarray, light: np.ndarray, peak: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the pixels (h, w) bool that tell a highlight's middle, and weights; a small one's slopes count too."""
    if blob.sum() >= _SMALL:
        return blob, light[blob]
    blob = ndimage.binary_dilation(blob, np.ones((3, 3), bool), iterations=2)
    return blob, np.maximum(light[blob] - _SLOPE * peak, 0.0)


def _take_highlight(view: BallView, light: np.ndarray, peak: float, offsets: np.ndarray) -> tuple[np.ndarray, str]:
    """Return the pixels (h, w) bool of the highlight of one picture, and why it cannot be believed, if so.

    A lamp that lights the object is seen in the ball's inner part; beyond, the object itself is mirrored.
    """
    parts, count = ndimage.label(light >= _EDGE * peak, np.ones((3, 3)))
    numbers = np.arange(1, count + 1)
    sums = ndimage.sum_labels(light, parts, numbers)
    middles = np.array(ndimage.center_of_mass(light, parts, numbers))
    rows, columns = (ndimage.map_coordinates(where, middles.T, order=1) for where in (view.rows, view.columns))
    front = view.sphere.mirror(rows, columns)[:, 2] > 0.0
    if not front.any():
        return parts > 0, AT_RIM
    order = np.argsort(np.where(front, -sums, 0.0))
    first = parts == order[0] + 1
    if first.sum() > _LARGE * (offsets <= 1.0).sum():
        return first, SPREAD
    if offsets[first].min() > _RIM:
        return first, AT_RIM
    if front.sum() > 1 and sums[order[1]] > _SECOND * sums[order[0]]:
        away = np.hypot(rows[order[1]] - rows[order[0]], columns[order[1]] - columns[order[0]])
        if away > _APART * view.sphere.radius:
            return first, SEVERAL
    return first, ""
