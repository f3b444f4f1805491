"""How far one mesh can move along a direction until it touches another: exact, for any triangles."""

from typing import NamedTuple

import numpy as np

from render.shapes.geometry.mesh import TriangleMesh

CLEARANCE = 1e-5  # left between meshes that touch; above what positions in float32 round off
_CELLS = 160  # along the longer side of where the two overlap, seen along the direction
_FIRST = 32  # cells looked into before the others
_CHUNK = 1 << 15  # pairs of triangles compared at once
_EDGE = 1e-9  # by how much points may lie outside a triangle


def free_path(moving: TriangleMesh, fixed: TriangleMesh, direction: np.ndarray, most: float = float("inf")) -> float:
    """Return how far `moving` can go along `direction` before it touches `fixed`; `most` where it never does.

    Over each triangle the distance to go is linear, so that the least of a pair of triangles lies at a corner of their
    overlap, seen along the direction: a corner of one over the other, or a crossing of edges. Only faces that look
    towards each other can meet first. The result does not depend on the number of threads.

    Args:
        moving, fixed: Meshes that do not pass through each other; what lies behind `moving` does not stop it.
        direction: (3,) unit vector.
        most: Distance of interest; a small one is found sooner.

    Returns:
        The distance less `CLEARANCE`, in [0, most].
    """
    frame = _frame(direction)
    ahead, facing = _towards(moving, frame, 1.0), _towards(fixed, frame, -1.0)
    low = np.maximum(*(faces.low[:, :2].min(0, initial=np.inf) for faces in (ahead, facing)))
    high = np.minimum(*(faces.high[:, :2].max(0, initial=-np.inf) for faces in (ahead, facing)))
    if (low > high).any():
        return most
    grid = _Grid(ahead.within(low, high), facing.within(low, high), low, high)
    best = most + CLEARANCE
    for cells in np.split(grid.order, [_FIRST]):  # those that promise the shortest way; often no other one is needed
        first, second = grid.pairs(cells[grid.promise[cells] < best])
        lowest = grid.facing.low[second, 2] - grid.ahead.high[first, 2]
        kept = np.flatnonzero((lowest < best) & (grid.facing.high[second, 2] >= grid.ahead.low[first, 2]))
        order = kept[np.argsort(lowest[kept], kind="stable")]
        for start in range(0, len(order), _CHUNK):
            chosen = order[start : start + _CHUNK]
            if lowest[chosen[0]] >= best:
                break
            best = min(best, _least(grid.ahead.corners[first[chosen]], grid.facing.corners[second[chosen]]))
    return max(best - CLEARANCE, 0.0)


class _Faces(NamedTuple):
    """Triangles in a frame whose last axis is the direction: corners (F, 3, 3) and their boxes (F, 3), float64."""

    corners: np.ndarray
    low: np.ndarray
    high: np.ndarray

    def within(self, low: np.ndarray, high: np.ndarray) -> "_Faces":
        """Return the triangles whose boxes meet a rectangle across the direction."""
        kept = np.flatnonzero(((self.high[:, :2] >= low) & (self.low[:, :2] <= high)).all(1))
        return _Faces(*(values[kept] for values in self))


def _frame(direction: np.ndarray) -> np.ndarray:  # (3, 3)
    """Return an orthonormal frame whose last column is the direction."""
    axis = np.eye(3)[int(np.abs(direction).argmin())]
    across = np.cross(direction, axis)
    across /= np.sqrt((across**2).sum())
    return np.stack([across, np.cross(direction, across), direction], axis=1)


def _towards(mesh: TriangleMesh, frame: np.ndarray, sign: float) -> _Faces:
    """Return the faces that look along the direction (sign 1) or against it (-1)."""
    vertices = mesh.vertices.astype(np.float64)
    # Not a matrix product, whose last bits depend on the number of threads.
    turned = sum(vertices[:, axis, None] * frame[axis] for axis in range(3))
    x, y = turned[:, 0].copy(), turned[:, 1].copy()
    a, b, c = mesh.faces.T
    area = (x[b] - x[a]) * (y[c] - y[a]) - (y[b] - y[a]) * (x[c] - x[a])
    a, b, c = (turned[corner] for corner in mesh.faces[area * sign > 0].T)
    return _Faces(np.stack([a, b, c], axis=1), np.minimum(np.minimum(a, b), c), np.maximum(np.maximum(a, b), c))


