"""Folders of programs that make a surface of normal maps: BiNI, RNb-NeuS and SuperNormal."""

from pathlib import Path

import numpy as np

from render.shared.errors import InputError
from render.shared.files import atomic_path, write_text
from render.shared.images import quantise
from sdps.core.geometry import Camera
from sdps.surface.exports.map_files import write_picture, write_vectors
from sdps.surface.exports.normal_maps import ALICEVISION, CAMERA, code_normals
from sdps.surface.exports.saved_result import SavedResult

_ROOM = 1.1  # of the sphere around the object, over the sphere that just holds it


def write_bini(result: SavedResult, folder: Path) -> list[Path]:
    """Write normal_map.png (16 bits), mask.png, and K.txt of a perspective camera (Cao et al., ECCV 2022).

    BiNI's camera has its first axis up, from the last row, and its second to the right: K's first row is the vertical
    one. Without K.txt BiNI takes the camera for orthographic, so that an old one is removed.
    """
    made = [
        write_picture(folder / "normal_map.png", code_normals(result.normals, result.mask, CAMERA)),
        write_picture(folder / "mask.png", result.mask.astype(np.uint8) * 255),
    ]
    matrix = folder / "K.txt"
    if not result.camera.is_perspective:
        matrix.unlink(missing_ok=True)
        return made
    column, row = result.camera.middle(result.shape)
    write_text(matrix, _rows([[result.camera.focal, 0, result.shape[0] - 1 - row],
                              [0, result.camera.focal, column], [0, 0, 1]]))  # fmt: skip
    return [*made, matrix]


def write_rnb(result: SavedResult, folder: Path) -> list[Path]:
    """Write one view of RNb-NeuS (normal, albedo, mask, cameras.npz) and SuperNormal (normal_world and the same masks).

    The world is the camera's frame, x right, y down, z away, in `result.unit`; scale_mat_0 takes the unit sphere to one
    around the object. Views of several results share a world only if someone turns them into it.

    Raises:
        InputError: an orthographic camera, which these programs do not know.
    """
    camera = require_perspective(result)
    pictures = {"normal": code_normals(result.normals, result.mask, CAMERA),
                "mask": result.mask.astype(np.uint8) * 255}  # fmt: skip
    if result.albedo is not None:
        pictures["albedo"] = quantise(result.albedo / max(float(result.albedo.max()), 1e-9), 16)
    made = []
    for name, pixels in pictures.items():
        (folder / name).mkdir(exist_ok=True)
        made.append(write_picture(folder / name / "000.png", pixels))
    (folder / "normal_world").mkdir(exist_ok=True)
    world = result.normals * np.array(ALICEVISION.values, np.float32)
    made.append(write_vectors(folder / "normal_world" / "000.exr", world))
    column, row = camera.middle(result.shape)
    projection, sphere = np.eye(4), np.eye(4)
    projection[:2] = [[camera.focal, 0, column, 0], [0, camera.focal, row, 0]]
    sphere[:3, 3], radius = find_sphere(result)
    sphere[:3, :3] *= _ROOM * radius
    with atomic_path(folder / "cameras.npz") as temporary, temporary.open("wb") as handle:
        np.savez(handle, world_mat_0=projection, scale_mat_0=sphere)
    return [*made, folder / "cameras.npz"]


def find_sphere(result: SavedResult) -> tuple[np.ndarray, float]:
    """Return middle (3,) and radius of a sphere that holds the surface before a perspective camera, in `result.unit`.

    Frame: x right, y down, z away, the origin at the camera.
    """
    points = result.camera.positions(result.depth)[result.mask]
    points = (points - np.array([0.0, 0.0, result.camera.focal])) * np.array([1, -1, -1]) * result.unit_size
    middle = (points.min(0) + points.max(0)) / 2
    return middle, float(np.linalg.norm(points - middle, axis=1).max())


def require_perspective(result: SavedResult) -> Camera:
    """Return the camera of a result.

    Raises:
        InputError: it is orthographic.
    """
    if not result.camera.is_perspective:
        raise InputError(f"{result.folder}: the camera was taken for orthographic; run `sdps infer` again with --focal")
    return result.camera


def _rows(matrix: list[list[float]]) -> str:
    return "".join(" ".join(f"{value:.12g}" for value in row) + "\n" for row in matrix)
