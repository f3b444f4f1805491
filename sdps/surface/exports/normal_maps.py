"""Normal maps by the name of who wants them: a 16-bit PNG and a floating-point EXR, axes and background as theirs.

The background follows the programs. Where a map lies on a surface (Blender, glTF, Unreal) the outside is flat,
(0.5, 0.5, 1); Meshroom's plug-ins and BiNI take the zero vector, (0.5, 0.5, 0.5), for outside. In the EXR it is zero.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from render.shared.files import write_json
from render.shared.images import quantise
from sdps.core.metrics import angle_degrees
from sdps.inference.tiles import split_rows
from sdps.surface.exports.map_files import write_picture, write_vectors
from sdps.surface.exports.saved_result import SavedResult

_FLAT, _NOTHING = (0.0, 0.0, 1.0), (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class Convention:
    """What a program takes for a normal map.

    Attributes:
        who: Whose it is.
        picture: Signs of x, y, z in the PNG.
        values: Signs of x, y, z in the EXR.
        background: The normal that the PNG has outside the mask.
        tangent: The map lies on a surface: where it fills the picture, its mean plane is to face the viewer.
    """

    who: str
    picture: tuple[int, int, int]
    values: tuple[int, int, int]
    background: tuple[float, float, float]
    tangent: bool = False


OPENGL = Convention("Blender, Substance, Houdini, glTF, RelightLab", (1, 1, 1), (1, 1, 1), _FLAT, tangent=True)
CAMERA = Convention("your own code (x right, y up, z to the camera)", (1, 1, 1), (1, 1, 1), _NOTHING)
ALICEVISION = Convention("AliceVision, Meshroom", (1, 1, 1), (1, -1, -1), _NOTHING)
CONVENTIONS = {
    "opengl": OPENGL,
    "directx": Convention("Unreal", (1, -1, 1), (1, -1, 1), _FLAT, tangent=True),
    "camera": CAMERA,
    "alicevision": ALICEVISION,
}
"""Axes here: x right, y up, z to the camera. AliceVision's are x right, y down, z away."""


def write_normals(convention: str, result: SavedResult, folder: Path) -> list[Path]:
    """Write normal.png, normal.exr, and normal.json, which names the axes and tells how well the map tiles.

    Args:
        convention: A name of `CONVENTIONS`.
        result: The result.
        folder: Where to.
    """
    wanted = CONVENTIONS[convention]
    normals, about = result.normals, folder / "normal.json"
    facts: dict[str, Any] = {"convention": convention, "who": wanted.who, "axes_png": name_axes(wanted.picture),
                             "axes_exr": name_axes(wanted.values)}  # fmt: skip
    if result.mask.all():
        facts["edges_differ_degrees"] = measure_edges(normals)
        if wanted.tangent:
            normals, facts["turned_degrees"] = face_viewer(normals)
    made = [
        write_picture(folder / "normal.png", code_normals(normals, result.mask, wanted)),
        write_vectors(folder / "normal.exr", normals * np.array(wanted.values, np.float32)),
    ]
    write_json(about, facts)
    return [*made, about]


def code_normals(normals: np.ndarray, mask: np.ndarray, convention: Convention) -> np.ndarray:  # (H, W, 3) uint16
    """Return normals (H, W, 3) as colours of 16 bits, round((n + 1) / 2 x 65535)."""
    coded = np.empty(normals.shape, np.uint16)
    for rows in split_rows(coded.shape):
        shown = normals[rows] * np.array(convention.picture, np.float64)
        shown = np.where(mask[rows][..., None], shown, np.array(convention.background))
        coded[rows] = quantise((shown + 1.0) / 2.0, 16)
    return coded


def face_viewer(normals: np.ndarray) -> tuple[np.ndarray, float]:
    """Turn normals (H, W, 3) that fill the picture by the least rotation after which their plane faces the viewer.

    The plane is the mean of the slopes: that of the surface, whose steep parts count by their area in the picture.

    Returns:
        (H, W, 3) float32, and by how many degrees they were turned.
    """
    facing = np.maximum(normals[..., 2], 0.1)  # steeper slopes are mostly errors
    slopes = [float((normals[..., axis] / facing).mean(dtype=np.float64)) for axis in (0, 1)]
    plane = np.array([*slopes, 1.0]) / np.linalg.norm([*slopes, 1.0])
    turn, _ = Rotation.align_vectors([[0.0, 0.0, 1.0]], [plane])
    angle = float(angle_degrees(plane, np.array(_FLAT)))
    return (normals @ turn.as_matrix().T.astype(np.float32)).astype(np.float32), round(angle, 3)


def measure_edges(normals: np.ndarray) -> dict[str, float]:
    """Return the mean angle in degrees between opposite edges of a map (H, W, 3), and between neighbours inside it.

    A map tiles without a seam where its edges differ no more than neighbours do.
    """
    pairs = {
        "left_right": (normals[:, 0], normals[:, -1]),
        "top_bottom": (normals[0], normals[-1]),
        "neighbours": (normals[:, :-1], normals[:, 1:]),
    }
    return {name: round(float(angle_degrees(*pair).mean()), 3) for name, pair in pairs.items()}


def name_axes(signs: tuple[int, int, int]) -> str:
    """Return axes with these signs towards ours in words."""
    words = (("right", "left"), ("up", "down"), ("to the camera", "away"))
    return ", ".join(f"{axis} {pair[sign < 0]}" for axis, pair, sign in zip("xyz", words, signs, strict=True))
