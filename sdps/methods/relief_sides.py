"""What tells whether a flat thing's relief stands out or is hollow: cast shadows, and near lamps.

Turned inside out under lights from the opposite side a relief is shaded as before (`flat_things`), and shaded slopes
and what faces away tell nothing. Two things do:

- *Cast shadows.* What stands out throws its shadow onto the ground beyond it, a hollow has it inside, at the rim next
  to the lamp. Shadows are traced on both sides; what is darker than shading explains lies in those of the right one.
- *Near lamps.* The part of a plane next to a lamp is the brightest, so each picture's brightness rises towards where
  the light comes from. A dome under distant lamps looks much like it, so a bent surface may explain what it can first.

Under distant lamps and without shadows nothing is known.
"""

from typing import NamedTuple

import cv2
import numpy as np
from scipy.optimize import least_squares

from render.shared.imaging.reducing import reduce_image
from sdps.core.estimate import Estimate
from sdps.core.integration import integrate
from sdps.core.intensities import grey
from sdps.inference.image_source import ImageSource
from sdps.refinement.shape.transport import trace_shadows

TURN = np.array([-1.0, -1.0, 1.0])
"""Brings normals and lights of one side to those of the other."""
MOST = 32
"""Pictures that are looked at."""
_SIDE, _CELLS = 384, 8  # pixels of the longer side for shadows, and cells for the pictures' trend
_LIT = 0.2  # n . l from which on a pixel should be bright
_DARK, _BRIGHT = 0.25, 0.75  # of what it should be
_FEWEST = 2e-4  # share of the observations that lie in the shadows of one side alone
_AGREED = 0.12  # correlation with one side's shadows over that with the other's
_EXPLAINED = 0.65  # of the misfit that is left once lamps are near
_TREND = 0.25  # of the logarithm of brightness, a radius towards the lamp, for a light from the horizon
_NEAREST, _BENT, _SOFT = 0.8, 1.5, 0.1


class Evidence(NamedTuple):
    """What speaks for the side that was found (above 0) or the other (below 0); 0: nothing.

    Attributes:
        shadows: By how much more what is too dark correlates with the shadows of that side than with the other's.
        falloff: Share of the pictures' trend that near lamps on that side explain and bent surfaces do not.
    """

    shadows: float
    falloff: float

    @property
    def side(self) -> int:
        """1 for the side that was found, -1 for the other; 0 if nothing is known, or both contradict each other."""
        return int(np.sign(np.sign(self.shadows) + np.sign(self.falloff)))

    @property
    def by(self) -> str:
        """What tells the side, in words."""
        return " and ".join(name for name, value in zip(("shadows", "near lamps"), self, strict=True) if value)


