"""Diffuse and specular parts of the images of an object, for the methods that live on highlights.

Robust principal component analysis takes a highlight for sparse only while its lobe is narrow. On a glossy object a
third of the samples may lie in the lobe, and the low-rank part then holds it too. Here Lambert's law with attached
shadows, i = max(b . s, 0), is fitted to those samples that follow it: a factorisation with missing data, as in
Hayakawa (JOSA A 1994), solved by iteratively reweighted least squares whose tolerance shrinks. The weighting is ours:
a sample far brighter than the fit is a highlight, and a dark one where b . s < 0 agrees with it.
"""

import numpy as np

from render.shared.progress import progress_bar
from render.shared.seeds import generator
from sdps.classical.common.factorisation import Factors, balance, column_scale, factorise
from sdps.classical.common.weighted import normal_equations

_COARSE, _FINE = 0.4, 0.02
"""Tolerance at the start and at the end, over the typical diffuse value of a pixel."""

_SHADOW = 0.03
"""Brightness below which a sample may be an attached shadow, over the typical value of its pixel."""

_CLIP = 1.5
"""Value over the typical one of a pixel at which the starting solution cuts highlights off."""

_STEPS, _SURFACE_STEPS = 40, 12
"""Alternations that find the lights, and the reweightings of a pixel under known ones."""

_CHUNK = 20_000
"""Pixels at a time in the final solve; keeps the memory flat."""


def diffuse_factors(profiles: np.ndarray, *, samples: int = 6000, seed: int = 0) -> Factors:
    """Fit i = max(b . s, 0) to the samples that follow it; the tolerance reaches its end after two thirds of the steps.

    Args:
        profiles: (P, L), non-negative.
        samples: Most pixels that take part in finding the lights.
        seed: Root seed of the draw.

    Returns:
        The factors, balanced (`balance`).

    Raises:
        InputError: fewer than three dimensions; see `factorise`.
    """
    total = len(profiles)
    chosen = np.arange(total)
    if total > samples:
        chosen = np.sort(generator(seed, "separation").choice(total, samples, replace=False))
    levels, gains = _scales(profiles[chosen])
    values = profiles[chosen] / levels[:, None] / gains
    start = factorise(np.minimum(values, _CLIP))
    surface, lights = start.surface, start.lights.T
    for step in progress_bar(range(_STEPS), desc="diffuse fit", unit="step"):
        progress = step / (_STEPS - 1)
        surface = _solve(values, _weights(values, surface @ lights.T, progress), lights)
        lights = _solve(values.T, _weights(values, surface @ lights.T, progress).T, surface)
        scale = column_scale(surface)
        surface, lights = surface @ np.linalg.inv(scale), lights @ scale.T  # well conditioned, same product
    if total > len(chosen):
        return balance(diffuse_surface(profiles, lights * gains[:, None]), lights.T * gains)
    return balance(surface * levels[:, None], lights.T * gains)


def diffuse_surface(profiles: np.ndarray, lights: np.ndarray) -> np.ndarray:  # (P, 3)
    """Fit i = max(b . s, 0) pixel by pixel under known lights (L, 3) to the samples that follow it; returns b."""
    gains = np.maximum(np.linalg.norm(lights, axis=1), 1e-12)
    lights32 = (lights / gains[:, None]).astype(np.float32)
    surface = np.empty((len(profiles), 3))
    for start in progress_bar(range(0, len(profiles), _CHUNK), desc="diffuse part", unit="chunk"):
        part = slice(start, start + _CHUNK)
        values = (profiles[part] / gains).astype(np.float32)
        levels = _levels(values)
        values /= levels[:, None].astype(np.float32)
        found = _solve(np.minimum(values, _CLIP), np.ones_like(values), lights32)
        for step in range(_SURFACE_STEPS):
            weights = _weights(values, found.astype(np.float32) @ lights32.T, step / (_SURFACE_STEPS - 1))
            found = _solve(values, weights, lights32)
        surface[part] = found * levels[:, None]
    return surface


def _scales(profiles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return typical values of pixels (P,) and of images (L,) whose product fits the lit samples."""
    lit = profiles > 0.02 * profiles.max()
    gains, levels = np.ones(profiles.shape[1]), np.ones(len(profiles))
    for _ in range(3):
        scaled = np.where(lit, profiles / levels[:, None], np.nan)
        enough = lit.any(0)
        gains[enough] = np.nanmedian(scaled[:, enough], axis=0)
        levels = _levels(profiles / gains)
    return levels, gains


def _levels(values: np.ndarray) -> np.ndarray:  # (P,)
    """Return the median of the lit samples of every pixel; highlights and attached shadows hardly move it."""
    lit = values > 0.1 * values.mean(1, keepdims=True)
    dark = ~lit.any(1)
    result = np.ones(len(values))
    result[~dark] = np.nanmedian(np.where(lit, values, np.nan)[~dark], axis=1)
    return result


def _weights(values: np.ndarray, model: np.ndarray, progress: float) -> np.ndarray:  # (P, L)
    """Return Geman-McClure weights, twice as tolerant of samples below the model; 0 for explained shadows.

    The tolerance shrinks as `progress` goes from 0 to 1, but never under three deviations of the noise, which the
    smallest quarter of the residuals tells whatever the highlights do.
    """
    residual = values - np.maximum(model, 0.0)
    shadows = (model <= 0.0) & (values < _SHADOW)
    some = residual[:: max(1, len(residual) // 1000)][~shadows[:: max(1, len(residual) // 1000)]]
    noise = float(np.quantile(np.abs(some), 0.25)) / 0.319 if some.size else 0.0
    tolerance = max(_COARSE * (_FINE / _COARSE) ** min(1.5 * progress, 1.0), min(3.0 * noise, _COARSE))
    scaled = residual / np.where(residual > 0.0, tolerance, 2.0 * tolerance).astype(values.dtype)
    return np.where(shadows, 0.0, (1.0 + scaled * scaled) ** -2).astype(values.dtype)


def _solve(values: np.ndarray, weights: np.ndarray, basis: np.ndarray) -> np.ndarray:  # (P, 3)
    """Solve values (P, L) ~ x (P, 3) basis^T (3, L) row by row with weights (P, L)."""
    matrices, targets = normal_equations(basis, values, weights)
    ridge = 1e-6 * np.trace(matrices, axis1=1, axis2=2) + 1e-12  # a pixel without samples gets the zero vector
    matrices += ridge[:, None, None] * np.eye(3)
    return np.linalg.solve(matrices, targets[..., None])[..., 0]
