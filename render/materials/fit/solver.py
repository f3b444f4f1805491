"""Gauss-Newton (Levenberg-Marquardt) fit of the tabulated model to samples of one BRDF channel.

Unknowns are logarithms, p = [log T (32 x 6), log S (9), A (7 x 4)], so tables stay positive and the penalties on first
and second differences mean relative smoothness; the penalties also carry values into cells without samples.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.sparse as sp

from render.materials import model

_T = model.HALF_KNOTS * model.DIFFERENCE_KNOTS
_S = model.SHADOWING_KNOTS


@dataclass(frozen=True)
class Basis:
    """Interpolation weights of N pairs of directions, shared by every material fitted to the same pairs.

    Attributes:
        table: (N, 192) sparse bilinear weights in T.
        shadow_i: (N, 9) sparse linear weights in S at the light.
        shadow_o: (N, 9) the same at the camera.
        azimuth: (N,) cos^2(phi_d).
    """

    table: sp.csr_array
    shadow_i: sp.csr_array
    shadow_o: sp.csr_array
    azimuth: np.ndarray


def basis(wi: np.ndarray, wo: np.ndarray) -> Basis:
    """Build the interpolation weights of (N, 3) unit vectors `wi`, `wo`."""
    x, y, azimuth = model.coordinates(wi, wo)
    row, a = model.cell(x, model.HALF_KNOTS)
    column, b = model.cell(y, model.DIFFERENCE_KNOTS)
    corner = row * model.DIFFERENCE_KNOTS + column
    step = model.DIFFERENCE_KNOTS
    columns = np.stack([corner, corner + 1, corner + step, corner + step + 1], 1)
    values = np.stack([(1 - a) * (1 - b), (1 - a) * b, a * (1 - b), a * b], 1)
    return Basis(_rows(columns, values, _T), _shadow(wi[:, 2]), _shadow(wo[:, 2]), azimuth)


def _rows(columns: np.ndarray, values: np.ndarray, width: int) -> sp.csr_array:
    """Return the (N, width) sparse matrix with `values` (N, K) at `columns` (N, K)."""
    start = np.arange(len(columns) + 1) * columns.shape[1]
    return sp.csr_array((values.ravel(), columns.ravel(), start), shape=(len(columns), width))


def _shadow(cosine: np.ndarray) -> sp.csr_array:
    index, c = model.cell(np.clip(1 - cosine, 0, 1), _S)
    return _rows(np.stack([index, index + 1], 1), np.stack([1 - c, c], 1), _S)


def _difference(count: int, order: int) -> sp.csr_array:
    """Return the (count - order, count) matrix of first or second differences."""
    stencil = {1: [-1.0, 1.0], 2: [1.0, -2.0, 1.0]}[order]
    return sp.diags_array(stencil, offsets=list(range(order + 1)), shape=(count - order, count), dtype=float).tocsr()


def penalty() -> np.ndarray:
    """Return the (229, 229) matrix Q of the smoothness penalty p^T Q p, relative to a squared relative error of 1."""
    half, difference = sp.eye_array(model.HALF_KNOTS), sp.eye_array(model.DIFFERENCE_KNOTS)
    table = [
        (1e-5, sp.kron(_difference(model.HALF_KNOTS, 2), difference)),
        (1e-6, sp.kron(half, _difference(model.DIFFERENCE_KNOTS, 2))),
        (1e-7, sp.kron(half, _difference(model.DIFFERENCE_KNOTS, 1))),
    ]
    shadow = [(1e-5, _difference(_S, 2)), (1e-5, _difference(_S, 1))]
    azimuth = [(1e-5, sp.eye_array(int(np.prod(model.AZIMUTH_KNOTS - np.array(1)))))]
    blocks: list[Any] = [sum(weight * (rows.T @ rows) for weight, rows in part) for part in (table, shadow, azimuth)]
    return sp.block_diag(blocks).toarray()


class Channel:
    """Least squares for one channel: minimise sum(weight (f - target)^2) / sum(weight target^2) + p^T Q p."""

    def __init__(self, weights: Basis, target: np.ndarray, weight: np.ndarray, floor: float) -> None:
        """Take the interpolation weights, (N,) target BRDF, (N,) weights, and the least value T may start from."""
        self._basis, self._target = weights, target
        self._weight = weight / np.maximum((weight * target**2).sum(), 1e-30)
        self._spread = model.azimuth_basis().reshape(_T, -1)  # (192, 28)
        self._penalty, self._floor = penalty(), floor

    def start(self) -> np.ndarray:
        """Return the first guess: the mean of the samples about each knot, S = 1, A = 0."""
        count = self._basis.table.T @ np.ones(len(self._target))
        mean = (self._basis.table.T @ self._target) / np.maximum(count, 1e-9)
        seen = count > 3
        mean[~seen] = np.median(mean[seen]) if seen.any() else self._floor
        return np.concatenate([np.log(np.maximum(mean, self._floor)), np.zeros(_S + self._spread.shape[1])])

    def _terms(self, p: np.ndarray) -> tuple[np.ndarray, ...]:
        """Return T at e = 0 and 1 (192,), S (9,), and per sample S_i, S_o and the table value."""
        zero, shadow = np.exp(p[:_T]), np.exp(p[_T : _T + _S])
        one = zero * np.exp(self._spread @ p[_T + _S :])
        e = self._basis.azimuth
        value = (1 - e) * (self._basis.table @ zero) + e * (self._basis.table @ one)
        return zero, one, shadow, self._basis.shadow_i @ shadow, self._basis.shadow_o @ shadow, value

    def cost(self, p: np.ndarray) -> float:
        """Return the objective at `p` (229,)."""
        *_, shadow_i, shadow_o, value = self._terms(p)
        return float((self._weight * (shadow_i * shadow_o * value - self._target) ** 2).sum() + p @ self._penalty @ p)

    def normal_equations(self, p: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the Gauss-Newton matrix (229, 229) and half the gradient (229,) at `p`."""
        zero, one, shadow, shadow_i, shadow_o, value = self._terms(p)
        e, factor = self._basis.azimuth, shadow_i * shadow_o
        part_one = _scale(self._basis.table, factor * e, one)
        d_table = _scale(self._basis.table, factor * (1 - e), zero) + part_one
        d_shadow = _scale(self._basis.shadow_i, value * shadow_o, shadow)
        d_shadow = d_shadow + _scale(self._basis.shadow_o, value * shadow_i, shadow)
        jacobian = sp.hstack([d_table, d_shadow]).tocsr()
        weighted = sp.diags_array(self._weight) @ jacobian
        # The azimuth's Jacobian is part_one times a small dense matrix, so only products of the sparse part are formed.
        weighted_one = sp.diags_array(self._weight) @ part_one
        cross = (jacobian.T @ weighted_one).toarray() @ self._spread
        corner = self._spread.T @ ((part_one.T @ weighted_one).toarray() @ self._spread)
        matrix = np.block([[(jacobian.T @ weighted).toarray(), cross], [cross.T, corner]]) + self._penalty
        residual = self._weight * (factor * value - self._target)
        gradient = np.concatenate([jacobian.T @ residual, self._spread.T @ (part_one.T @ residual)])
        return matrix, gradient + self._penalty @ p

    def solve(self, iterations: int = 40) -> np.ndarray:
        """Return the fitted parameters (229,)."""
        p, damping = self.start(), 1e-3
        cost = self.cost(p)
        for _ in range(iterations):
            matrix, gradient = self.normal_equations(p)
            trial = self._step(p, matrix, gradient, damping)
            while (trial_cost := self.cost(trial)) >= cost and damping < 1e3:
                damping *= 6
                trial = self._step(p, matrix, gradient, damping)
            if trial_cost >= cost:
                break
            converged = cost - trial_cost < 1e-4 * cost
            p, cost, damping = trial, trial_cost, max(damping / 4, 1e-9)
            if converged:
                break
        return p

    def _step(self, p: np.ndarray, matrix: np.ndarray, gradient: np.ndarray, damping: float) -> np.ndarray:
        diagonal = np.diag(matrix) + 1e-9
        trial = p - np.clip(np.linalg.solve(matrix + damping * np.diag(diagonal), gradient), -2, 2)
        trial[:_T] = np.maximum(trial[:_T], np.log(self._floor) - 7)
        trial[_T:] = np.clip(trial[_T:], -4, 4)
        return trial


def _scale(matrix: sp.csr_array, rows: np.ndarray, columns: np.ndarray) -> sp.csr_array:
    """Return diag(rows) @ matrix @ diag(columns), keeping the sparsity."""
    counts = np.diff(matrix.indptr)
    return sp.csr_array(
        (matrix.data * np.repeat(rows, counts) * columns[matrix.indices], matrix.indices, matrix.indptr), matrix.shape
    )


def tables(p: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Split parameters into T (32, 6), S (9,) with S(normal) = 1, and A (7, 4)."""
    shadow = np.exp(p[_T : _T + _S])
    bivariate = np.exp(p[:_T]).reshape(model.HALF_KNOTS, model.DIFFERENCE_KNOTS) * shadow[0] ** 2
    return bivariate, shadow / shadow[0], p[_T + _S :].reshape(np.array(model.AZIMUTH_KNOTS) - 1)
