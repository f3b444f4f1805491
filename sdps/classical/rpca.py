"""Robust principal component analysis: images as a low-rank part plus sparse highlights and shadows.

Candès, Li, Ma & Wright, "Robust principal component analysis?" (JACM 2011), solved by the inexact augmented Lagrangian
method of Lin, Chen & Ma (2010). Wu et al. (ACCV 2010) brought it to photometric stereo; Favaro & Papadhimitri (CVPR
2012) put it before the factorisation of uncalibrated methods.
"""

import logging

import numpy as np

from render.progress import progress_bar

_log = logging.getLogger(__name__)


def robust_low_rank(
    matrix: np.ndarray,
    *,
    sparsity: float | None = None,
    tolerance: float = 1e-5,
    limit: int = 200,
    progress: bool = False,
) -> np.ndarray:
    """Return the low-rank part A of `matrix` = A + E that minimises |A|_* + gamma |E|_1.

    Args:
        matrix: (P, L), one intensity profile per row; many more rows than columns.
        sparsity: k in gamma = k / sqrt(P). None for the value of Favaro & Papadhimitri (CVPR 2012): 1.7 from 12 images
            up, 3 for 5, linear in between.
        tolerance: Stop when |matrix - A - E| is this share of |matrix|.
        limit: Most iterations; a warning says when they did not suffice.
        progress: Show a progress bar.

    Returns:
        A, (P, L) float64. The rank is whatever the optimum has; callers truncate it.
    """
    data = np.asarray(matrix, np.float32)
    rows, columns = data.shape
    k = float(np.interp(columns, [5, 12], [3.0, 1.7])) if sparsity is None else sparsity
    gamma = k / np.sqrt(max(rows, columns))
    norm, spectral = float(np.linalg.norm(data)), float(np.sqrt(np.linalg.eigvalsh(data.T @ data)[-1]))
    if norm == 0.0:
        return data.astype(np.float64)
    dual = data / max(spectral, float(np.abs(data).max()) / gamma)
    penalty, growth = 1.25 / spectral, 1.5
    low, sparse = np.zeros_like(data), np.zeros_like(data)
    for _ in progress_bar(range(limit), desc="robust low rank", unit="step", disable=not progress):
        work = data - low + dual / penalty
        sparse = np.sign(work) * np.maximum(np.abs(work) - gamma / penalty, 0.0)
        low = _shrink_singular_values(data - sparse + dual / penalty, 1.0 / penalty)
        residual = data - low - sparse
        dual += penalty * residual
        penalty = min(penalty * growth, 1e7 * 1.25 / spectral)
        if float(np.linalg.norm(residual)) < tolerance * norm:
            break
    else:
        _log.warning("the robust low-rank split did not settle in %d steps; its result is approximate", limit)
    return low.astype(np.float64)


def _shrink_singular_values(matrix: np.ndarray, threshold: float) -> np.ndarray:
    """Lower all singular values by `threshold`, by way of the small Gram matrix: rows outnumber columns by far."""
    values, vectors = np.linalg.eigh((matrix.T @ matrix).astype(np.float64))
    singular = np.sqrt(np.maximum(values, 0.0))
    keep = singular > threshold
    if not keep.any():
        return np.zeros_like(matrix)
    basis = vectors[:, keep]
    gain = (1.0 - threshold / singular[keep])[:, None] * basis.T  # V diag(1 - t/s) V^T
    return matrix @ (basis @ gain).astype(matrix.dtype)
