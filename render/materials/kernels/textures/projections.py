"""How patterns of two coordinates and pictures are laid onto an object: from three sides, or by its UV."""

from collections.abc import Callable
from typing import Any

import numpy as np

from render.backend.arrays import opaque, table
from render.backend.jit import dr, mi
from render.materials.textures.map_folder import MapFolder
from render.shapes.geometry.mesh import TriangleMesh

_SHARPNESS = 8  # power of the normal's components, by which the three sides are blended
AXES = ((2, 1), (0, 2), (0, 1))  # coordinates seen along x, y and z: across, and up


def sides(normal: Any) -> list:
    """Return the shares, Float (N), of the projections along x, y and z at points with these normals."""
    weights = [dr.power(dr.abs(component), _SHARPNESS) for component in normal]
    total = dr.maximum(weights[0] + weights[1] + weights[2], 1e-9)
    return [weight / total for weight in weights]


def from_three_sides(normal: Any, laid: Callable[[int, int, int], list]) -> list:
    """Blend what is laid on along x, y and z; the shares count as constant in slopes.

    Args:
        normal: (N) unit normals, object frame.
        laid: From the number of the side and of its two coordinates to a list of arrays.
    """
    total: list = []
    for side, (weight, (u, v)) in enumerate(zip(sides(normal), AXES, strict=True)):
        values = [value * weight for value in laid(side, u, v)]
        total = [a + b for a, b in zip(total, values, strict=True)] if total else values
    return total


class Pictures:
    """The maps of a folder for gathers, with bilinear interpolation; they repeat.

    Args:
        maps: The folder.
    """

    def __init__(self, maps: MapFolder) -> None:
        height, width = maps.values.shape[:2]
        self.relief = maps.slopes is not None
        slopes = np.zeros((height, width, 0), np.float32) if maps.slopes is None else maps.slopes
        values = np.concatenate([maps.values, slopes], -1)
        self._channels = values.shape[-1]
        self._values = table(values)
        self._size = opaque(mi.Vector2u(width, height))
        self.aspect = opaque(mi.Float(width / height))

    def at(self, u: Any, v: Any) -> list:
        """Return colour (3), roughness, metallic and, where there is relief, both slopes at (u, v), v up."""
        x = (u - dr.floor(u)) * mi.Float(self._size.x) - 0.5
        y = (dr.floor(v) + 1 - v) * mi.Float(self._size.y) - 0.5
        left, top = dr.floor(x), dr.floor(y)
        a, b = x - left, y - top
        columns = [_wrap(mi.Int32(left) + k, self._size.x) for k in (0, 1)]
        rows = [_wrap(mi.Int32(top) + k, self._size.y) for k in (0, 1)]
        total: list = [mi.Float(0)] * self._channels
        for row, wy in zip(rows, (1 - b, b), strict=True):
            for column, wx in zip(columns, (1 - a, a), strict=True):
                first = (row * self._size.x + column) * self._channels
                total = [
                    dr.fma(wx * wy, dr.gather(mi.Float, self._values, first + c), value)
                    for c, value in enumerate(total)
                ]
        return total


class Unwrapped:
    """The texture coordinates of a mesh at points of its triangles, and the directions in which they grow.

    Args:
        mesh: With `uv`.
    """

    def __init__(self, mesh: TriangleMesh) -> None:
        assert mesh.uv is not None  # by the caller
        corners, uv = mesh.vertices[mesh.faces].astype(np.float64), mesh.uv.astype(np.float64)
        edges, changes = corners[:, 1:] - corners[:, :1], uv[:, 1:] - uv[:, :1]  # (F, 2, 3), (F, 2, 2)
        gram = edges @ edges.transpose(0, 2, 1)
        gram += 1e-12 * np.trace(gram, axis1=1, axis2=2)[:, None, None] * np.eye(2)
        gradients = np.linalg.solve(gram, changes).transpose(0, 2, 1) @ edges  # (F, 2, 3): of u and of v
        length = np.linalg.norm(gradients, axis=2, keepdims=True)
        directions = np.divide(gradients, length, out=np.zeros_like(gradients), where=length > 0)
        self._values = table(np.concatenate([uv.reshape(-1, 6), directions.reshape(-1, 6)], 1))

    def at(self, prim: Any, corner: Any) -> tuple:
        """Return u, v and the unit vectors (N) along which they grow, object frame."""
        values = [dr.gather(mi.Float, self._values, prim * 12 + k) for k in range(12)]
        shares = (1 - corner.x - corner.y, corner.x, corner.y)
        u, v = (sum((share * values[2 * k + c] for k, share in enumerate(shares)), mi.Float(0)) for c in (0, 1))
        return u, v, mi.Vector3f(*values[6:9]), mi.Vector3f(*values[9:])


def _wrap(index: Any, size: Any) -> Any:
    """Bring an index from -1 to `size` into the picture."""
    last = mi.Int32(size) - 1
    return mi.UInt32(dr.select(index < 0, last, dr.select(index > last, 0, index)))
