"""Conjugate gradients on weighted graphs of pixels, preconditioned by smoothed-aggregation multigrid.

A direct solve takes ever more memory per pixel, plain conjugate gradients ever more steps; this takes time and memory
in proportion to the pixels, whatever the shape of the mask.

Legend: n unknowns of a level, m edges of the graph.
"""

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sparse
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import splu

_BLOCK = 3  # pixels along the side of the blocks that aggregates may not leave
_COARSEST = 1000  # unknowns that are solved directly
_STRONG = 0.1  # of an unknown's strongest edge: weaker ones do not join an aggregate
_SMOOTHINGS = 2  # damped Jacobi sweeps before and after every coarse correction
_ROUNDING = 1e-10  # of the largest diagonal entry: less is none
_SHIFT = 1e-8  # of the diagonal; a component's mean is free, so the matrix is singular, and rounding must stay small


def laplacian(edges: np.ndarray, weights: np.ndarray, count: int) -> sparse.csr_matrix:
    """Return the (n, n) matrix of sum w (z_b - z_a)^2 over edges a, b (2, m) with weights (m,) > 0."""
    off = sparse.coo_matrix((-weights, (edges[0], edges[1])), (count, count)).tocsr()
    off = off + off.T
    return (off - sparse.diags_array(np.asarray(off.sum(axis=1)).ravel())).tocsr()


@dataclass(frozen=True, eq=False)
class _Level:
    matrix: sparse.csr_matrix  # (n, n)
    damped: np.ndarray  # (n,) the inverse diagonal times the damping
    prolong: sparse.csr_matrix  # (n, coarse)


class Multigrid:
    """One symmetric V-cycle as the approximate inverse of a graph's Laplacian."""

    def __init__(self, matrix: sparse.csr_matrix, positions: np.ndarray) -> None:
        """Build the levels.

        Args:
            matrix: (n, n) symmetric, of a weighted graph.
            positions: (n, 2) int, row and column of every unknown.
        """
        self._levels = []
        while matrix.shape[0] > _COARSEST and matrix.nnz > matrix.shape[0]:
            level, positions = _coarsen(matrix, positions)
            if level.prolong.shape[1] > 0.9 * matrix.shape[0]:
                break
            self._levels.append(level)
            matrix = (level.prolong.T @ matrix @ level.prolong).tocsr()
        diagonal = matrix.diagonal()
        shift = _SHIFT * diagonal + (diagonal <= _ROUNDING * diagonal.max(initial=1e-300))
        self._coarsest = splu((matrix + sparse.diags_array(shift)).tocsc(), permc_spec="MMD_AT_PLUS_A",
                              diag_pivot_thresh=0.0, options={"SymmetricMode": True})  # fmt: skip

    def __call__(self, right: np.ndarray, depth: int = 0) -> np.ndarray:
        """Apply one V-cycle to (n,) float64."""
        if depth == len(self._levels):
            return self._coarsest.solve(right)
        level = self._levels[depth]
        solution = level.damped * right
        for _ in range(_SMOOTHINGS - 1):
            solution += level.damped * (right - level.matrix @ solution)
        coarse = level.prolong.T @ (right - level.matrix @ solution)
        solution += level.prolong @ self(coarse, depth + 1)
        for _ in range(_SMOOTHINGS):
            solution += level.damped * (right - level.matrix @ solution)
        return solution


def _coarsen(matrix: sparse.csr_matrix, positions: np.ndarray) -> tuple[_Level, np.ndarray]:
    """Join the unknowns of a block that strong edges connect; return the level and the blocks of the new unknowns."""
    count = matrix.shape[0]
    diagonal = matrix.diagonal()
    # A component that has become one unknown has rounding errors for a diagonal, and nothing left to correct.
    tied = diagonal > _ROUNDING * diagonal.max(initial=1e-300)
    inverse = np.where(tied, 1.0 / np.where(tied, diagonal, 1.0), 0.0)
    blocks = positions // _BLOCK
    pairs = matrix.tocoo()
    rows, columns, values = pairs.row, pairs.col, -pairs.data
    strongest = np.zeros(count)
    np.maximum.at(strongest, rows[rows != columns], values[rows != columns])
    joined = (rows != columns) & (values >= _STRONG * np.minimum(strongest[rows], strongest[columns]))
    joined &= (blocks[rows] == blocks[columns]).all(axis=1)
    graph = sparse.coo_matrix((np.ones(joined.sum(), np.int8), (rows[joined], columns[joined])), (count, count))
    number, labels = connected_components(graph, directed=False)
    injection = sparse.csr_matrix((np.ones(count), labels, np.arange(count + 1)), (count, number))
    # Gershgorin bounds the spectrum of D^-1 A of a graph by 2.
    smoothing = sparse.diags_array(inverse * (2.0 / 3.0))
    prolong = (injection - smoothing @ (matrix @ injection)).tocsr()
    coarse = np.zeros((number, 2), positions.dtype)
    coarse[labels] = blocks
    return _Level(matrix, inverse * (2.0 / 3.0), prolong), coarse


def solve(
    matrix: sparse.csr_matrix, right: np.ndarray, start: np.ndarray, precondition: Multigrid, *, tolerance: float,
    most: int = 300,
) -> tuple[np.ndarray, int]:  # fmt: skip
    """Solve by conjugate gradients from `start` (n,) until the preconditioned residual falls by `tolerance`.

    Returns:
        (n,) float64 and the number of steps taken.
    """
    solution = start.copy()
    residual = right - matrix @ solution
    scale = right @ precondition(right)
    direction, before = np.zeros_like(solution), 1.0
    for step in range(most):
        searched = precondition(residual)
        now = residual @ searched
        if now <= tolerance**2 * scale:
            return solution, step
        direction = searched + (now / before if step else 0.0) * direction
        product = matrix @ direction
        length = now / (direction @ product)
        solution += length * direction
        residual -= length * product
        before = now
    return solution, most
