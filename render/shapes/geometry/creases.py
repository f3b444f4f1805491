"""Normals at the vertices of a mesh that keep its edges: vertices are split where the surface turns sharply."""

from typing import NamedTuple

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from render.shapes.geometry.windings import edge_pairs

CREASE = 40.0
"""Degrees between two triangles from which their common edge is sharp.

A round part of 10 segments turns by 36 at each, one of 12 by 30, and CAD programs cut curves finer still (FreeCAD by
28.6 at most); chamfers turn by 45, hexagons by 60, boxes by 90. Of the edges of the Stanford bunny 0.05 % turn by more.
"""
_LEAST = np.cos(np.radians(CREASE))
_SPECK_EDGES, _SPECK_SIZE = 4, 0.01  # sharp edges this few, over less than this share of the mesh, are noise of a scan
_KEY_BITS = 12  # normals of one vertex that round to the same values are one vertex


_SMEARED = np.cos(np.radians(10.0))  # given normals nearer than this on both sides of a sharp edge know nothing of it


class _Fans(NamedTuple):
    """What becomes of vertices at sharp edges; corners are numbered 3 * face + corner."""

    owner: np.ndarray  # (W,) vertex that each new vertex comes from; the first V are the old ones in their order
    faces: np.ndarray  # (F, 3) of new vertices
    joined: np.ndarray  # (2, N) corners of two triangles at one end of an edge that is not sharp
    apart: np.ndarray  # (2, M) the same at an edge that is sharp


