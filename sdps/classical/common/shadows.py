"""Three dimensions fitted with shadows as missing data.

Singular values count the zero of an attached shadow as shading, which bends the factorisation: on a Lambertian sphere
under lights down to 17 degrees above the image plane even the best bas-relief transformation then leaves 9 degrees.
Here the rank-3 factorisation I = B S is fitted to lit observations, by alternating least squares (Shum, Ikeuchi &
Reddy, PAMI 1995; Wu et al., ACCV 2010, leave shadows out of their low-rank fit likewise).
"""

import numpy as np

from render.shared.seeds import generator
from sdps.classical.common.factorisation import Factors, balance
from sdps.classical.common.weighted import solve_weighted

_SHADOW = 0.05
"""Share of a pixel's typical lit observation, at the image's exposure, below which one is taken for a shadow."""

_CHUNK = 16384
"""Pixels solved at a time."""


_SAMPLES, _STEPS = 8000, 60
"""Pixels that S is fitted on, and alternations; with S known, every pixel is solved by itself."""


def fit_lit(profiles: np.ndarray, cleaned: np.ndarray, start: np.ndarray, *, seed: int = 0) -> Factors:
    """Fit I = B S to lit observations.

    A shadow says only that shading is not positive there: it counts where the fit exceeds it, and not otherwise.
    Without shadows this is the factorisation by singular values; bringing pixels to one brightness first was worse on
    photographs, whose dark pixels obey Lambert's law least.

    Args:
        profiles: (P, L), intensity profiles, which tell what is in shadow.
        cleaned: (P, L), the same without highlights.
        start: S, (3, L), of a factorisation to start from.
        seed: Root seed of the sample.

    Returns:
        The factors, balanced (`balance`).

    Raises:
        InputError: the lit observations have fewer than three dimensions.
    """
    peak = profiles.max(1)
    bright = np.flatnonzero(peak > 0.05 * np.median(peak))
    chosen = generator(seed, "lit factors").permutation(bright)[:_SAMPLES]
    exposure = _typical(profiles[chosen].T)  # (L,)
    data = _Lit(profiles[chosen], cleaned[chosen], exposure)
    lights = start.T  # (L, 3)
    surface = solve_weighted(lights, data.values, data.lit, np.zeros((len(chosen), 3)))
    for _ in range(_STEPS):
        lights = solve_weighted(surface, data.values.T, data.counts(surface @ lights.T).T, lights)
        lights = np.linalg.qr(lights)[0] * np.sqrt(len(lights))  # its scale is free; keep it from drifting
        surface = data.solve(lights, surface)
    found = []
    for part in (slice(begin, begin + _CHUNK) for begin in range(0, len(profiles), _CHUNK)):
        data = _Lit(profiles[part], cleaned[part], exposure)
        surface = solve_weighted(lights, data.values, data.lit, np.zeros((len(data.values), 3)))
        for _ in range(5):
            surface = data.solve(lights, surface)
        found.append(surface)
    return balance(np.concatenate(found), lights.T)


class _Lit:
    """Profiles (P, L) with what is lit."""

    def __init__(self, profiles: np.ndarray, cleaned: np.ndarray, exposure: np.ndarray) -> None:
        even = profiles / exposure
        self.lit = even > _SHADOW * _typical(even)[:, None]
        self.values = np.maximum(cleaned, 0.0)

    def counts(self, fit: np.ndarray) -> np.ndarray:  # (P, L)
        """Return 1 for what is to be fitted, 0 for shadows that the fit does not exceed."""
        return (self.lit | (fit > self.values)).astype(np.float64)

    def solve(self, lights: np.ndarray, surface: np.ndarray) -> np.ndarray:  # (P, 3)
        """Return the surface under lights (L, 3), shadows judged by the surface before."""
        return solve_weighted(lights, self.values, self.counts(surface @ lights.T), surface)


def _typical(rows: np.ndarray) -> np.ndarray:  # (N,)
    """Return the median of each row of (N, M) over what is not black there; positive."""
    lit = rows > 0.02 * rows.max(1, keepdims=True)
    ordered = np.sort(np.where(lit, rows, np.inf), axis=1)
    middle = ordered[np.arange(len(rows)), np.maximum(lit.sum(1) - 1, 0) // 2]
    positive = middle[np.isfinite(middle) & (middle > 0.0)]
    floor = 1e-3 * (float(np.median(positive)) if len(positive) else 1.0)
    return np.maximum(np.where(np.isfinite(middle), middle, 0.0), floor)
