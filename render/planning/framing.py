"""How a view frames its shape, before a ray is cast: share of the frame it fills, and how much its normals vary.

The mesh is rasterised at low resolution with numpy, one sample at the centre of every cell, nearest surface first.
"""

from dataclasses import dataclass, replace

import numpy as np

from render.records.manifest import View
from render.shapes.geometry.mesh import TriangleMesh
from render.shared.imaging.vectors import unit

CELLS = 32  # cells along a frame; along a tile, half as many
_MOST_CELLS = 1 << 22  # cells of all triangles' boxes together that are tested at once


@dataclass(frozen=True)
class Framing:
    """What the n x n tiles of an image show; n = 1 for a whole frame. Row 0 is at the top.

    Attributes:
        foreground: (n, n) float64, share of the tile that the shape covers.
        spread: (n, n) float64, degrees between the normals and their mean, `acos |mean normal|`; for small spreads
            their RMS angle to it. 0 for a facet or an empty tile, 48 for a sphere.
    """

    foreground: np.ndarray
    spread: np.ndarray


def measure(mesh: TriangleMesh, view: View, tiles: int = 1) -> Framing:
    """Measure how `view` frames `mesh`.

    Args:
        mesh: Object in the unit sphere.
        view: Pose, for the whole image.
        tiles: Tiles along each side of the image.
    """
    per_tile = CELLS if tiles == 1 else CELLS // 2
    face = rasterise(mesh, view, per_tile * tiles).reshape(tiles, per_tile, tiles, per_tile).swapaxes(1, 2)
    hit = face >= 0
    normals = mesh.normals[mesh.faces[face]].sum(-2) * hit[..., None]  # spread does not depend on the rotation
    normals = unit(normals)
    count = hit.sum((2, 3))
    mean = np.linalg.norm(normals.sum((2, 3)), axis=-1) / np.maximum(count, 1)
    spread = np.degrees(np.arccos(np.minimum(mean, 1))) * (count > 0)
    return Framing(foreground=count / per_tile**2, spread=spread)


def rasterise(mesh: TriangleMesh, view: View, cells: int) -> np.ndarray:  # (cells, cells) int64
    """Return the nearest face at the centre of every cell of the image, -1 where there is none; row 0 is at the top."""
    turned = mesh.vertices @ (view.matrix().T * view.scale)
    if view.camera_distance is not None:  # move the points to where a pinhole sees them
        seen = (turned[:, :2] + view.offset) / (1 - turned[:, 2:] / view.camera_distance) - view.offset
        turned = np.concatenate([seen, turned[:, 2:]], axis=1)
    # Cell coordinates: the centre of column i is at x = i, that of row j at y = j.
    x = (turned[:, 0] + view.offset[0] + 1) * (cells / 2) - 0.5
    y = (1 - turned[:, 1] - view.offset[1]) * (cells / 2) - 0.5
    corners = mesh.faces
    boxes = []
    for values in (x, y):
        a, b, c = values[corners[:, 0]], values[corners[:, 1]], values[corners[:, 2]]
        first = np.ceil(np.minimum(np.minimum(a, b), c)).clip(0, cells).astype(np.int64)
        last = np.floor(np.maximum(np.maximum(a, b), c)).clip(-1, cells - 1).astype(np.int64)
        boxes.append((first, last - first + 1))
    (left, width), (top, height) = boxes
    chosen = np.flatnonzero((width > 0) & (height > 0))  # most triangles lie between the centres
    nearest, depth = np.full(cells * cells, -1, np.int64), np.full(cells * cells, -np.inf)
    area = (width * height)[chosen]
    for part in np.split(chosen, np.flatnonzero(np.diff(np.cumsum(area) // _MOST_CELLS)) + 1):
        if len(part):
            box = (left[part], top[part], width[part], height[part])
            _fill(nearest, depth, (x, y, turned[:, 2]), corners[part], part, box, cells)
    return nearest.reshape(cells, cells)


def _fill(nearest: np.ndarray, depth: np.ndarray, place: tuple[np.ndarray, ...], corners: np.ndarray, faces: np.ndarray,
          box: tuple[np.ndarray, ...], cells: int) -> None:  # fmt: skip
    """Test the cells in the boxes of some triangles and keep the nearest hits."""
    left, top, width, height = box
    number = np.repeat(np.arange(len(faces)), width * height)
    within = np.arange(len(number)) - np.repeat(np.cumsum(width * height) - width * height, width * height)
    column, row = left[number] + within % width[number], top[number] + within // width[number]
    (ax, ay, az), (bx, by, bz), (cx, cy, cz) = (
        tuple(values[corners[:, k]].astype(np.float64)[number] for values in place) for k in range(3)
    )
    u = (bx - column) * (cy - row) - (cx - column) * (by - row)
    v = (cx - column) * (ay - row) - (ax - column) * (cy - row)
    w = (ax - column) * (by - row) - (bx - column) * (ay - row)
    total = u + v + w
    inside = (((u >= 0) & (v >= 0) & (w >= 0)) | ((u <= 0) & (v <= 0) & (w <= 0))) & (total != 0)
    z = (u * az + v * bz + w * cz)[inside] / total[inside]
    cell, face = (row * cells + column)[inside], faces[number[inside]]
    order = np.argsort(z, kind="stable")  # of several assignments to a cell, the last one stays
    cell, face, z = cell[order], face[order], z[order]
    front = np.full(cells * cells, -1, np.int64)
    front[cell] = np.arange(len(cell))
    hit = np.flatnonzero(front >= 0)
    hit = hit[z[front[hit]] > depth[hit]]
    nearest[hit], depth[hit] = face[front[hit]], z[front[hit]]


def tile_view(view: View, row: int, column: int, tiles: int) -> View:
    """Return the view whose frame is tile (row, column), row 0 at the top, of an image of tiles x tiles frames."""
    centre = ((2 * column + 1) / tiles - 1, 1 - (2 * row + 1) / tiles)
    x, y = (round((view.offset[axis] - centre[axis]) * tiles, 6) for axis in range(2))
    return replace(view, scale=round(view.scale * tiles, 6), offset=(x, y))
