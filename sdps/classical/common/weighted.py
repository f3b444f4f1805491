"""Weighted least squares, pixel by pixel, as batches of 3x3 systems."""

import numpy as np

from sdps.classical.common.outlines import MIN_CONDITION


def normal_equations(
    basis: np.ndarray, values: np.ndarray, weights: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:  # (P, 3, 3), (P, 3)
    """Return A and a of the systems A x = a whose solutions are argmin_x sum_k w_k (v_k - x . b_k)^2, row by row.

    A batch of 3x3 systems instead of a loop over ragged ones; float64, but summed in the precision of the arguments.

    Args:
        basis: (L, 3), the b_k, the same for all rows; or (P, L, 3), those of each row.
        values: (P, L).
        weights: (P, L), not negative; floating point.
    """
    if basis.ndim == 3:
        weighted = np.swapaxes(basis * weights[..., None], 1, 2)  # (P, 3, L)
        return weighted @ basis, (weighted @ values[..., None])[..., 0].astype(np.float64)
    first, second = np.triu_indices(3)  # A is symmetric
    moments = weights @ (basis[:, first] * basis[:, second])  # (P, 6)
    matrices = np.empty((len(values), 3, 3))
    matrices[:, first, second] = matrices[:, second, first] = moments
    return matrices, ((weights * values) @ basis).astype(np.float64)


def solve_weighted(
    directions: np.ndarray, profiles: np.ndarray, weights: np.ndarray, fallback: np.ndarray
) -> np.ndarray:  # (P, 3)
    """Return argmin_b sum_k w_k (i_k - b . l_k)^2 for every pixel, from its normal equations.

    Args:
        directions: (L, 3), or (P, L, 3) of near lamps.
        profiles: (P, L).
        weights: (P, L), not negative.
        fallback: (P, 3), for pixels where fewer than three observations, or coplanar ones, have weight.
    """
    weights = weights.astype(np.float64)
    matrices, targets = normal_equations(directions, profiles, weights)
    eigenvalues = np.linalg.eigvalsh(matrices)
    solvable = ((weights > 0.0).sum(1) >= 3) & (eigenvalues[:, 0] > MIN_CONDITION**2 * eigenvalues[:, 2])
    result = fallback.copy()
    result[solvable] = np.linalg.solve(matrices[solvable], targets[solvable][..., None])[..., 0]
    return result
