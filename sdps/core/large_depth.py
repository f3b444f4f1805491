"""Depth of large objects on the grid of pixels itself, in a tenth of the memory that a general sparse matrix takes.

The equations are those of `sdps.core.integration`; there they are a graph's, here every pixel (row, column) of the
object's box has an edge to its right and one to the pixel below, and what is known of them lies in pictures. They are
solved by conjugate gradients, with a V-cycle over grids of half the sides: what coarser grids know of an edge is the
sum over the finer edges it stands for. Below `_COARSE` pixels `sdps.core.laplacian` takes over.

Legend: (h, w) the sides of the box; across (h, w) belongs to the edge to the right, down (h, w) to that to the row
below, 0 where there is none.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import numba
import numpy as np
from scipy import ndimage

from sdps.core.laplacian import laplacian, multigrid

_COARSE = 2**17
_HALF = np.float32(0.5)
"""Piecewise constant corrections overshoot: coarse edges sum two finer ones, but are twice as long."""
_FEWEST = 1e-30


class Slopes(NamedTuple):
    """Unit normals of the object's box, 0 outside the mask, float32 (h, w) each; `facing` is held above the least."""

    x: np.ndarray
    y: np.ndarray
    facing: np.ndarray


class Edges(NamedTuple):
    """Weights, and weights times the steps they ask for: of z at the right less left, and at the upper less lower."""

    across: np.ndarray
    down: np.ndarray
    flow_across: np.ndarray
    flow_down: np.ndarray


@numba.njit(parallel=True, cache=True)
def smooth_edges(slopes: Slopes, mask: np.ndarray, edges: Edges) -> None:
    """Fill in the edges where the mean normal of two pixels is perpendicular to the chord between them."""
    nx, ny, nz = slopes
    # Unpacked first: in a parallel loop numba drops what is written to arrays of a tuple.
    across, down, flow_across, flow_down = edges
    height, width = mask.shape
    for r in numba.prange(height):
        for c in range(width):
            facing = nz[r, c]
            if mask[r, c] and c + 1 < width and mask[r, c + 1]:
                mean = (facing + nz[r, c + 1]) / 2
                across[r, c] = mean * mean
                flow_across[r, c] = -mean * (nx[r, c] + nx[r, c + 1]) / 2
            if mask[r, c] and r + 1 < height and mask[r + 1, c]:
                mean = (facing + nz[r + 1, c]) / 2
                down[r, c] = mean * mean
                flow_down[r, c] = -mean * (ny[r, c] + ny[r + 1, c]) / 2


@numba.njit(inline="always")
def _share(sharpness: Any, facing: Any, other: Any, this: Any) -> Any:
    """Return the weight of a one-sided equation from the steps across this edge and the one on the other side."""
    difference = sharpness * facing * facing * (other * other - this * this)
    return 1.0 / (1.0 + np.exp(min(max(-difference, -60.0), 60.0)))


@numba.njit(parallel=True, cache=True)
def bilateral_edges(
    slopes: Slopes, mask: np.ndarray, z: np.ndarray, sharpness: float, weakest: float, edges: Edges, energy: np.ndarray
) -> None:
    """Fill in the edges by the bilateral weights at depth z (h, w); `energy` (h,) is that of each row."""
    nx, ny, nz = slopes
    across, down, flow_across, flow_down = edges
    height, width = mask.shape
    for r in numba.prange(height):
        total = 0.0
        for c in range(width):
            if mask[r, c] and c + 1 < width and mask[r, c + 1]:
                step = z[r, c + 1] - z[r, c]
                first = second = 0.5
                near, far = nz[r, c], nz[r, c + 1]
                if c > 0 and mask[r, c - 1]:
                    first = _share(sharpness, near, z[r, c] - z[r, c - 1], step)
                if c + 2 < width and mask[r, c + 2]:
                    second = _share(sharpness, far, z[r, c + 2] - z[r, c + 1], step)
                pull = first * near * nx[r, c] + second * far * nx[r, c + 1]
                across[r, c] = first * near * near + second * far * far + weakest
                flow_across[r, c] = weakest * step - pull
                gaps = near * step + nx[r, c], far * step + nx[r, c + 1]
                total += first * gaps[0] * gaps[0] + second * gaps[1] * gaps[1]
            if mask[r, c] and r + 1 < height and mask[r + 1, c]:
                step = z[r, c] - z[r + 1, c]
                first = second = 0.5
                near, far = nz[r + 1, c], nz[r, c]
                if r + 2 < height and mask[r + 2, c]:
                    first = _share(sharpness, near, z[r + 1, c] - z[r + 2, c], step)
                if r > 0 and mask[r - 1, c]:
                    second = _share(sharpness, far, z[r - 1, c] - z[r, c], step)
                pull = first * near * ny[r + 1, c] + second * far * ny[r, c]
                down[r, c] = first * near * near + second * far * far + weakest
                flow_down[r, c] = weakest * step - pull
                gaps = near * step + ny[r + 1, c], far * step + ny[r, c]
                total += first * gaps[0] * gaps[0] + second * gaps[1] * gaps[1]
        energy[r] = total


