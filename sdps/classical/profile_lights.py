"""Lights from known normals and intensity profiles: the last step of `profile_distances`.

Ours throughout; the papers' detail is not public.
"""

from dataclasses import dataclass

import numpy as np
from scipy.optimize import isotonic_regression

from render.shared.imaging.vectors import spiral, unit

CLIP, POWER = 0.85, 0.7
"""Quantile of a profile above which brightness is cut, and the exponent on the rest: highlights must not rule."""

_BINS = 40
"""Bins of the curve over n . l in [-1, 1]."""

_PRIOR = 0.02
"""Price of an intensity e-fold off the others, as a share of an image's squared brightness: light from behind leaves
only a dim rim, on which direction and intensity cannot be told apart without it."""

_SEEN = 0.2
"""Share of the samples a light must reach for its intensity to count in full."""


@dataclass(frozen=True, eq=False)
class Lights:
    """Lights of a set of images.

    Attributes:
        directions: (L, 3) float64, unit; (0, 0, -1) for black images, whose light can only be behind.
        intensities: (L,) float64, mean 1 over the others, 0 for black images.
        curve: (B,) float64, brightness over n . l from -1 to 1, at most 1.
    """

    directions: np.ndarray
    intensities: np.ndarray
    curve: np.ndarray


def find_lights(profiles: np.ndarray, shapes: np.ndarray, normals: np.ndarray) -> Lights:
    """Find direction and intensity of every light.

    Directions come from the shapes, which highlights hardly touch: shape_ik = a_i s_k f(n_i . l_k) with one rising
    curve f for all, started at Lambert's law, cut and compressed alike. Intensities come from the ratio of the images
    to a curve of their own, by medians; lights that reach few pixels are drawn to the median of the others.

    Args:
        profiles: (S, L), linear brightness of sample pixels.
        shapes: (S, L), the same clipped and compressed, largest value 1.
        normals: (S, 3), unit.
    """
    heights = np.linspace(-1.0, 1.0, _BINS)
    curve = np.clip(heights / (2.0 * CLIP - 1.0), 0.0, 1.0) ** POWER  # a share 1 - CLIP of a sphere of lights is above
    scales = np.ones(len(normals))
    for _ in range(3):
        values = shapes / scales[:, None]
        directions, gains = _search(values, normals, heights, curve)
        cosines = normals @ directions.T  # (S, L)
        curve = _rising(cosines, values / np.maximum(gains, 1e-6), gains > 0.0)
        model = np.interp(cosines, heights, curve) * gains
        scales = (shapes * model).sum(1) / np.maximum((model**2).sum(1), 1e-12)
        scales = np.clip(scales / max(float(np.median(scales)), 1e-12), 0.1, 10.0)
    black = profiles.max(0) <= 0.0
    directions[black] = (0.0, 0.0, -1.0)
    intensities = _intensities(profiles, normals @ directions.T)
    intensities[black] = 0.0
    return Lights(directions, intensities / max(float(intensities[~black].mean()), 1e-30), curve)


def _search(
    values: np.ndarray, normals: np.ndarray, heights: np.ndarray, curve: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the best direction (L, 3) and gain (L,) of each image: on a grid, then around its best point."""
    grid = spiral(2500)
    cost, gain = _costs(values.T, np.interp(normals @ grid.T, heights, curve).T)  # (L, G)
    best = cost.argmin(1)
    directions, gains = grid[best], gain[np.arange(len(best)), best]
    disc = np.concatenate([[[0.0, 0.0]], *([_ring(6 * k) * k / 3.0] for k in (1, 2, 3))], axis=None).reshape(-1, 2)
    for radius in (0.08, 0.03, 0.01):
        for k, centre in enumerate(directions):
            across = np.linalg.svd(centre[None])[2][1:]  # two directions at right angles
            near = centre + radius * disc @ across
            near = unit(near)
            cost, gain = _costs(values[:, k][None], np.interp(normals @ near.T, heights, curve).T)
            directions[k], gains[k] = near[cost[0].argmin()], gain[0, cost[0].argmin()]
    return directions, gains


def _ring(count: int) -> np.ndarray:  # (count, 2)
    angle = np.arange(count) * 2.0 * np.pi / count
    return np.stack([np.cos(angle), np.sin(angle)], axis=-1)


def _costs(values: np.ndarray, models: np.ndarray) -> tuple[np.ndarray, np.ndarray]:  # (L, G) twice
    """Return the misfit of images (L, S) under models (G, S), each scaled to fit, and the scales."""
    power = np.maximum((models**2).sum(1), 1e-9)
    gain = np.maximum(values @ models.T, 0.0) / power
    total = np.maximum((values**2).sum(1), 1e-12)[:, None]
    return 1.0 - gain**2 * power / total + _PRIOR * np.log(np.maximum(gain, 1e-3)) ** 2, gain


def _rising(cosines: np.ndarray, values: np.ndarray, valid: np.ndarray) -> np.ndarray:  # (B,)
    """Return the rising curve nearest to the mean of `values` per bin of `cosines`, both (S, L), largest value 1."""
    bins = np.rint((cosines[:, valid] + 1.0) / 2.0 * (_BINS - 1)).astype(int).ravel()
    count = np.bincount(bins, minlength=_BINS)
    mean = np.bincount(bins, values[:, valid].ravel(), minlength=_BINS) / np.maximum(count, 1)
    filled = np.interp(np.arange(_BINS), np.flatnonzero(count), mean[count > 0])
    curve = isotonic_regression(filled, weights=count + 1e-3).x
    return np.maximum(curve, 0.0) / max(float(curve[-1]), 1e-12)


def _intensities(profiles: np.ndarray, cosines: np.ndarray) -> np.ndarray:  # (L,)
    """Split log brightness into light + albedo + curve(n . l) by medians over what is clearly lit."""
    lit = (cosines > 0.15) & (profiles > 0.0)
    few = lit.sum(0) < 20  # light from behind: take its rim, however steep
    lit[:, few] = (cosines[:, few] > 0.02) & (profiles[:, few] > 0.0)
    logs = np.where(lit, np.log(np.maximum(profiles, 1e-30)), np.nan)
    bins = np.clip((cosines * 25.0).astype(int), 0, 25)
    light = np.zeros(profiles.shape[1])
    albedo, curve = np.zeros(len(profiles)), np.log((np.arange(26) + 0.5) / 25.0)
    for _ in range(4):
        albedo = _median(logs - light - curve[bins], 1)
        rest = logs - light - albedo[:, None]
        curve = np.array([np.median(rest[part]) if (part := lit & (bins == b)).any() else curve[b] for b in range(26)])
        light = _median(logs - albedo[:, None] - curve[bins], 0, light)
    # A rim seen at grazing angles says little about strength, and on glossy surfaces it says too much.
    trust = np.minimum((cosines > 0.15).mean(0) / _SEEN, 1.0)
    middle = float(np.median(light[trust >= 1.0])) if (trust >= 1.0).any() else float(np.median(light))
    light = middle + trust * (light - middle)
    return np.exp(light - light.max())


def _median(values: np.ndarray, axis: int, otherwise: np.ndarray | float = 0.0) -> np.ndarray:
    """Return the median of what is not NaN, `otherwise` where nothing is."""
    known = np.isfinite(values).any(axis)
    safe = np.where(np.expand_dims(known, axis), values, 0.0)
    return np.where(known, np.nanmedian(safe, axis=axis), otherwise)
