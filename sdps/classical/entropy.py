"""The bas-relief ambiguity by minimum entropy of the albedo (Alldrin, Mallick & Kriegman, CVPR 2007; "AM07").

An object of few albedos has a peaked albedo histogram; a wrong bas-relief transformation scales the albedo of every
normal differently and smears it.
"""

import logging

import numpy as np
from scipy import ndimage

from render.shared.errors import InputError
from render.shared.seeds import generator
from sdps.classical.common.factorisation import Factors
from sdps.classical.common.front_end import Front, conclude, prepare
from sdps.classical.common.gbr import Gbr
from sdps.core.estimate import Estimate, Notes

_log = logging.getLogger(__name__)

_BOX = 4.0
"""mu and nu are sought in [-4, 4], lambda in [1/4, 4], from the standard form on (Alldrin et al., sec. 4)."""

_BINS, _RANGE = 256, 4.0
"""Bins of the histogram, and albedo over its mean at its upper end; what is above falls into the last bin."""

_COARSEST, _MIDDLE, _FINEST = 0.5, 0.1, 0.01
"""Steps of mu, nu and log lambda: of the first grid, where few descents go on with all samples, and of the end."""

_COARSE_SAMPLES = 4000
"""Pixels in the smooth histograms down to the middle step."""

_FINALISTS = 3

_BATCH_VALUES = 200_000  # fits a core's cache


def entropy(
    images: np.ndarray,
    mask: np.ndarray,
    *,
    front: Front = "low-rank",
    starts: int = 8,
    samples: int = 20000,
    seed: int = 0,
) -> Estimate:
    """Choose, of all bas-relief transformations, the one with the lowest entropy of the albedo histogram.

    Published: the criterion, histogram of |B G|, and the coarse-to-fine search over mu, nu in [-4, 4] and lambda in
    [1/4, 4]. Ours, since the entropy has many local minima and depends on scale and binning: the factors come to a
    standard form first (`standard_form`), so that the box and the answer do not depend on the factorisation; the
    albedo is divided by its mean; the histogram is smoothed, widely at coarse steps; lambda is sought in even steps of
    its logarithm; and the search descends from the `starts` best cells of the coarse grid instead of one.

    Args:
        images, mask, front: As for `prepare`.
        starts: Cells of the coarse grid from which the search descends.
        samples: Most pixels in the histogram, drawn at random.
        seed: Root seed of that draw.

    Returns:
        Normals, lights and intensities; notes `energy`, the entropy in bits at the answer, and `minima`, the best
        descents. Minima of nearly equal entropy that lie apart mean that the answer is not to be trusted.

    Raises:
        InputError: parameters out of range, or degenerate input; see `prepare`.
    """
    if starts < 1 or samples < 100:
        raise InputError(f"want at least 1 start and 100 samples, got {starts} and {samples}")
    prepared = prepare(images, mask, front=front)
    standard = standard_form(prepared.factors)
    surface = prepared.factors.transform(standard).surface
    surface = generator(seed, "entropy").permutation(surface)[:samples]
    minima = _search(surface, starts)
    best = Gbr(*minima[0, 1:])
    if max(abs(best.mu), abs(best.nu)) > 0.99 * _BOX or abs(np.log(best.lam)) > 0.99 * np.log(_BOX):
        _log.warning("the lowest entropy lies on the edge of the search (%s); expect large errors", best)
    return conclude(prepared, standard.then(best), Notes(energy=float(minima[0, 0]), minima=minima))


def standard_form(factors: Factors) -> Gbr:
    """Return the transformation to a member of the family that does not depend on where one starts.

    Under it the first two columns of B are uncorrelated with the third, and the third holds half of the energy, as it
    does for a whole sphere of one albedo.

    Args:
        factors: Factors up to a bas-relief transformation.
    """
    first, second, third = factors.surface.T
    energy = max(float(third @ third), 1e-300)
    mu, nu = -float(first @ third) / energy, -float(second @ third) / energy
    flat = ((first + mu * third) ** 2 + (second + nu * third) ** 2).sum()
    return Gbr(mu, nu, float(np.sqrt(max(flat, 1e-12 * energy) / energy)))


