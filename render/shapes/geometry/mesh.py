"""The one mesh type of the renderer, and the geometry of triangles."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from render.records.manifest import View
from render.shared.errors import InputError
from render.shared.imaging.vectors import spiral

_BLOCK = 1 << 20  # points looked at together


@dataclass(frozen=True, kw_only=True)
class TriangleMesh:
    """A triangle mesh with one normal per vertex; x right, y up, z to the camera.

    Normals are interpolated over triangles. At a crease a vertex stands twice, with a normal for either side.

    Attributes:
        vertices: Positions, (V, 3) float32.
        faces: Vertex indices, counter-clockwise seen from outside, (F, 3) uint32.
        normals: Unit outward normals, (V, 3) float32.
        uv: Texture coordinates of the corners of each face, (F, 3, 2) float32, v up; None for a mesh without.
        objects: Number of the object that each face belongs to, (F,) uint32, from 0; None for a single object.

    Raises:
        InputError: at construction: wrong shapes, no faces, non-finite values, an index out of range,
            or normals that are not of unit length.
    """

    vertices: np.ndarray
    faces: np.ndarray
    normals: np.ndarray
    uv: np.ndarray | None = None
    objects: np.ndarray | None = None

    def __post_init__(self) -> None:
        for name, dtype in (("vertices", np.float32), ("normals", np.float32)):
            array = np.ascontiguousarray(getattr(self, name), dtype=dtype)
            if array.ndim != 2 or array.shape[1] != 3:
                raise InputError(f"mesh {name}: expected shape (V, 3), got {array.shape}")
            if not np.isfinite(array).all():
                raise InputError(f"mesh {name}: {int((~np.isfinite(array)).any(axis=1).sum())} rows are not finite")
            object.__setattr__(self, name, array)
        faces = np.asarray(self.faces)
        if faces.ndim != 2 or faces.shape[1] != 3 or not len(faces):
            raise InputError(f"mesh faces: expected at least one triangle as (F, 3), got {faces.shape}")
        if not np.issubdtype(faces.dtype, np.integer):
            raise InputError(f"mesh faces: expected integer indices, got {faces.dtype}")
        if faces.min() < 0 or faces.max() >= len(self.vertices):
            raise InputError(
                f"mesh faces: index {faces.min() if faces.min() < 0 else faces.max()} is out of range "
                f"for {len(self.vertices)} vertices"
            )
        object.__setattr__(self, "faces", np.ascontiguousarray(faces, dtype=np.uint32))
        if len(self.normals) != len(self.vertices):
            raise InputError(f"mesh normals: {len(self.normals)} for {len(self.vertices)} vertices")
        if np.abs(np.linalg.norm(self.normals, axis=1) - 1).max() > 1e-3:
            raise InputError("mesh normals: not of unit length")
        if self.uv is not None:
            uv = np.ascontiguousarray(self.uv, dtype=np.float32)
            if uv.shape != (len(faces), 3, 2) or not np.isfinite(uv).all():
                raise InputError(f"mesh uv: expected finite values of shape ({len(faces)}, 3, 2), got {uv.shape}")
            object.__setattr__(self, "uv", uv)
        if self.objects is not None:
            objects = np.ascontiguousarray(self.objects, dtype=np.uint32)
            if objects.shape != (len(faces),):
                raise InputError(f"mesh objects: expected a number for each of {len(faces)} faces, got {objects.shape}")
            object.__setattr__(self, "objects", objects)

    def normalise(self) -> "TriangleMesh":
        """Centre the mesh on its bounding sphere and scale it so that the farthest vertex is at radius 1."""
        centred = self.vertices - bounding_centre(self.vertices)
        radius = np.linalg.norm(centred, axis=1).max()
        if not radius > 0:
            raise InputError("mesh vertices: all at one point")
        return replace(self, vertices=centred / radius)

    def rotate(self, rotation: np.ndarray) -> "TriangleMesh":
        """Apply the rotation matrix `rotation` (3, 3), acting on column vectors, to positions and normals."""
        rotation = np.asarray(rotation, dtype=np.float64)
        if rotation.shape != (3, 3) or np.abs(rotation @ rotation.T - np.eye(3)).max() > 1e-4:
            raise InputError("rotation: expected an orthonormal (3, 3) matrix")
        if np.linalg.det(rotation) < 0:
            raise InputError("rotation: it mirrors (determinant -1), which turns the surface inside out")
        turn = rotation.T.astype(np.float32)
        return replace(self, vertices=self.vertices @ turn, normals=unit(self.normals @ turn))

    def pose(self, view: View) -> "TriangleMesh":
        """Rotate, scale and move the mesh into the camera frame (units: half image widths)."""
        turned = self.rotate(view.matrix())
        return replace(turned, vertices=turned.vertices * view.scale + np.array([*view.offset, 0.0]))


def join(meshes: Sequence[TriangleMesh]) -> TriangleMesh:
    """Return meshes as one, in which each is an object of its own; texture coordinates are left out."""
    first = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes)])
    faces = [mesh.faces.astype(np.int64) + start for mesh, start in zip(meshes, first[:-1], strict=True)]
    return TriangleMesh(
        vertices=np.concatenate([mesh.vertices for mesh in meshes]),
        faces=np.concatenate(faces),
        normals=np.concatenate([mesh.normals for mesh in meshes]),
        objects=np.repeat(np.arange(len(meshes)), [len(mesh.faces) for mesh in meshes]),
    )


def unit(vectors: np.ndarray) -> np.ndarray:
    """Scale row vectors (N, 3) to unit length; a zero vector stays zero."""
    length = np.linalg.norm(vectors, axis=1, keepdims=True)
    return vectors / np.where(length > 0, length, 1)


def bounding_centre(points: np.ndarray) -> np.ndarray:
    """Approximate the centre of the smallest sphere around `points` (N, 3).

    Badoiu and Clarkson (2003): step towards the farthest point by 1/(i + 1) of its distance, and keep the best
    centre met. Run on the extreme points along a fixed spiral of directions, which decide the sphere.
    """
    count = 128
    directions = spiral(count)
    highest, found = np.full(count, -np.inf, np.float32), np.zeros(count, np.int64)
    for start in range(0, len(points), _BLOCK):  # all heights at once are 2.5 GB for a mesh of ten million triangles
        heights = directions.astype(np.float32) @ points[start : start + _BLOCK].astype(np.float32).T  # (128, block)
        block = heights.argmax(axis=1)
        higher = heights[np.arange(count), block] > highest
        highest[higher], found[higher] = heights.max(axis=1)[higher], block[higher] + start
    extremes = points[np.unique(found)].astype(np.float64)
    centre = (extremes.min(axis=0) + extremes.max(axis=0)) / 2
    best, least = centre, np.inf
    for step in range(1, 200):
        offsets = extremes - centre
        squared = (offsets**2).sum(axis=1)
        farthest = squared.argmax()
        if squared[farthest] < least:
            best, least = centre, squared[farthest]
        centre = centre + offsets[farthest] / (step + 1)
    return best.astype(np.float32)


def face_normals(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Return cross products of the triangles' edges, (F, 3): the normal times twice the area."""
    a, b, c = (vertices[faces[:, corner]] for corner in range(3))
    return np.cross(b - a, c - a)


