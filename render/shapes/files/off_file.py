"""Reading OFF, whose concave faces trimesh fills beyond their outline."""

import re

import numpy as np

from render.shapes.files.corners import Corners, of_polygons
from render.shared.errors import InputError

_HEADER = re.compile(r"\s*(ST)?(C)?(N)?(4)?(n)?OFF\b")


def read(data: bytes) -> Corners:
    """Read a text OFF file (also COFF, NOFF, STOFF); colours are left out.

    Raises:
        InputError: another header, binary or higher-dimensional content, or fewer rows than it announces.
    """
    text = re.sub(r"#[^\n]*", "", data.decode("utf-8-sig", errors="replace").replace("\r", "\n"))
    header = _HEADER.match(text)
    if header is None:
        raise InputError("damaged or not a mesh: an OFF file begins with OFF; export it again")
    if header[4] or header[5] or text[header.end() :].lstrip().startswith("BINARY"):
        raise InputError("is an OFF file of another kind than text in three dimensions; export it as OBJ or PLY")
    rows = [row.split() for row in text[header.end() :].split("\n") if row.strip()]
    try:
        vertex_count, face_count = int(rows[0][0]), int(rows[0][1])
        points, polygons = rows[1 : 1 + vertex_count], rows[1 + vertex_count : 1 + vertex_count + face_count]
        if len(points) < vertex_count or len(polygons) < face_count:
            raise InputError(f"is cut short: announces {vertex_count} vertices and {face_count} faces; copy it again")
        vertices = np.array([row[:3] for row in points], np.float64).reshape(-1, 3)
        counts = np.array([int(row[0]) for row in polygons], np.int64)
        index = np.array([int(place) for row in polygons for place in row[1 : 1 + int(row[0])]], np.int64)
        normals = np.array([row[3:6] for row in points], np.float64) if header[3] else None
        if min(vertex_count, face_count, *counts) < 0 or len(index) != counts.sum():
            raise ValueError("a face has fewer corners than it announces")
    except (ValueError, IndexError) as error:
        raise InputError(f"damaged or not a mesh ({error}); export it again") from error
    fitting = normals is not None and normals.shape == vertices.shape
    found = of_polygons(vertices, index, counts)
    return Corners(found.vertices, found.faces, None, normals[found.faces] if fitting and normals is not None else None)