def shade(
    vertices: np.ndarray, faces: np.ndarray, given: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Split vertices at creases and return their normals.

    Around a vertex, triangles that are joined by edges which turn by less than `CREASE` share a normal: the mean of
    theirs by area and angle. Where it lies farther than that from a triangle's own, as at the tip of a cone, the
    triangle takes its own and its neighbours'. A given normal takes the place of either where it lies within `CREASE`
    of its triangle's; one that is the same on both sides of a sharp edge has to fit on both. One of the opposite
    sign is turned first.

    Args:
        vertices: (V, 3) positions, equal ones merged.
        faces: (F, 3) vertex indices, counter-clockwise seen from outside; no triangle without area.
        given: (F, 3, 3) normals of the corners as the file has them, of any length, NaN or zero where it has none.

    Returns:
        Vertices (W, 3) float64, faces (F, 3) int64 and unit normals (W, 3) float32.
    """
    vertices = np.asarray(vertices, np.float64)
    corners = vertices[faces]
    crosses = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    double = np.linalg.norm(crosses, axis=1)
    flat = crosses / double[:, None]
    weights = _angles(corners) * double[:, None]
    del corners, crosses
    fans = _split_corners(vertices, faces, flat)
    owner, split = fans.owner, fans.faces
    normals = _means(split, flat, weights, len(owner))
    wanted = normals[split]
    unfit = (wanted * flat[:, None]).sum(2) < _LEAST
    if unfit.any():
        wanted[unfit] = _local(fans.joined, unfit, flat, weights)
    if given is not None:
        turned, fits = _fitting(given, flat, fans)
        wanted[fits] = turned[fits]
    if given is not None or unfit.any():
        owner, split, normals = _merge(owner, split, wanted.reshape(-1, 3))
    return vertices[owner], split, normals.astype(np.float32)


def _split_corners(vertices: np.ndarray, faces: np.ndarray, flat: np.ndarray) -> _Fans:
    """Part the corners at sharp edges."""
    first, second, same = edge_pairs(faces)
    sharp = same | ((flat[first // 3] * flat[second // 3]).sum(1) < _LEAST)
    start, end = faces.ravel(), np.roll(faces, -1, axis=1).ravel()
    sharp[sharp] = ~_specks(vertices, start[first[sharp]], end[first[sharp]])
    # Wound alike, the one edge starts where the other ends.
    ends = np.stack([np.where(same, second, _end(second)), np.where(same, _end(second), second)])
    apart = np.concatenate([[first[sharp], ends[0, sharp]], [_end(first[sharp]), ends[1, sharp]]], axis=1)
    joined = np.concatenate([[first[~sharp], ends[0, ~sharp]], [_end(first[~sharp]), ends[1, ~sharp]]], axis=1)
    owner, split = np.arange(len(vertices)), faces.astype(np.int64)
    if not sharp.any():
        return _Fans(owner, split, joined, apart)
    touched = np.zeros(len(vertices), bool)
    touched[start[first[sharp]]] = touched[end[first[sharp]]] = True
    chosen = np.flatnonzero(touched[start])  # corners at sharp edges: only these may part
    place = np.full(len(start), -1)
    place[chosen] = np.arange(len(chosen))
    rows, columns = place[joined[:, touched[start[joined[0]]]]]
    graph = coo_matrix((np.ones(len(rows), np.int8), (rows, columns)), shape=(len(chosen),) * 2)
    _, fan = connected_components(graph, directed=False)
    # The first fan at a vertex keeps its place, the others come behind.
    _, leader = np.unique(fan, return_index=True)
    of_fan = start[chosen[leader]]
    _, keeper = np.unique(of_fan, return_index=True)
    number = np.full(len(leader), -1)
    number[keeper] = of_fan[keeper]
    number[number < 0] = len(vertices) + np.arange((number < 0).sum())
    moved = split.ravel().copy()
    moved[chosen] = number[fan]
    return _Fans(np.concatenate([owner, np.delete(of_fan, keeper)]), moved.reshape(-1, 3), joined, apart)


def _end(edges: np.ndarray) -> np.ndarray:
    """Return the corners at which edges end; an edge has the number of the corner where it starts."""
    return edges - edges % 3 + (edges % 3 + 1) % 3


def _specks(vertices: np.ndarray, start: np.ndarray, end: np.ndarray) -> np.ndarray:  # (N,) bool
    """Return which sharp edges belong to only a few that hang together, in a tiny part of the mesh."""
    if not len(start):
        return np.empty(0, bool)
    used, place = np.unique(np.concatenate([start, end]), return_inverse=True)
    rows, columns = place.reshape(2, -1)
    graph = coo_matrix((np.ones(len(rows), np.int8), (rows, columns)), shape=(len(used),) * 2)
    count, group = connected_components(graph, directed=False)
    low, high = np.full((count, 3), np.inf), np.full((count, 3), -np.inf)
    np.minimum.at(low, group, vertices[used])
    np.maximum.at(high, group, vertices[used])
    small = np.linalg.norm(high - low, axis=1) < _SPECK_SIZE * np.linalg.norm(np.ptp(vertices, axis=0))
    few = np.bincount(group[rows], minlength=count) <= _SPECK_EDGES
    return (small & few)[group[rows]]


def _angles(corners: np.ndarray) -> np.ndarray:  # (F, 3) radians
    """Return the angles of triangles (F, 3, 3) at their corners."""
    found = np.empty(corners.shape[:2])
    for k in range(3):
        one, other = corners[:, (k + 1) % 3] - corners[:, k], corners[:, (k + 2) % 3] - corners[:, k]
        found[:, k] = np.arctan2(np.linalg.norm(np.cross(one, other), axis=1), (one * other).sum(1))
    return found


def _means(faces: np.ndarray, flat: np.ndarray, weights: np.ndarray, count: int) -> np.ndarray:  # (count, 3)
    """Return unit means of the triangles' normals at vertices; one of them where they cancel or have no weight."""
    sums = np.stack(
        [
            sum(np.bincount(faces[:, k], flat[:, axis] * weights[:, k], count) for k in range(3))
            for axis in range(3)
        ],
        axis=1,
    )  # fmt: skip
    total = sum(np.bincount(faces[:, k], weights[:, k], count) for k in range(3))
    length = np.linalg.norm(sums, axis=1)
    lost = length <= 1e-9 * total
    stand_in = np.zeros_like(sums)
    stand_in[faces.ravel()] = np.repeat(flat, 3, axis=0)
    return np.where(lost[:, None], stand_in, sums / np.where(lost, 1, length)[:, None])


def _local(joined: np.ndarray, at: np.ndarray, flat: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Return unit normals (N, 3) at corners `at` (F, 3) bool: means over a triangle and those joined to it there."""
    chosen = at.ravel()
    place = np.cumsum(chosen) - 1
    corners = np.flatnonzero(chosen)
    heavy = weights.ravel()
    sums = flat[corners // 3] * heavy[corners, None]
    for one, other in (joined, joined[::-1]):
        here = chosen[one]
        np.add.at(sums, place[one[here]], flat[other[here] // 3] * heavy[other[here], None])
    return sums / np.linalg.norm(sums, axis=1, keepdims=True)


def _fitting(given: np.ndarray, flat: np.ndarray, fans: _Fans) -> tuple[np.ndarray, np.ndarray]:
    """Return given normals (F, 3, 3) at unit length, outward, and which are to be used (F, 3)."""
    length = np.linalg.norm(given, axis=2, keepdims=True)
    with np.errstate(invalid="ignore", divide="ignore"):
        unit = given / length
    unit = np.where(np.isfinite(unit), unit, 0)
    along = (unit * flat[:, None]).sum(2)
    sign = np.where(along.sum(1) < 0, -1.0, 1.0)[:, None]
    fits = along * sign >= _LEAST
    one, other = unit.reshape(-1, 3)[fans.apart]
    across = ((one * other).sum(1) > _SMEARED) & ~fits.ravel()[fans.apart].all(0)
    smeared = np.zeros(len(fans.owner), bool)
    smeared[fans.faces.ravel()[fans.apart[:, across]]] = True
    return unit * sign[..., None], fits & ~smeared[fans.faces]


def _merge(owner: np.ndarray, faces: np.ndarray, wanted: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Make one vertex of all corners with the same vertex and normal (3F, 3); as `_split_corners`, and its normals."""
    steps = np.rint((wanted + 1) * ((1 << _KEY_BITS - 1) - 1)).astype(np.int64)
    key = owner[faces.ravel()]
    for axis in range(3):
        key = (key << _KEY_BITS) | steps[:, axis]
    _, kept, split = np.unique(key, return_index=True, return_inverse=True)
    return owner[faces.ravel()[kept]], split.reshape(-1, 3), wanted[kept]