@numba.njit(parallel=True, cache=True)
def measure(
    slopes: Slopes, mask: np.ndarray, z: np.ndarray, across: np.ndarray, down: np.ndarray, residuals: np.ndarray,
    rows: np.ndarray,
) -> None:  # fmt: skip
    """Write how far each pixel's edges are from its tangent planes, RMS in degrees (h, w) float32.

    `rows` (h, 3): of each row's edges, the sum of the squares, their number, and how many are torn.
    """
    nx, ny, nz = slopes
    height, width = mask.shape
    for r in numba.prange(height):
        for c in range(width):
            total, count = 0.0, 0
            if not mask[r, c]:
                continue
            for side in range(4):
                i, j = r + (side == 2) - (side == 3), c + (side == 0) - (side == 1)
                if i < 0 or j < 0 or i >= height or j >= width or not mask[i, j]:
                    continue
                if side < 2:
                    along, step = nx[r, c] + nx[i, j], (z[i, j] - z[r, c]) * (j - c)
                else:
                    along, step = ny[r, c] + ny[i, j], (z[i, j] - z[r, c]) * (r - i)
                facing = nz[r, c] + nz[i, j]
                angle = np.degrees(np.arctan(step) + np.arctan(along / facing))
                total += angle * angle
                count += 1
                if side == 0 or side == 2:
                    weight = across[r, c] if side == 0 else down[r, c]
                    squares = nz[r, c] ** 2 + nz[i, j] ** 2
                    rows[r, 0] += angle * angle
                    rows[r, 1] += 1
                    rows[r, 2] += weight < 0.005 * squares
            residuals[r, c] = np.sqrt(total / max(count, 1))


def right_side(edges: Edges) -> np.ndarray:
    """Return what flows into each pixel, (h, w) float64."""
    right = np.empty(edges.across.shape)
    _right_side(edges.flow_across, edges.flow_down, right)
    return right


@numba.njit(parallel=True, cache=True)
def _right_side(flow_across: np.ndarray, flow_down: np.ndarray, right: np.ndarray) -> None:
    height, width = right.shape
    for r in numba.prange(height):
        for c in range(width):
            total = flow_down[r, c] - flow_across[r, c]
            if c > 0:
                total += flow_across[r, c - 1]
            if r > 0:
                total -= flow_down[r - 1, c]
            right[r, c] = total


@numba.njit(parallel=True, cache=True)
def _apply(across: np.ndarray, down: np.ndarray, z: np.ndarray, out: np.ndarray) -> None:
    """Write the sum over a pixel's edges of weight times step (h, w)."""
    height, width = z.shape
    for r in numba.prange(height):
        for c in range(width):
            total = 0.0
            if across[r, c] > 0:
                total += across[r, c] * (z[r, c] - z[r, c + 1])
            if c > 0 and across[r, c - 1] > 0:
                total += across[r, c - 1] * (z[r, c] - z[r, c - 1])
            if down[r, c] > 0:
                total += down[r, c] * (z[r, c] - z[r + 1, c])
            if r > 0 and down[r - 1, c] > 0:
                total += down[r - 1, c] * (z[r, c] - z[r - 1, c])
            out[r, c] = total