def vertex_normals(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Return area-weighted unit vertex normals, (V, 3) float32.

    Where the weighted sum cancels (a fin of two opposite faces), the normal of one adjacent face stands in.
    """
    vertices = np.asarray(vertices, dtype=np.float64)
    crosses = face_normals(vertices, faces)
    normals = np.stack(
        [
            sum(np.bincount(faces[:, corner], crosses[:, axis], len(vertices)) for corner in range(3))
            for axis in range(3)
        ],
        axis=1,
    )
    scale = np.zeros(len(vertices))
    np.maximum.at(scale, faces.ravel(), np.repeat(np.linalg.norm(crosses, axis=1), 3))
    lost = np.flatnonzero(np.linalg.norm(normals, axis=1) <= 1e-9 * scale)
    if len(lost):
        fallback = np.zeros_like(normals)
        fallback[faces.ravel()] = np.repeat(crosses, 3, axis=0)
        normals[lost] = fallback[lost]
    return unit(normals).astype(np.float32)


def with_area(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:  # (F,) bool
    """Return which triangles have an area."""
    distinct = (faces != np.roll(faces, 1, axis=1)).all(axis=1)
    return distinct & (np.linalg.norm(face_normals(vertices.astype(np.float64), faces), axis=1) > 0)


def without_unused(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Drop vertices that no triangle uses; returns (vertices, faces)."""
    used = np.zeros(len(vertices), dtype=bool)
    used[faces] = True
    return vertices[used], (np.cumsum(used) - 1)[faces]
