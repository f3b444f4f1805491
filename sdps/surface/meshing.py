"""A depth map as a triangle mesh, and mesh files.

Legend: (H, W) image sides, v vertices (one per used pixel), f triangles.
"""

from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from trimesh.visual.color import ColorVisuals

from render.shared.errors import InputError, unknown
from render.shared.files import atomic_path
from sdps.core.geometry import ORTHOGRAPHIC, Camera
from sdps.core.integration import Depth
from sdps.photos.response import to_linear

FORMATS = (".ply", ".obj", ".glb")

MOST_VERTICES = 1_000_000
"""Of the meshes in files. A vertex takes about 700 bytes while they are written, and 200 in the file."""

_MATT = {
    "name": "matt",
    "pbrMetallicRoughness": {"baseColorFactor": [1.0] * 4, "metallicFactor": 0.0, "roughnessFactor": 1.0},
}
_COLOURS = "_COLOURS"  # trimesh writes attributes of our own in their own type, but COLOR_0 in 8 bits


def unit_scale(shape: tuple[int, int]) -> float:
    """Return the length of a pixel in half widths of the image, the longer side of (H, W) being 2."""
    return 2.0 / max(shape)


def step_of(mask: np.ndarray) -> int:
    """Return every how manyth pixel is a vertex of the object's files, so that they have at most a million."""
    return max(1, int(np.ceil(np.sqrt(int(mask.sum()) / MOST_VERTICES))))


def mesh(
    depth: Depth | np.ndarray,
    mask: np.ndarray | None = None,
    *,
    camera: Camera | None = None,
    millimetres: float | None = None,
    colour: np.ndarray | None = None,
    normals: np.ndarray | None = None,
    steepest: float | None = None,
    every: int = 1,
) -> trimesh.Trimesh:
    """Triangulate the masked pixels: a vertex at each pixel's centre, two triangles between four, one between three.

    The frame is the camera's, x right, y up, z to the camera, with the origin at the principal point (the image's
    centre) at depth 0; the longer image side is 2 long there, or as long as `millimetres` says. Triangles face the
    camera (anticlockwise when seen from it). Of a square's two diagonals the one across the smaller step is taken.
    Pixels that are part of no triangle (lines one pixel wide) get no vertex.

    Args:
        depth: Of `integrate`, or (H, W) z in pixels towards the camera.
        mask: (H, W) bool; that of `depth` if not given.
        camera: The camera that saw it; that of `depth` if not given, and orthographic for an array.
        millimetres: Millimetres per pixel at depth 0: the mesh is in millimetres.
        colour: (H, W, 3) uint8, sRGB colours of the vertices.
        normals: (H, W, 3), normals of the vertices, not those of the triangles around them.
        steepest: Leave out triangles with an edge that rises by more pixels than this per pixel, such as walls across
            discontinuities; None keeps all.
        every: Take every so manyth pixel of every so manyth row alone (`step_of`).

    Raises:
        InputError: sizes or types that do not fit, depth that is not finite, or no triangle.
    """
    camera = camera or (depth.camera if isinstance(depth, Depth) else ORTHOGRAPHIC)
    z, mask = _check(depth, mask, colour, normals)
    shape, few = mask.shape, (slice(None, None, every),) * 2
    z, mask = z[few] / np.float32(every), mask[few]
    faces = _triangles(z, _number(mask))
    rows, columns = np.nonzero(mask)
    if steepest is not None:
        faces = _no_walls(faces, np.stack([columns, rows, z[mask]], axis=-1).astype(np.float64), steepest)
    if not len(faces):
        raise InputError("no three neighbouring mask pixels make a triangle; mark a larger object, or raise steepest")
    used, faces = np.unique(faces, return_inverse=True)
    rows, columns = rows[used], columns[used]
    places = camera.place(shape, every * rows, every * columns, every * z[rows, columns])
    return trimesh.Trimesh(
        vertices=places * (millimetres or unit_scale(shape)), faces=faces.reshape(-1, 3),
        vertex_normals=None if normals is None else np.asarray(normals[few][rows, columns], np.float64),
        vertex_colors=None if colour is None else colour[few][rows, columns], process=False,
    )  # fmt: skip


def _number(mask: np.ndarray) -> np.ndarray:  # (H, W) int64
    """Return the numbers of a mask's pixels, -1 outside."""
    index = np.full(mask.shape, -1, np.int64)
    index[mask] = np.arange(mask.sum())
    return index


def _no_walls(faces: np.ndarray, corners: np.ndarray, steepest: float) -> np.ndarray:
    """Return the triangles (f, 3) without an edge that is steeper; corners (v, 3) in pixels."""
    found = corners[faces]  # (f, 3, 3)
    edges = found - np.roll(found, 1, axis=1)
    return faces[(np.abs(edges[..., 2]) <= steepest * np.linalg.norm(edges[..., :2], axis=-1)).all(axis=1)]