@numba.njit(parallel=True, cache=True)
def _relax(across: np.ndarray, down: np.ndarray, right: np.ndarray, z: np.ndarray, colour: int) -> None:
    """Solve every other pixel's equation (Gauss-Seidel, red or black)."""
    height, width = z.shape
    for r in numba.prange(height):
        for c in range((r + colour) % 2, width, 2):
            weight, total = np.float32(0.0), right[r, c]
            if across[r, c] > 0:
                weight += across[r, c]
                total += across[r, c] * z[r, c + 1]
            if c > 0 and across[r, c - 1] > 0:
                weight += across[r, c - 1]
                total += across[r, c - 1] * z[r, c - 1]
            if down[r, c] > 0:
                weight += down[r, c]
                total += down[r, c] * z[r + 1, c]
            if r > 0 and down[r - 1, c] > 0:
                weight += down[r - 1, c]
                total += down[r - 1, c] * z[r - 1, c]
            if weight > 0:
                z[r, c] = total / weight


@numba.njit(parallel=True, cache=True)
def _gather(across: np.ndarray, down: np.ndarray, right: np.ndarray, z: np.ndarray, coarse: np.ndarray) -> None:
    """Write the sum over 2x2 pixels of what is left of the right side."""
    height, width = z.shape
    for i in numba.prange(coarse.shape[0]):
        for j in range(coarse.shape[1]):
            total = np.float32(0.0)
            for r in range(2 * i, min(2 * i + 2, height)):
                for c in range(2 * j, min(2 * j + 2, width)):
                    own = right[r, c]
                    if across[r, c] > 0:
                        own -= across[r, c] * (z[r, c] - z[r, c + 1])
                    if c > 0 and across[r, c - 1] > 0:
                        own -= across[r, c - 1] * (z[r, c] - z[r, c - 1])
                    if down[r, c] > 0:
                        own -= down[r, c] * (z[r, c] - z[r + 1, c])
                    if r > 0 and down[r - 1, c] > 0:
                        own -= down[r - 1, c] * (z[r, c] - z[r - 1, c])
                    total += own
            coarse[i, j] = total


