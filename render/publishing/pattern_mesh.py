"""A mesh cut finer where a material pattern needs it, with the pattern at its vertices.

Renderers without the pattern's own code interpolate over triangles; along sharp edges of the pattern they are cut so
small that the difference is not seen.
"""

from collections.abc import Callable, Iterator

import numpy as np

from render.shapes.geometry.mesh import TriangleMesh, unit

_TOLERANCE = 1 / 64
_COARSEST = 0.05  # longer edges might step over a whole patch
_ROUNDS = 16

Weights = Callable[[np.ndarray, np.ndarray], np.ndarray]


def cut(mesh: TriangleMesh, weights: Weights, edge: float) -> tuple[TriangleMesh, np.ndarray]:
    """Split triangles in four until weights vary linearly over each, or its edges are shorter than `edge`.

    Shape and shading stay as they are: new vertices lie on the old triangles, with interpolated normals.

    Args:
        mesh: The object.
        weights: Maps (N, 3) points and the (N,) numbers of the triangles they lie on to (N, M) weights.
        edge: Length below which no edge is split, in units of the mesh.

    Returns:
        The mesh, and (V, M - 1) float32 shares: column k is the share of material k + 1 in what it and those before it
        have together, as nested blends of two take it. A vertex where the pattern jumps appears once for each side.
    """
    corners, normals, value = (np.concatenate(part) for part in zip(*_subdivide(mesh, weights, edge), strict=True))
    pieces = (corners, normals, _shares(value))
    rows = np.concatenate([part.reshape(-1, part.shape[-1]) for part in pieces], axis=1).astype(np.float32)
    rows, corners = np.unique(rows, axis=0, return_inverse=True)
    finer = TriangleMesh(vertices=rows[:, :3], normals=unit(rows[:, 3:6]), faces=corners.reshape(-1, 3))
    return finer, rows[:, 6:]


def _subdivide(
    mesh: TriangleMesh, weights: Weights, edge: float
) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Yield finished triangles, round by round: corners (F, 3, 3), normals (F, 3, 3), weights (F, 3, M)."""
    corners, normals = (values[mesh.faces].astype(np.float64) for values in (mesh.vertices, mesh.normals))
    number = np.arange(len(corners))
    for step in range(_ROUNDS):
        value = _at(weights, corners, number)
        length = np.linalg.norm(corners - np.roll(corners, -1, 1), axis=2).max(1)
        uneven = _unevenness(weights, corners, number, value) > _TOLERANCE
        split = (length > edge) & (uneven | (length > _COARSEST)) & (step < _ROUNDS - 1)
        yield corners[~split], normals[~split], value[~split]
        corners, normals, number = _quarters(corners[split]), _quarters(normals[split]), np.tile(number[split], 4)
        if not len(corners):
            return


def _shares(value: np.ndarray) -> np.ndarray:
    """Return the shares, (F, 3, M - 1), of the weights (F, 3, M) in nested blends.

    Where the first materials have nothing, their shares do not matter at the corner but on the way to the others, which
    therefore lend it theirs.
    """
    together = np.cumsum(value, axis=2)[:, :, 1:]
    known = together > 1e-6
    share = np.where(known, value[:, :, 1:] / np.maximum(together, 1e-6), 0)
    lent = share.sum(1, keepdims=True) / np.maximum(known.sum(1, keepdims=True), 1)
    return np.where(known, share, lent)


def _unevenness(weights: Weights, corners: np.ndarray, number: np.ndarray, value: np.ndarray) -> np.ndarray:
    """Return how far, (F,), the weights at the middles of the edges and of the triangle are from interpolated ones."""
    middle = np.concatenate([_middles(corners), corners.mean(1, keepdims=True)], axis=1)
    expected = np.concatenate([_middles(value), value.mean(1, keepdims=True)], axis=1)
    return np.abs(_at(weights, middle, number) - expected).max((1, 2))


def _at(weights: Weights, points: np.ndarray, number: np.ndarray) -> np.ndarray:
    """Evaluate at (F, P, 3) points of the triangles `number` (F,); returns (F, P, M)."""
    flat = weights(points.reshape(-1, 3), np.repeat(number, points.shape[1]))
    return flat.reshape(*points.shape[:2], -1)


def _middles(corners: np.ndarray) -> np.ndarray:
    """Return the middles of the edges 01, 12, 20; (F, 3, D)."""
    return (corners + np.roll(corners, -1, 1)) / 2


def _quarters(corners: np.ndarray) -> np.ndarray:
    """Split (F, 3, 3) triangles at the middles of their edges: (4 F, 3, 3), the winding kept."""
    a, b, c = (corners[:, k] for k in range(3))
    ab, bc, ca = (_middles(corners)[:, k] for k in range(3))
    return np.concatenate([np.stack(triple, 1) for triple in ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))])
