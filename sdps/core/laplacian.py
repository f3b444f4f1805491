"""Linear systems on weighted graphs of pixels, by conjugate gradients with algebraic multigrid (pyamg).

A direct solve takes ever more memory per pixel, plain conjugate gradients ever more steps; this takes time and memory
in proportion to the pixels, for any shape of the mask.

Legend: n unknowns, m edges of the graph.
"""

import numpy as np
import pyamg
from scipy import sparse
from scipy.sparse.linalg import LinearOperator, cg

_COARSEST = 500  # unknowns that are solved directly
_SHIFT = 1e-10  # of the diagonal: a component's mean is free, so the matrix is singular without it
_ALONE = 1e-6  # of the largest diagonal entry: at least so much is taken for a pixel's


def laplacian(edges: np.ndarray, weights: np.ndarray, count: int) -> sparse.csr_matrix:
    """Return the (n, n) matrix of sum w (z_b - z_a)^2 over edges a, b (2, m) with weights (m,) > 0."""
    off = sparse.coo_matrix((-weights, (edges[0], edges[1])), (count, count)).tocsr()
    off = off + off.T
    return (off - sparse.diags_array(np.asarray(off.sum(axis=1)).ravel())).tocsr()


def multigrid(matrix: sparse.csr_matrix) -> LinearOperator:
    """Return one symmetric V-cycle as the approximate inverse of a graph's Laplacian (n, n)."""
    diagonal = matrix.diagonal()
    shift = _SHIFT * np.maximum(diagonal, _ALONE * diagonal.max(initial=1e-300))
    solver = pyamg.ruge_stuben_solver(
        (matrix + sparse.diags_array(shift)).tocsr(),
        max_coarse=_COARSEST,
        max_levels=20,
        coarse_solver="splu",
        presmoother=("gauss_seidel", {"sweep": "forward"}),
        postsmoother=("gauss_seidel", {"sweep": "backward"}),
    )
    return solver.aspreconditioner()


def solve(
    matrix: sparse.csr_matrix, right: np.ndarray, start: np.ndarray, cycle: LinearOperator, *, tolerance: float,
    most: int = 300,
) -> tuple[np.ndarray, int]:  # fmt: skip
    """Solve from `start` (n,) until the residual falls below `tolerance` of the right side (n,).

    Returns:
        (n,) float64 and the number of steps taken.
    """
    steps = 0

    def count(_: np.ndarray) -> None:
        nonlocal steps
        steps += 1

    solution, _ = cg(matrix, right, start, rtol=tolerance, maxiter=most, M=cycle, callback=count)
    return solution, steps