@numba.njit(parallel=True, cache=True)
def _add_correction(coarse: np.ndarray, mask: np.ndarray, z: np.ndarray) -> None:
    """Add the correction of 2x2 pixels to each of them."""
    for r in numba.prange(z.shape[0]):
        for c in range(z.shape[1]):
            if mask[r, c]:
                z[r, c] += coarse[r // 2, c // 2]


def _coarser(across: np.ndarray, down: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the edges between squares of 2x2 pixels: those that leave a square, summed and halved."""
    pad = [(0, side % 2) for side in across.shape]
    across, down = np.pad(across, pad), np.pad(down, pad)
    return (across[::2, 1::2] + across[1::2, 1::2]) * _HALF, (down[1::2, ::2] + down[1::2, 1::2]) * _HALF


class Cycle:
    """A symmetric V-cycle, the approximate inverse of a grid's Laplacian; float32.

    Args:
        across, down: (h, w) float32 weights of the edges.
        mask: (h, w) bool.
    """

    def __init__(self, across: np.ndarray, down: np.ndarray, mask: np.ndarray) -> None:
        self.across, self.down, self.mask = across, down, mask
        self.coarser: Cycle | None = None
        if mask.size > _COARSE:
            pad = [(0, side % 2) for side in mask.shape]
            wide = np.pad(mask, pad)
            squares = wide[::2, ::2] | wide[1::2, ::2] | wide[::2, 1::2] | wide[1::2, 1::2]
            self.coarser = Cycle(*_coarser(across, down), squares)
        else:
            self.exact = multigrid(_matrix(across, down, mask))
            self.labels = (ndimage.label(mask)[0] - 1)[mask]

    def __call__(self, right: np.ndarray) -> np.ndarray:
        """Return about what z (h, w) has this right side."""
        z = np.zeros(right.shape, np.float32)
        if self.coarser is None:
            # The mean of a component is free: what rounding makes of it would grow without bound.
            z[self.mask] = self._centre(self.exact.matvec(self._centre(right[self.mask].astype(np.float64))))
            return z
        for colour in (0, 1):
            _relax(self.across, self.down, right, z, colour)
        below = np.empty(self.coarser.mask.shape, np.float32)
        _gather(self.across, self.down, right, z, below)
        _add_correction(self.coarser(below), self.mask, z)
        for colour in (1, 0):
            _relax(self.across, self.down, right, z, colour)
        return z

    def _centre(self, values: np.ndarray) -> np.ndarray:
        """Return values (n,) less their mean over each component."""
        return values - (np.bincount(self.labels, values) / np.bincount(self.labels))[self.labels]


def _matrix(across: np.ndarray, down: np.ndarray, mask: np.ndarray) -> Any:
    index = np.full(mask.shape, -1, np.int64)
    index[mask] = np.arange(mask.sum())
    right, below = across > 0, down > 0
    starts = np.concatenate([index[right], index[below]])
    stops = np.concatenate([index[:, 1:][right[:, :-1]], index[1:][below[:-1]]])
    weights = np.concatenate([across[right], down[below]]).astype(np.float64)
    return laplacian(np.stack([starts, stops]), weights, int(mask.sum()))


def solve_grid(
    cycle: "Cycle", rest: np.ndarray, z: np.ndarray, *, tolerance: float, most: int = 300,
    tell: Callable[[float], None] = lambda share: None,
) -> int:  # fmt: skip
    """Move z (h, w) float64 to the least sum of weights (step - wanted)^2, in place; return the number of steps.

    Args:
        cycle: Of the edges' weights: the equations, and the preconditioner.
        rest: (h, w) float64, `right_side` of the edges; overwritten.
        z: Where to start.
        tolerance: Of the residual, as a share of the right side.
        most: Steps.
        tell: Called with the share that is done.
    """
    across, down, product = cycle.across, cycle.down, np.empty(z.shape)
    goal = tolerance * float(np.sqrt(_dot(rest, rest)))
    _apply(across, down, z, product)
    rest -= product
    first = left = float(np.sqrt(_dot(rest, rest)))
    way, slope, scaled = np.zeros(z.shape), np.inf, np.empty(z.shape, np.float32)
    for number in range(most):
        if left <= max(goal, _FEWEST):
            return number
        guess = cycle(np.multiply(rest, 1.0 / left, out=scaled, casting="same_kind"))  # or float32 would not hold it
        before, slope = slope, left * _dot(guess, rest)
        _turn(way, guess, left, slope / before)
        _apply(across, down, way, product)
        _move(z, rest, way, product, slope / max(_dot(way, product), _FEWEST))
        left = float(np.sqrt(_dot(rest, rest)))
        if first > goal > 0.0:
            tell(min(max(np.log(first / max(left, _FEWEST)) / np.log(first / goal), 0.0), 1.0))
    return most


def _dot(first: np.ndarray, second: np.ndarray) -> float:
    """Return the sum of products, row by row, so that it does not depend on the number of threads."""
    rows = np.empty(len(first))
    _dot_rows(first, second, rows)
    return float(rows.sum())


@numba.njit(parallel=True, cache=True)
def _dot_rows(first: np.ndarray, second: np.ndarray, rows: np.ndarray) -> None:
    for r in numba.prange(first.shape[0]):
        total = 0.0
        for c in range(first.shape[1]):
            total += first[r, c] * second[r, c]
        rows[r] = total


@numba.njit(parallel=True, cache=True)
def _turn(way: np.ndarray, guess: np.ndarray, size: float, kept: float) -> None:
    for r in numba.prange(way.shape[0]):
        for c in range(way.shape[1]):
            way[r, c] = size * guess[r, c] + kept * way[r, c]


@numba.njit(parallel=True, cache=True)
def _move(z: np.ndarray, rest: np.ndarray, way: np.ndarray, product: np.ndarray, pace: float) -> None:
    for r in numba.prange(z.shape[0]):
        for c in range(z.shape[1]):
            z[r, c] += pace * way[r, c]
            rest[r, c] -= pace * product[r, c]
