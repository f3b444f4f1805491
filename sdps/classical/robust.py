"""Calibrated least squares that withstands highlights and shadows: middle of the ranks, L1 norm, low rank.

The variants of `least_squares` used as rivals in the literature. All take known lights and return vectors of Lambert's
law; they differ in which observations they believe.
"""

import logging
from dataclasses import replace
from functools import partial

import numpy as np

from render.shared.errors import InputError
from sdps.classical.common.near_lamps import NearLamps
from sdps.classical.common.rpca import robust_low_rank
from sdps.classical.common.weighted import solve_weighted
from sdps.classical.least_squares import Calibrated, Solver, calibrate
from sdps.core.estimate import NO_NOTES, Estimate, Notes

_log = logging.getLogger(__name__)


def position_threshold(
    images: np.ndarray,
    mask: np.ndarray,
    light_directions: np.ndarray,
    intensities: np.ndarray | None = None,
    *,
    near: NearLamps | None = None,
    drop_lowest: float = 0.2,
    drop_highest: float = 0.2,
) -> Estimate:
    """Solve Lambert's law with the middle of every pixel's sorted intensities.

    The lowest are taken for shadows, the highest for highlights; the position thresholding that Shi et al. (PAMI 2019,
    the DiLiGenT benchmark) apply before least squares. Intensities are divided by the lights' before sorting.

    Args:
        images, mask, light_directions, intensities, near: As for `least_squares`.
        drop_lowest: Share of the observations dropped at the dark end, rounded down.
        drop_highest: The same at the bright end.

    Returns:
        As `least_squares`; notes `kept`, and `unresolved`, pixels whose kept lights are coplanar, where all
        observations are used.

    Raises:
        InputError: shares that leave fewer than three observations, or degenerate input as in `least_squares`.
    """
    known = calibrate(images, mask, light_directions, intensities, near=near)
    count = len(known.directions)
    if not (drop_lowest >= 0.0 and drop_highest >= 0.0 and drop_lowest + drop_highest < 1.0):
        raise InputError(f"shares to drop must be at least 0 and sum to less than 1: {drop_lowest}, {drop_highest}")
    first, last = int(drop_lowest * count), count - int(drop_highest * count)
    if last - first < 3:
        raise InputError(f"of {count} images only {last - first} would be kept, three are needed; lower the shares")

    def solve(directions: np.ndarray, profiles: np.ndarray, start: np.ndarray) -> np.ndarray:
        # Positions instead of two limits: equal intensities, such as the zeros of shadows, count one by one.
        order = np.argsort(profiles, axis=1, kind="stable")[:, first:last]
        weights = np.zeros(profiles.shape)
        np.put_along_axis(weights, order, 1.0, axis=1)
        return solve_weighted(directions, profiles, weights, start)

    return _conclude(known, solve, Notes(kept=last - first))


def robust_least_squares(
    images: np.ndarray,
    mask: np.ndarray,
    light_directions: np.ndarray,
    intensities: np.ndarray | None = None,
    *,
    near: NearLamps | None = None,
    iterations: int = 30,
    floor: float = 1e-3,
) -> Estimate:
    """Solve Lambert's law in the L1 norm, argmin_b sum_k |i_k - b . l_k|, by iteratively reweighted least squares.

    Observations far from Lambert's law, highlights and shadows alike, lose weight in proportion; fewer than half of a
    pixel's may be so. The norm is convex, so the answer does not depend on where the iteration starts.

    Args:
        images, mask, light_directions, intensities, near: As for `least_squares`.
        iterations: Most reweighting steps; pixels that have settled leave earlier.
        floor: Residual, as a share of the pixel's brightest intensity, below which the weight grows no more.

    Returns:
        As `least_squares`; note `unresolved`, pixels whose lit observations are coplanar, where plain least squares is
        used.

    Raises:
        InputError: parameters out of range, or degenerate input as in `least_squares`.
    """
    if not (iterations >= 1 and floor > 0.0):
        raise InputError(f"robust least squares needs iterations >= 1 and floor > 0, got {iterations} and {floor}")
    known = calibrate(images, mask, light_directions, intensities, near=near)
    return _conclude(known, partial(_least_absolute, iterations=iterations, floor=floor))


def _least_absolute(
    directions: np.ndarray, profiles: np.ndarray, start: np.ndarray, iterations: int, floor: float
) -> np.ndarray:  # (P, 3)
    """Reweight until the vectors change by less than a hundredth of a degree."""
    peak = profiles.max(1, keepdims=True)
    result = solve_weighted(directions, profiles, np.ones(profiles.shape), start)
    active = np.flatnonzero(np.isfinite(result[:, 0]) & (peak[:, 0] > 0.0))
    for _ in range(iterations):
        if not len(active):
            break
        old, values = result[active], profiles[active]
        own = directions[active] if directions.ndim == 3 else directions
        residual = np.abs(values - _predict(own, old))
        weights = 1.0 / np.maximum(residual / peak[active], floor)
        new = solve_weighted(own, values, weights, old)
        result[active] = new
        change = np.linalg.norm(new - old, axis=1)
        active = active[change > 1.7e-4 * np.linalg.norm(new, axis=1)]
    return result


def _predict(directions: np.ndarray, vectors: np.ndarray) -> np.ndarray:  # (P, L)
    """Return the profiles that vectors (P, 3) give under directions (L, 3) or (P, L, 3)."""
    return vectors @ directions.T if directions.ndim == 2 else (directions @ vectors[..., None])[..., 0]


def low_rank_least_squares(
    images: np.ndarray,
    mask: np.ndarray,
    light_directions: np.ndarray,
    intensities: np.ndarray | None = None,
    *,
    near: NearLamps | None = None,
) -> Estimate:
    """Split highlights and shadows off as a sparse part, then solve Lambert's law with the low-rank rest.

    Wu et al. (ACCV 2010), with shadows as part of the sparse errors instead of missing data.

    Args:
        images, mask, light_directions, intensities, near: As for `least_squares`.

    Returns:
        As `least_squares`.

    Raises:
        InputError: degenerate input, as in `least_squares`.
    """
    known = calibrate(images, mask, light_directions, intensities, near=near)
    low = robust_low_rank(known.profiles)
    spectrum = np.sqrt(np.maximum(np.linalg.eigvalsh(low.T @ low), 0.0))
    rank = int((spectrum > 1e-3 * spectrum[-1]).sum())
    if rank < 3:
        _log.warning("the low-rank part has rank %d of 3: it lost shading with the highlights", rank)
    return known.conclude(known.solve_plain(low))


def _conclude(known: Calibrated, solve: Solver, notes: Notes = NO_NOTES) -> Estimate:
    """Solve from NaN on; use plain least squares where it stays, and say so when that is much of the object."""
    vectors = known.in_chunks(solve, np.full((len(known.profiles), 3), np.nan))
    missing = np.isnan(vectors[:, 0])
    if missing.any():
        vectors[missing] = known.solve_plain(known.profiles[missing], np.flatnonzero(missing))
    share = float(missing.mean())
    if share > 0.05:
        _log.warning(
            "at %.0f %% of the pixels the kept lights are coplanar; all observations are used there", 100 * share
        )
    return known.conclude(vectors, replace(notes, unresolved=share))
