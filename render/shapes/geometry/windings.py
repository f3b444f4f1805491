"""Which way the triangles of a mesh are wound: neighbours alike, closed surfaces outside out."""

import numpy as np
import trimesh
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

_MOST_AT_AN_EDGE = 8  # triangles; with more at one edge, not every two of them are compared
_NEARLY_CLOSED = 0.2  # length of the sum of all area vectors over the area: 0 of a closed surface, 1 of a flat one


def outward(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Wind faces consistently, and a closed or nearly closed surface outside out.

    Open pieces are wound as most of their area is in the file, and one that is nearly closed, as a scan with holes,
    so that its volume is positive. Where triangles are wound consistently already and none of this applies, they stay.

    Args:
        vertices: (V, 3), equal positions merged.
        faces: (F, 3) vertex indices.

    Returns:
        (F, 3) int64, each row a rotation or a reversal of the row of `faces`.
    """
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    if mesh.is_watertight:
        mesh.fix_normals(multibody=True)
        return np.asarray(mesh.faces, dtype=np.int64)
    first, second, same = edge_pairs(faces, 2)
    piece, turned = _pieces(len(faces), first // 3, second // 3, same)
    faces = np.where(turned[:, None], faces[:, ::-1], faces)
    corners = np.asarray(vertices, np.float64)[faces]
    area = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]) / 2
    size = np.linalg.norm(area, axis=1)
    count = int(piece.max()) + 1
    total, kept = np.bincount(piece, size, count), np.bincount(piece, np.where(turned, 0, size), count)
    against = kept < total / 2  # most of the piece was wound the other way
    middle = corners.mean(1)
    weights = np.maximum(total, np.finfo(float).tiny)
    centre = np.stack([np.bincount(piece, middle[:, k] * size, count) for k in range(3)], 1) / weights[:, None]
    volume = np.bincount(piece, ((middle - centre[piece]) * area).sum(1) / 3, count)
    vector = np.stack([np.bincount(piece, area[:, k], count) for k in range(3)], 1)
    closed = np.linalg.norm(vector, axis=1) < _NEARLY_CLOSED * total
    flip = np.where(closed & (np.bincount(piece, minlength=count) > 3), volume < 0, against)
    return np.where(flip[piece][:, None], faces[:, ::-1], faces).astype(np.int64)


def edge_pairs(faces: np.ndarray, most: int = _MOST_AT_AN_EDGE) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Find every two triangles that share an edge; edges are numbered 3 * face + corner at which they start.

    Args:
        faces: (F, 3) vertex indices.
        most: Edges that more triangles share are left out when this is 2, else not all of their pairs are found.

    Returns:
        Edges of the one triangle and of the other, (N,) int64 each, and whether both run the same way, (N,) bool,
        which two triangles that are wound alike do not.
    """
    start, end = faces.astype(np.int64).ravel(), np.roll(faces, -1, axis=1).astype(np.int64).ravel()
    key = np.minimum(start, end) * (int(faces.max()) + 1) + np.maximum(start, end)
    order = np.argsort(key, kind="stable")
    key = key[order]
    found = []
    for step in range(1, most):
        at = np.flatnonzero(key[step:] == key[:-step])
        if not len(at):
            break
        if most == 2 and len(key) > 2:  # an edge of exactly two
            alone = np.ones(len(at), bool)
            alone[at > 0] &= key[at[at > 0] - 1] != key[at[at > 0]]
            inner = at + 2 < len(key)
            alone[inner] &= key[at[inner] + 2] != key[at[inner]]
            at = at[alone]
        found.append((order[at], order[at + step]))
    if not found:
        return np.empty(0, np.int64), np.empty(0, np.int64), np.empty(0, bool)
    first, second = (np.concatenate(each) for each in zip(*found, strict=True))
    return first, second, start[first] == start[second]


def _pieces(count: int, one: np.ndarray, other: np.ndarray, same: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the piece of each of `count` faces, and which faces to reverse so that each piece is wound alike.

    Every face stands twice in the graph, as it is and reversed; neighbours that are wound alike are joined as they
    are, others crosswise. A one-sided piece (a Moebius strip), where both come together, stays as it is.
    """
    rows = np.concatenate([one, one + count])
    columns = np.concatenate([np.where(same, other + count, other), np.where(same, other, other + count)])
    graph = coo_matrix((np.ones(len(rows), np.int8), (rows, columns)), shape=(2 * count, 2 * count))
    _, label = connected_components(graph, directed=False)
    as_is, reversed_ = label[:count], label[count:]
    _, piece = np.unique(np.minimum(as_is, reversed_), return_inverse=True)
    return piece, as_is > reversed_
