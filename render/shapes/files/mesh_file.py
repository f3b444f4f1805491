"""Reading meshes from files: as placed in them, welded, wound outside out, with their edges."""

import gzip
import io
import logging
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np
import trimesh

from render.shapes.files import gltf_file, obj_file, off_file, ply_file, stl_file
from render.shapes.files.corners import Corners
from render.shapes.geometry import creases
from render.shapes.geometry.mesh import TriangleMesh, with_area, without_unused
from render.shapes.geometry.windings import outward
from render.shared.decoding import decoding, largest_unpacked
from render.shared.errors import InputError

_GRID_BITS = 20  # positions on the same point of a grid of 2^20 steps over the mesh are one vertex
_FARTHEST = 10  # extents from the origin, beyond which float32 would coarsen the shape
_SIZES = (1e-12, 1e12)  # extents between which float32 arithmetic is exact enough
_READERS = {"obj": obj_file.read, "off": off_file.read, "ply": ply_file.read}  # the last only where it has to
_DOUBLE_SIDED = 0.9  # share of triangles with a copy that is wound the other way


def load_mesh(path: str | Path) -> TriangleMesh:
    """Read any mesh or scene file that trimesh reads, as placed in the file.

    The parts of a scene are concatenated; see `from_trimesh`. Normals of the file are used where they fit its
    triangles, see `creases.shaded`.

    Args:
        path: OBJ, PLY, STL, glTF, GLB, OFF, ..., also compressed by gzip.

    Raises:
        InputError: missing file, unreadable format, damaged content, no triangles, or non-finite positions.
    """
    path = Path(path)
    if not path.is_file():
        raise InputError(f"{path}: no such mesh file")
    try:
        with decoding(path, "a mesh", "export it again"), _quiet():
            return _mesh(_read(path))
    except InputError as error:
        message = str(error)
        if message.startswith(str(path)):
            raise
        raise InputError(f"{path}: {message}") from error


def from_trimesh(mesh: trimesh.Trimesh, name: str = "mesh") -> TriangleMesh:
    """Return the triangles of a mesh as placed, with creases where they meet at more than `creases.CREASE` degrees.

    Equal positions are welded, so that texture seams and the facets of STL do not show. Triangles without area and
    duplicates are left out, those wound against their neighbours are turned, and a closed surface is turned outside
    out. A mesh whose shape float32 could not hold, very far from the origin for its size or of an extreme size, is
    moved to the origin or scaled.

    Args:
        mesh: Is not changed; only its vertices, faces and texture coordinates are used.
        name: What messages call it.

    Raises:
        InputError: no triangles, or non-finite positions.
    """
    faces = np.asarray(mesh.faces, np.int64)
    try:
        return _mesh(Corners(np.asarray(mesh.vertices, np.float64), faces, _corner_uv(mesh)))
    except InputError as error:
        raise InputError(f"{name}: {error}") from error


@contextmanager
def _quiet() -> Iterator[None]:
    """Silence trimesh and numpy: a file is either used, or refused in one line of ours."""
    log = logging.getLogger("trimesh")
    was = log.level
    log.setLevel(logging.CRITICAL)
    try:
        with warnings.catch_warnings(), np.errstate(all="ignore"):
            warnings.simplefilter("ignore")
            yield
    finally:
        log.setLevel(was)


class _Neighbours(trimesh.resolvers.FilePathResolver):
    """Also finds files next to a mesh whose names are escaped as in addresses: `my%20mesh.bin`."""

    def get(self, name: str) -> bytes:
        """Return a file's content."""
        try:
            return super().get(name)
        except FileNotFoundError:
            return super().get(unquote(name))


def _read(path: Path) -> Corners:
    """Read a mesh file; one compressed by gzip, such as `bunny.ply.gz`, is unpacked in memory."""
    packed = path.suffix.lower() == ".gz"
    kind = Path(path.stem if packed else path.name).suffix[1:].lower()
    if kind not in trimesh.available_formats():
        named = f"a .{kind} file" if kind else "a file without an ending such as .glb"
        raise InputError(f"is {named}, which is not read; export it as .glb, .obj, .ply or .stl")
    if packed:
        with gzip.open(path) as file:
            data = file.read(largest_unpacked(path) + 1)
        if len(data) > largest_unpacked(path):
            raise InputError("unpacks to more than a file of this size can hold; unpack it by hand")
    else:
        data = path.read_bytes()
    if kind in ("gltf", "glb"):
        gltf_file.check(data, None if packed else path.parent)
    elif kind == "stl":
        data = stl_file.check(data)
    found = _READERS[kind](data) if kind in _READERS else None
    if found is not None:
        return found
    resolver = None if packed else _Neighbours(str(path))
    scene = trimesh.load_scene(io.BytesIO(data), file_type=kind, process=False, resolver=resolver)
    return _join([_corners(part) for part in _place(scene)])


def _place(scene: Any) -> Iterator[trimesh.Trimesh]:
    """Yield the meshes of a scene where it places them, with their normals."""
    for node in scene.graph.nodes_geometry:
        transform, name = scene.graph[node]
        part = scene.geometry[name]
        # trimesh keeps the normals of the file in its cache
        if isinstance(part, trimesh.Trimesh) and len(part.faces):
            yield part.copy(include_cache=True).apply_transform(transform)