class _Cost:
    """Entropy of the albedo histogram, for many transformations at once."""

    def __init__(self, surface: np.ndarray) -> None:
        first, second, third = surface.T
        # |B G|^2 is linear in the six products of columns, so that one matrix product serves a whole batch.
        products = (first**2 + second**2, 2.0 * first * third, 2.0 * second * third, third**2)
        self._products = np.stack(products).astype(np.float32)  # (4, P)

    def __call__(self, parameters: np.ndarray, step: float) -> np.ndarray:
        """Return entropies in bits, (N,), at rows (mu, nu, log lambda), smoothed as befits a grid of `step`."""
        batch = max(_BATCH_VALUES // self._products.shape[1], 1)
        parts = [parameters[begin : begin + batch] for begin in range(0, len(parameters), batch)]
        return np.concatenate([self._entropies(part, step) for part in parts])

    def _entropies(self, parameters: np.ndarray, step: float) -> np.ndarray:
        mu, nu, depth = parameters.T
        weights = np.stack([np.ones_like(mu), mu, nu, mu**2 + nu**2 + np.exp(2.0 * depth)], axis=1)
        albedo = np.sqrt(np.maximum(weights.astype(np.float32) @ self._products, 0.0))  # (N, P)
        albedo *= _BINS / (_RANGE * albedo.mean(1, keepdims=True))
        cell = np.minimum(albedo.astype(np.int64), _BINS - 1)
        cell += np.arange(len(mu))[:, None] * _BINS
        counts = np.bincount(cell.ravel(), minlength=len(mu) * _BINS).reshape(len(mu), _BINS)
        # A step of the grid moves albedos by about that share of their mean; peaks narrower than that are missed.
        width = max(0.25 * step * _BINS / _RANGE, 0.7)
        shares = ndimage.gaussian_filter1d(counts / albedo.shape[1], width, axis=1, mode="nearest")
        return -(shares * np.log2(np.maximum(shares, 1e-12))).sum(1)


def _search(surface: np.ndarray, starts: int) -> np.ndarray:  # (N, 4)
    """Return rows (entropy, mu, nu, lambda) of the minima found, best first."""
    coarse, fine = _Cost(surface[:_COARSE_SAMPLES]), _Cost(surface)
    limit = np.array([_BOX, _BOX, np.log(_BOX)])
    found = np.stack([_descend(coarse, centre, limit, _COARSEST, _MIDDLE) for centre in _cells(coarse, starts, limit)])
    found = found[np.argsort(coarse(found, _MIDDLE), kind="stable")][:_FINALISTS]
    found = np.stack([_descend(fine, centre, limit, _MIDDLE, _FINEST) for centre in found])
    values = fine(found, _FINEST)
    rows = np.column_stack([values, found[:, :2], np.exp(found[:, 2])])
    return rows[np.argsort(values, kind="stable")]


def _cells(cost: _Cost, count: int, limit: np.ndarray) -> np.ndarray:  # (N, 3)
    """Return the best cells of the coarse grid, no two of them neighbours in one valley."""
    sides = [np.linspace(-bound, bound, size) for bound, size in zip(limit, (17, 17, 9), strict=True)]
    grid = np.stack(np.meshgrid(*sides, indexing="ij"), axis=-1).reshape(-1, 3)
    chosen: list[np.ndarray] = []
    for cell in grid[np.argsort(cost(grid, _COARSEST), kind="stable")]:
        if all(np.abs(cell - other).max() > 1.01 * _COARSEST for other in chosen):
            chosen.append(cell)
        if len(chosen) == count:
            break
    return np.stack(chosen)


def _descend(cost: _Cost, centre: np.ndarray, limit: np.ndarray, step: float, finest: float) -> np.ndarray:  # (3,)
    """Refine by grids of 5 x 5 x 5 within 1.5 steps, each two thirds as wide as the last."""
    offsets = np.linspace(-1.5, 1.5, 5)
    cube = np.stack(np.meshgrid(offsets, offsets, offsets, indexing="ij"), axis=-1).reshape(-1, 3)
    while step > finest:
        candidates = np.clip(centre + step * cube, -limit, limit)
        step /= 1.5
        centre = candidates[int(np.argmin(cost(candidates, step)))]
    return centre