def tell_side(images: ImageSource, mask: np.ndarray, found: Estimate) -> Evidence:
    """Return what tells the side of a flat thing.

    Args:
        images: (L, H, W, 3) linear radiance, an array or what reads it a few images at a time.
        mask: (H, W) bool.
        found: Normals whose mean plane faces the camera, and lights.
    """
    chosen = slice(None, None, -(-len(images) // MOST))
    lights = found.light_directions[chosen].astype(np.float64)
    size = _reduced(mask, _SIDE)
    small = [reduce_image(np.asarray(images[k : k + 1])[0].mean(-1), size) for k in range(len(images))[chosen]]
    pictures = np.stack(small).astype(np.float32)
    if found.stray_light is not None:
        pictures -= found.stray_light[chosen].mean(-1)[:, None, None]
    pictures /= np.maximum(grey(found.intensities[chosen]), 1e-6)[:, None, None]
    inside = reduce_image(mask.astype(np.float32), size) > 0.99
    return Evidence(_see_shadows(pictures, inside, found.normals, lights), _see_falloff(pictures, inside, lights))


def _reduced(mask: np.ndarray, longest: int) -> tuple[int, int]:
    """Return rows and columns of a picture whose longer side has so many pixels at most."""
    factor = min(1.0, longest / max(mask.shape))
    return max(1, round(mask.shape[0] * factor)), max(1, round(mask.shape[1] * factor))


def _see_shadows(pictures: np.ndarray, inside: np.ndarray, normals: np.ndarray, lights: np.ndarray) -> float:
    """Return by how much better shadows of this side explain what is dark than those of the other; 0: too little.

    Args:
        pictures: (L, h, w) grey, of lights of one intensity.
        inside: (h, w) bool.
        normals: (H, W, 3).
        lights: (L, 3).
    """
    slopes = normals[..., :2] / np.maximum(normals[..., 2:], 0.1)
    slopes = cv2.resize(slopes.astype(np.float32), inside.shape[::-1], interpolation=cv2.INTER_AREA)
    laid = np.concatenate([slopes, np.ones_like(slopes[..., :1])], axis=-1)
    laid /= np.linalg.norm(laid, axis=-1, keepdims=True)
    heights = integrate(laid * inside[..., None], inside).z
    unit, values = laid[inside], pictures[:, inside].T  # (P, 3), (P, L)
    cosines = unit @ lights.T.astype(np.float32)
    usable = cosines > _LIT
    share = np.where(usable, values / np.maximum(cosines, _LIT), np.nan)
    usable &= np.isfinite(share) & usable.any(axis=1, keepdims=True)
    share[~usable.any(axis=1)] = 0.0
    share /= np.maximum(np.nanmedian(share, axis=1), 1e-9)[:, None]
    dark = np.clip((_BRIGHT - share) / (_BRIGHT - _DARK), 0.0, 1.0)
    cast = [~trace_shadows(turn * heights, inside, unit * side, lights * side) & usable
            for turn, side in ((1.0, np.ones(3)), (-1.0, TURN))]  # fmt: skip
    if (cast[0] ^ cast[1]).mean() < _FEWEST:
        return 0.0
    here, there = (_correlate(dark[usable], some[usable]) for some in cast)
    return here - there if abs(here - there) > _AGREED else 0.0


def _correlate(dark: np.ndarray, cast: np.ndarray) -> float:
    """Return Pearson's correlation of darkness (n,) and shadows (n,) bool; 0 where one of them does not vary."""
    spread = float(dark.std() * cast.std())
    return float(((dark - dark.mean()) * (cast - cast.mean())).mean()) / spread if spread > 0.0 else 0.0


def _see_falloff(pictures: np.ndarray, inside: np.ndarray, lights: np.ndarray) -> float:
    """Return the share of the trend that near lamps explain, negative if they stand on the other side; 0: too little.

    Arguments as of `_see_shadows`.
    """
    mean = np.maximum(pictures.mean(axis=0), 1e-9)
    size = _reduced(inside, _CELLS)
    weight = reduce_image(inside.astype(np.float32), size)
    cells = np.stack([reduce_image(np.where(inside, picture / mean, 0.0), size) for picture in pictures])
    there = weight > 0.5
    if there.sum() < _CELLS or len(lights) < 3:
        return 0.0
    trend = _centre(np.log(np.maximum(cells[:, there] / weight[there], 1e-3)))  # (L, c)
    rows, columns = np.nonzero(there)
    half = max(size) / 2
    places = np.stack([columns - columns.mean(), rows.mean() - rows, np.zeros(len(rows))], axis=1) / half
    slopes = np.linalg.lstsq(places[:, :2], trend.T, rcond=None)[0].T  # (L, 2)
    aside = lights[:, :2] - lights[:, :2].mean(axis=0)
    along = float((aside * slopes).sum() / max((aside**2).sum(), 1e-9))
    if abs(along) < _TREND:
        return 0.0
    here, there_ = _fit_trend(trend, places, lights), _fit_trend(trend, places, lights * TURN)
    near, other = (here, there_) if along > 0.0 else (there_, here)
    return float(np.sign(along)) * (1.0 - near / other) if near < _EXPLAINED * other else 0.0


def _fit_trend(trend: np.ndarray, places: np.ndarray, lights: np.ndarray) -> float:
    """Return the misfit of lamps, near or not, over a surface that is bent as it likes (a cubic)."""
    x, y = places[:, 0], places[:, 1]
    none = np.zeros_like(x)
    across = np.stack([x, y, none, 3 * x * x, 2 * x * y, y * y, none])
    down = np.stack([none, x, y, none, x * x, 2 * x * y, 3 * y * y])

    def miss(values: np.ndarray) -> np.ndarray:
        off = lights[:, None] - values[0] * places
        facing = off[..., 2] - off[..., 0] * (values[1:] @ across) - off[..., 1] * (values[1:] @ down)
        return (_centre(np.log(np.maximum(facing, 0.02) / (off**2).sum(-1) ** 1.5)) - trend).ravel()

    limits = np.array([_NEAREST, *(_BENT,) * len(across)])
    bounds = (np.array([0.0, *(-_BENT,) * len(across)]), limits)
    starts = (np.array([first, *(0.0,) * len(across)]) for first in (0.02, 0.15, 0.35))
    return min(least_squares(miss, start, bounds=bounds, loss="soft_l1", f_scale=_SOFT).cost for start in starts)


def _centre(values: np.ndarray) -> np.ndarray:
    """Take the means of each picture and of each cell off values (L, c)."""
    values = values - values.mean(axis=1, keepdims=True)
    return values - values.mean(axis=0)