class _Grid:
    """Cells across the direction, and the triangles of two meshes whose boxes meet each.

    Attributes:
        ahead, facing: The triangles.
        promise: (C,) the least distance that two triangles of a cell can have, as far as their boxes show.
        order: The cells where both meshes are, those of the least promise first.
    """

    def __init__(self, ahead: _Faces, facing: _Faces, low: np.ndarray, high: np.ndarray) -> None:
        self.ahead, self.facing = ahead, facing
        size = max(float((high - low).max()) / _CELLS, 1e-12)
        sides = np.floor((high - low) / size).astype(np.int64) + 1
        listed = [_in_cells(faces, low, size, sides) for faces in (ahead, facing)]
        count = int(sides.prod())
        self.numbers = [numbers for _, numbers in listed]
        self.counts = [np.bincount(cells, minlength=count) for cells, _ in listed]
        self.starts = [np.cumsum(counts) - counts for counts in self.counts]
        both = np.flatnonzero((self.counts[0] > 0) & (self.counts[1] > 0))
        self.promise = np.full(count, np.inf)
        if len(both):
            highest = _reduce(np.maximum, ahead.high[self.numbers[0], 2], self.counts[0])
            lowest = _reduce(np.minimum, facing.low[self.numbers[1], 2], self.counts[1])
            self.promise[both] = lowest[both] - highest[both]
        self.order = both[np.argsort(self.promise[both], kind="stable")]

    def pairs(self, cells: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the numbers of triangles that share one of the cells and whose boxes meet across the direction."""
        width = [counts[cells] for counts in self.counts]
        cell, within = _ranges(width[0] * width[1])
        first = self.numbers[0][self.starts[0][cells[cell]] + within // width[1][cell]]
        second = self.numbers[1][self.starts[1][cells[cell]] + within % width[1][cell]]
        meet = np.ones(len(first), bool)
        for axis in range(2):
            meet &= self.ahead.low[first, axis] <= self.facing.high[second, axis]
            meet &= self.ahead.high[first, axis] >= self.facing.low[second, axis]
        return first[meet], second[meet]


def _reduce(kind: np.ufunc, values: np.ndarray, counts: np.ndarray) -> np.ndarray:  # (C,)
    """Reduce values, sorted by cell, to one of each cell; 0 for cells without any."""
    filled = np.flatnonzero(counts)
    found = np.zeros(len(counts))
    found[filled] = kind.reduceat(values, (np.cumsum(counts) - counts)[filled])
    return found


def _ranges(lengths: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return for runs of these lengths, one after the other, the number of each entry's run and its place in it."""
    run = np.repeat(np.arange(len(lengths)), lengths)
    return run, np.arange(len(run)) - np.repeat(np.cumsum(lengths) - lengths, lengths)


def _in_cells(faces: _Faces, low: np.ndarray, size: float, sides: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """List the cells that the triangles' boxes cover, rising, and the triangle of each."""
    least = np.floor((faces.low[:, :2] - low) / size).astype(np.int64)
    most = np.floor((faces.high[:, :2] - low) / size).astype(np.int64)
    inside = np.flatnonzero(((most >= 0) & (least < sides)).all(1))
    least, most = np.maximum(least[inside], 0), np.minimum(most[inside], sides - 1)
    width, height = (most - least + 1).T
    number, within = _ranges(width * height)
    column, row = least[number, 0] + within % width[number], least[number, 1] + within // width[number]
    cell = row * sides[0] + column
    order = np.argsort(cell.astype(np.int32), kind="stable")  # a radix sort
    return cell[order], inside[number[order]]


def _least(moving: np.ndarray, fixed: np.ndarray) -> float:
    """Return the least distance that is not negative over pairs of triangles (N, 3, 3), infinity where none overlap."""
    found = [np.inf]
    for one, other, sign in ((moving, fixed, 1.0), (fixed, moving, -1.0)):
        for corner in range(3):
            height, inside = _over(one[:, corner, :2], other)
            found.append(_smallest(sign * (height - one[:, corner, 2]), inside))
    for k in range(3):
        for m in range(3):
            a, b = moving[:, k], moving[:, (k + 1) % 3] - moving[:, k]
            c, d = fixed[:, m], fixed[:, (m + 1) % 3] - fixed[:, m]
            area = b[:, 0] * d[:, 1] - b[:, 1] * d[:, 0]
            safe = np.where(area == 0, 1.0, area)
            way = c - a
            s = (way[:, 0] * d[:, 1] - way[:, 1] * d[:, 0]) / safe
            t = (way[:, 0] * b[:, 1] - way[:, 1] * b[:, 0]) / safe
            cross = (area != 0) & (s >= 0) & (s <= 1) & (t >= 0) & (t <= 1)
            found.append(_smallest(c[:, 2] + t * d[:, 2] - a[:, 2] - s * b[:, 2], cross))
    return min(found)


def _over(points: np.ndarray, triangles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the height (N,) of triangles (N, 3, 3) at points (N, 2), and which points lie inside."""
    a, b, c = (triangles[:, corner] for corner in range(3))
    u, v, p = b - a, c - a, points - a[:, :2]
    area = u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0]
    safe = np.where(area == 0, 1.0, area)
    s = (p[:, 0] * v[:, 1] - p[:, 1] * v[:, 0]) / safe
    t = (u[:, 0] * p[:, 1] - u[:, 1] * p[:, 0]) / safe
    inside = (area != 0) & (s >= -_EDGE) & (t >= -_EDGE) & (s + t <= 1 + _EDGE)
    return a[:, 2] + s * u[:, 2] + t * v[:, 2], inside


def _smallest(distances: np.ndarray, valid: np.ndarray) -> float:
    return float(np.min(distances, initial=np.inf, where=valid & (distances >= 0)))