def _corners(part: trimesh.Trimesh) -> Corners:
    """Return the triangles of a part of a file, or refuse them."""
    vertices, faces = np.asarray(part.vertices), np.asarray(part.faces, np.int64)
    if vertices.ndim != 2 or vertices.shape[1] != 3 or faces.ndim != 2 or faces.shape[1] != 3:
        raise InputError("vertices and faces must have three columns; repair the file")
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise InputError("a face names a vertex that the file does not hold; repair the file")
    normals = part._cache["vertex_normals"]
    fitting = normals is not None and np.shape(normals) == vertices.shape
    return Corners(vertices, faces, _corner_uv(part), np.asarray(normals)[faces] if fitting else None)


def _corner_uv(mesh: trimesh.Trimesh) -> np.ndarray | None:
    """Return the texture coordinates of the corners (F, 3, 2) of a mesh that has them."""
    uv = getattr(mesh.visual, "uv", None)
    if uv is None or len(uv) != len(mesh.vertices) or not np.isfinite(uv).all():
        return None
    return np.asarray(uv, np.float64)[:, :2][np.asarray(mesh.faces)]


def _join(parts: list[Corners]) -> Corners:
    """Return parts as one: texture coordinates only when all have them, normals where there are any."""
    if not parts:
        return Corners(np.empty((0, 3)), np.empty((0, 3), np.int64))
    first = np.cumsum([0, *(len(part.vertices) for part in parts)])
    uv = [part.uv for part in parts if part.uv is not None]
    normals = None
    if any(part.normals is not None for part in parts):
        blanks = [np.full((*part.faces.shape, 3), np.nan) if part.normals is None else part.normals for part in parts]
        normals = np.concatenate(blanks)
    return Corners(
        np.concatenate([part.vertices for part in parts]),
        np.concatenate([part.faces + start for part, start in zip(parts, first[:-1], strict=True)]),
        np.concatenate(uv) if len(uv) == len(parts) else None,
        normals,
    )


def _mesh(found: Corners) -> TriangleMesh:
    """Weld, clean, wind and shade triangles."""
    if not len(found.faces):
        raise InputError("contains no triangles; export it as a surface mesh")
    vertices, faces = without_unused(found.vertices, found.faces)
    if not np.isfinite(vertices).all():
        count = int((~np.isfinite(vertices)).any(1).sum())
        raise InputError(f"{count} of {len(vertices)} vertices are not finite; repair the file")
    merged, faces = _weld(_fit_float32(vertices), faces)
    kept = with_area(merged, faces)
    kept &= _mark_first_copies(faces, kept)
    if not kept.any():
        raise InputError(f"all of its {len(faces)} triangles are degenerate: they have no area")
    merged, faces = without_unused(merged, faces[kept])
    wound = outward(merged, faces)
    moved = (wound[:, :, None] == faces[:, None, :]).argmax(2)[..., None]  # winding the other way moves corners
    uv = None if found.uv is None else np.take_along_axis(found.uv[kept], moved, axis=1)
    given = None if found.normals is None else np.take_along_axis(found.normals[kept], moved, axis=1)
    points, split, normals = creases.shade(merged, wound, given)
    return TriangleMesh(vertices=points, faces=split, normals=normals, uv=uv)


def _fit_float32(vertices: np.ndarray) -> np.ndarray:
    """Move and scale positions (V, 3) float64 so that float32 holds their shape, if it does not as they are."""
    biggest = np.abs(vertices).max()
    if not biggest > 0:
        return vertices
    scaled = vertices / biggest  # of which no difference overflows
    low, high = scaled.min(axis=0), scaled.max(axis=0)
    extent = float((high - low).max())
    if not extent > 0:
        return vertices
    if not _SIZES[0] < extent * biggest < _SIZES[1]:
        return (scaled - (low + high) / 2) / extent
    if np.abs(low + high).max() / 2 > _FARTHEST * extent:
        return (scaled - (low + high) / 2) * biggest
    return vertices


def _weld(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Merge positions that agree to a millionth of the extent; the first of them in the file stays."""
    low = vertices.min(axis=0)
    extent = float((vertices.max(axis=0) - low).max()) or 1.0
    steps = np.rint((vertices - low) / extent * (1 << _GRID_BITS)).astype(np.int64)
    key = (((steps[:, 0] << _GRID_BITS + 1) | steps[:, 1]) << _GRID_BITS + 1) | steps[:, 2]
    _, first, which = np.unique(key, return_index=True, return_inverse=True)
    order = np.argsort(first)
    place = np.empty_like(order)
    place[order] = np.arange(len(order))
    return vertices[first[order]], place[which][faces]


def _mark_first_copies(faces: np.ndarray, among: np.ndarray) -> np.ndarray:  # (F,) bool
    """Mark the triangles that are the first with their corners and winding; in a double-sided mesh, their corners."""
    turned = np.take_along_axis(faces, (faces.argmin(1)[:, None] + np.arange(3)) % 3, axis=1)
    side = turned[:, 1] > turned[:, 2]
    turned[:, 1:].sort(axis=1)
    order = np.lexsort((side, turned[:, 2], turned[:, 1], turned[:, 0], ~among))  # stable: the first in the file leads
    ordered = turned[order]
    same = np.concatenate([[False], (ordered[1:] == ordered[:-1]).all(1)])
    both = same & np.concatenate([[False], side[order][1:] != side[order][:-1]])
    first = np.empty(len(faces), bool)
    first[order] = ~same | both
    if 2 * (both & among[order]).sum() < _DOUBLE_SIDED * (first & among).sum():
        return first
    _, leader = np.unique(np.cumsum(~same), return_inverse=True)
    earliest = np.full(leader.max() + 1, len(faces))
    np.minimum.at(earliest, leader, order)
    kept = np.zeros(len(faces), bool)
    kept[earliest] = True
    return kept
