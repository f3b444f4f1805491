"""Faces of more than three corners as triangles, concave ones too."""

import numpy as np

from render.shared.errors import InputError

_MOST = 20_000  # corners of a concave face: the time to cut it grows with their square, to a minute


def triangulate(points: np.ndarray, counts: np.ndarray) -> np.ndarray:
    """Cut polygons into triangles without new vertices.

    A convex polygon becomes a fan around its first corner. Where a fan would leave the polygon, ears are cut off.

    Args:
        points: (N, 3) positions of the corners of all polygons, one polygon after the other, each counter-clockwise.
        counts: (P,) corners of each polygon; those of fewer than three give no triangle.

    Raises:
        InputError: a concave polygon of more than 20,000 corners.

    Returns:
        (T, 3) int64, places in `points`; the triangles of a polygon stand together, in the polygons' order.
    """
    counts = np.asarray(counts, np.int64)
    first = np.cumsum(counts) - counts
    number = np.maximum(counts - 2, 0)
    polygon = np.repeat(np.arange(len(counts)), number)
    step = np.arange(len(polygon)) - np.repeat(np.cumsum(number) - number, number)
    base = first[polygon]
    fans = np.stack([base, base + step + 1, base + step + 2], axis=1)
    if not (number > 1).any():
        return fans
    corners = np.asarray(points, np.float64)[fans]
    with np.errstate(all="ignore"):  # positions that are not finite are refused later
        crosses = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        whole = np.stack([np.bincount(polygon, crosses[:, axis], len(counts)) for axis in range(3)], axis=1)
        inside = (crosses * whole[polygon]).sum(1) >= -1e-9 * (whole**2).sum(1)[polygon]
    for concave in np.unique(polygon[~inside]):
        start, count = first[concave], counts[concave]
        if count > _MOST:
            raise InputError(f"has a face of {count:,} corners that is not convex; export it as triangles")
        fans[polygon == concave] = start + _cut_ears(
            np.asarray(points[start : start + count], np.float64), whole[concave]
        )
    return fans


def _cut_ears(points: np.ndarray, normal: np.ndarray) -> np.ndarray:  # (n - 2, 3)
    """Cut ears off a polygon (n, 3) as seen along its normal, always the one with the widest smallest angle."""
    drop = int(np.abs(normal).argmax())
    keep = [(drop + 1) % 3, (drop + 2) % 3]
    flat = points[:, keep] * (1 if normal[drop] >= 0 else [-1, 1])
    left, found = list(range(len(points))), []
    while len(left) > 3:
        found.append(_find_ear(flat, left))
        left.remove(found[-1][1])
    return np.array([*found, tuple(left)])


def _find_ear(flat: np.ndarray, left: list[int]) -> tuple[int, int, int]:
    """Return the ear of what is left of a flat polygon; without any, as where it crosses itself, its widest corner."""
    ring = flat[left]
    before, after = np.roll(ring, 1, axis=0), np.roll(ring, -1, axis=0)
    turn = _cross(ring - before, after - ring)  # twice the area of the triangle at each corner
    sides = np.stack([((ring - before) ** 2).sum(1), ((after - ring) ** 2).sum(1), ((after - before) ** 2).sum(1)])
    shape = turn / np.maximum(sides.max(0), np.finfo(float).tiny)
    order = np.argsort(-shape)
    best = int(order[0])
    for corner in order:
        if turn[corner] <= 0:
            break
        a, b, c = before[corner], ring[corner], after[corner]
        within = (_cross(b - a, ring - a) >= 0) & (_cross(c - b, ring - b) >= 0) & (_cross(a - c, ring - c) >= 0)
        ends = (ring == a).all(1) | (ring == b).all(1) | (ring == c).all(1)
        if not (within & ~ends).any():
            best = int(corner)
            break
    return left[best - 1], left[best], left[(best + 1) % len(left)]


def _cross(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    return one[..., 0] * other[..., 1] - one[..., 1] * other[..., 0]
