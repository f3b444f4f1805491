"""Robust principal component analysis: images as a low-rank part plus sparse highlights and shadows.

Candès, Li, Ma & Wright, "Robust principal component analysis?" (JACM 2011), solved by the inexact augmented Lagrangian
method of Lin, Chen & Ma (2010). Wu et al. (ACCV 2010) brought it to photometric stereo; Favaro & Papadhimitri (CVPR
2012) put it before the factorisation of uncalibrated methods.
"""

import logging

import numpy as np

from render.shared.progress import progress_bar

_log = logging.getLogger(__name__)

_BLOCK = 8192
"""Rows handled at a time, so that intermediate results stay in the processor's cache."""


_TOLERANCE = 1e-5
"""Share of |matrix| that |matrix - A - E| may be in the end."""


def robust_low_rank(matrix: np.ndarray, *, limit: int = 200, progress: bool = False) -> np.ndarray:
    """Return the low-rank part A of `matrix` = A + E that minimises |A|_* + gamma |E|_1.

    gamma is k / sqrt(P) with the k of Favaro & Papadhimitri (CVPR 2012): 1.7 from 12 images up, 3 for 5, linear in
    between.

    Args:
        matrix: (P, L), one intensity profile per row; many more rows than columns.
        limit: Most iterations; a warning says when they did not suffice.
        progress: Show a progress bar.

    Returns:
        A, (P, L) float64. The rank is whatever the optimum has; callers truncate it.
    """
    data = np.asarray(matrix, np.float32)
    rows, columns = data.shape
    gamma = float(np.interp(columns, [5, 12], [3.0, 1.7])) / np.sqrt(max(rows, columns))
    norm, spectral = float(np.linalg.norm(data)), float(np.sqrt(np.linalg.eigvalsh(data.T @ data)[-1]))
    if norm == 0.0:
        return data.astype(np.float64)
    dual = data / max(spectral, float(np.abs(data).max()) / gamma)
    penalty, growth, largest = 1.25 / spectral, 1.5, 1e7 * 1.25 / spectral
    low, work = np.zeros_like(data), np.empty_like(data)
    for _ in progress_bar(range(limit), desc="robust low rank", unit="step", disable=not progress):
        gram = _without_sparse(data, low, dual, work, gamma, penalty)
        missed = _update(work, _shrinkage(gram, 1.0 / penalty).astype(np.float32), low, dual, penalty)
        penalty = min(penalty * growth, largest)
        if missed < (_TOLERANCE * norm) ** 2:
            break
    else:
        _log.warning("the robust low-rank split did not settle in %d steps; its result is approximate", limit)
    return low.astype(np.float64)


def _blocks(rows: int) -> list[slice]:
    return [slice(start, start + _BLOCK) for start in range(0, rows, _BLOCK)]


def _without_sparse(
    data: np.ndarray, low: np.ndarray, dual: np.ndarray, work: np.ndarray, gamma: float, penalty: float
) -> np.ndarray:  # (L, L) float64
    """Write into `work` (P, L) what the low-rank part is to be fitted to; return work^T work."""
    gram = np.zeros((data.shape[1], data.shape[1]))
    for part in _blocks(len(data)):
        scaled = dual[part] / penalty
        sparse = data[part] - low[part] + scaled
        sparse -= np.clip(sparse, -gamma / penalty, gamma / penalty)  # soft threshold
        work[part] = data[part] - sparse + scaled
        block = work[part].astype(np.float64)  # squares of small singular values do not survive float32
        gram += block.T @ block
    return gram


def _update(work: np.ndarray, shrink: np.ndarray, low: np.ndarray, dual: np.ndarray, penalty: float) -> float:
    """Renew the low-rank part and the multiplier, both in place; return |data - low - sparse|^2."""
    missed = 0.0
    for part in _blocks(len(work)):
        low[part] = work[part] @ shrink
        # The multiplier's update, dual + penalty (data - low - sparse), in the terms at hand.
        updated = (work[part] - low[part]) * penalty
        missed += float(np.square(updated - dual[part]).sum()) / penalty**2
        dual[part] = updated
    return missed


def _shrinkage(gram: np.ndarray, threshold: float) -> np.ndarray:
    """Return K, (L, L), such that M K is M with all singular values lowered by `threshold`, from M^T M."""
    values, vectors = np.linalg.eigh(gram)
    singular = np.sqrt(np.maximum(values, 0.0))
    gain = np.maximum(singular - threshold, 0.0) / np.maximum(singular, 1e-300)
    return (vectors * gain) @ vectors.T