def write_mesh(surface: trimesh.Trimesh, path: str | Path) -> None:
    """Write a mesh with its normals and colours, whole or not at all, as .ply (binary), .obj or .glb.

    A .glb has a matt material and linear colours of 16 bits, as glTF 2.0 (3.7.2.1) wants them; in the others they stay
    sRGB's of 8 bits.

    Raises:
        InputError: another suffix, or a disk that refuses the file.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    if suffix not in FORMATS:
        raise unknown("mesh format", suffix, FORMATS)
    options: dict[str, dict[str, Any]] = {
        ".ply": {"vertex_normal": True},
        ".obj": {"include_normals": True, "include_color": True},
        ".glb": {"include_normals": True, "tree_postprocessor": _matt},
    }
    written = _linear(surface) if suffix == ".glb" else surface
    data: Any = written.export(file_type=suffix[1:], **options[suffix])
    with atomic_path(path) as temporary:
        temporary.write_bytes(data.encode() if isinstance(data, str) else data)


def _linear(surface: trimesh.Trimesh) -> trimesh.Trimesh:
    """Return the mesh with its colours as an attribute of linear 16-bit RGBA."""
    colours: dict[str, Any] = {}
    if isinstance(surface.visual, ColorVisuals) and surface.visual.kind == "vertex":
        rgb = np.rint(to_linear(surface.visual.vertex_colors[:, :3], "srgb") * 65535)
        colours[_COLOURS] = np.pad(rgb, ((0, 0), (0, 1)), constant_values=65535).astype(np.uint16)  # (v, 4)
    return trimesh.Trimesh(
        vertices=surface.vertices, faces=surface.faces, vertex_normals=surface.vertex_normals,
        vertex_attributes=colours, process=False,
    )  # fmt: skip


def _matt(tree: dict[str, Any]) -> None:
    """Give the mesh of a glTF tree its material, and its colours their name."""
    tree["materials"] = [_MATT]
    for part in tree["meshes"][0]["primitives"]:
        part["material"] = 0
        place = part["attributes"].pop(_COLOURS, None)
        if place is not None:
            part["attributes"]["COLOR_0"] = place
            tree["accessors"][place]["normalized"] = True


def _check(
    depth: Depth | np.ndarray, mask: np.ndarray | None, colour: np.ndarray | None, normals: np.ndarray | None
) -> tuple[np.ndarray, np.ndarray]:
    """Return z (H, W) and the mask, or refuse the arguments of `mesh`."""
    if isinstance(depth, Depth):
        z, mask = depth.z, depth.mask if mask is None else mask
    elif mask is None:
        raise InputError("a depth array needs a mask as well")
    else:
        z = np.asarray(depth)
    if mask.dtype != np.bool_ or z.shape != mask.shape or z.ndim != 2:
        raise InputError(
            f"depth and mask must be (H, W) and the mask bool, got {z.shape} and {mask.dtype} {mask.shape}"
        )
    for name, array in (("colour", colour), ("normals", normals)):
        if array is not None and array.shape != (*mask.shape, 3):
            raise InputError(f"{name} must be {(*mask.shape, 3)} like the mask, got {array.shape}")
    if colour is not None and colour.dtype != np.uint8:
        raise InputError(f"colour must be uint8, got {colour.dtype}; scale it to 0 to 255")
    if not np.isfinite(z[mask]).all():
        raise InputError("depth is NaN or infinite inside the mask; take these pixels out of it")
    return z, mask


def _triangles(z: np.ndarray, index: np.ndarray) -> np.ndarray:  # (f, 3) int64
    """Return the triangles of pixels `index` (H, W), -1 outside the mask, anticlockwise seen from the camera."""
    corners = np.stack([index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]])  # from top left, anticlockwise
    heights = np.stack([z[:-1, :-1], z[1:, :-1], z[1:, 1:], z[:-1, 1:]])
    there = corners >= 0
    falling = np.abs(heights[0] - heights[2]) <= np.abs(heights[1] - heights[3])  # diagonal from top left
    whole = there.all(axis=0)
    parts = [
        corners[list(triangle)][:, chosen].T
        for triangle, chosen in (
            ((0, 1, 2), whole & falling),
            ((0, 2, 3), whole & falling),
            ((0, 1, 3), whole & ~falling),
            ((1, 2, 3), whole & ~falling),
        )
    ]
    for missing in range(4):
        rest = [corner for corner in range(4) if corner != missing]
        parts.append(corners[rest][:, ~there[missing] & there[rest].all(axis=0)].T)
    return np.concatenate(parts)
