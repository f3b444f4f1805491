"""What the readers of mesh files return: triangles, and what the file says about their corners."""

from dataclasses import dataclass

import numpy as np

from render.shapes.files.polygons import triangulate
from render.shared.errors import InputError


@dataclass(frozen=True)
class Corners:
    """Triangles with what the file says about their corners.

    Attributes:
        vertices: (V, 3) float64.
        faces: (F, 3) int64.
        uv: (F, 3, 2) float64, v up; None if any face has none.
        normals: (F, 3, 3) float64, NaN at corners that have none; None if the file has none.
    """

    vertices: np.ndarray
    faces: np.ndarray
    uv: np.ndarray | None = None
    normals: np.ndarray | None = None


def of_polygons(
    vertices: np.ndarray,
    index: np.ndarray,
    counts: np.ndarray,
    uv: np.ndarray | None = None,
    normals: np.ndarray | None = None,
) -> Corners:
    """Cut polygons into triangles.

    Args:
        vertices: (V, 3).
        index: (N,) vertices of the corners of all polygons, one polygon after the other.
        counts: (P,) corners of each polygon.
        uv: (N, 2) of the corners, None for none.
        normals: (N, 3) of the corners, None for none.

    Raises:
        InputError: an index out of range.
    """
    index = np.asarray(index, np.int64)
    bad = (index < 0) | (index >= len(vertices))
    if bad.any():
        raise InputError(
            f"a face names vertex {index[bad][0]}, but the file holds 0 to {len(vertices) - 1}; repair the file"
        )
    places = triangulate(vertices[index], counts)
    return Corners(
        vertices, index[places], None if uv is None else uv[places], None if normals is None else normals[places]
    )
