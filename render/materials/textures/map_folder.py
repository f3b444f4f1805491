"""Folders of PBR maps, as ambientCG and Poly Haven ship them: pictures of base colour, roughness, metallic and relief.

Base colour is sRGB, all others are linear. Maps repeat over the surface. 16-bit pictures keep their depth.
"""

import os
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np

from render.shared.errors import InputError
from render.shared.images import read_image, to_unit

# What follows the asset's name, ambientCG first, then Poly Haven; compared without case.
PATTERNS = {
    "colour": ("_color", "_basecolor", "_albedo", "_diff", "_diffuse", "_col"),
    "roughness": ("_roughness", "_rough"),
    "metallic": ("_metalness", "_metallic", "_metal"),
    "normal": ("_normalgl", "_nor_gl", "_normaldx", "_nor_dx"),
    "height": ("_displacement", "_height", "_disp"),
}
SUFFIXES = (".png", ".jpg", ".jpeg", ".tif", ".tiff")
_UNREAD = (".exr", ".hdr", ".tga", ".bmp", ".webp")
_LARGEST = 4096
_DEPTH = 0.03  # relief of a height map from black to white, in widths of the map
_STEEPEST = 3.0  # slopes of a normal map are cut here, 72 degrees


@dataclass(frozen=True, eq=False)
class MapFolder:
    """Maps of one size; row 0 is the top, v = 1.

    Attributes:
        path: The folder.
        values: (H, W, 5) float32: linear base colour, roughness, metallic.
        slopes: (H, W, 2) float32, change of the height along u (right) and v (up), both in widths of the map; None
            for a folder without relief.
    """

    path: str
    values: np.ndarray
    slopes: np.ndarray | None


def read(folder: str | Path) -> MapFolder:
    """Read a folder of maps, from memory when it has not changed.

    Raises:
        InputError: no folder, no base colour, two maps of one kind, maps of different sizes, or a damaged picture.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder of maps")
    found = find(folder)
    return _read(str(folder), tuple((kind, str(path), os.stat(path).st_mtime_ns) for kind, path in found.items()))


def find(folder: Path) -> dict[str, Path]:
    """Return the picture of each kind of map that the folder has, told by the names.

    Raises:
        InputError: no base colour, two pictures of one kind, or one in a format that is not read.
    """
    found: dict[str, tuple[int, Path]] = {}
    unread: dict[str, Path] = {}
    for path in sorted(folder.iterdir()):
        kind, rank = _kind(path.stem.lower())
        if kind and path.suffix.lower() in _UNREAD:
            unread[kind] = path
        if not kind or path.suffix.lower() not in SUFFIXES:
            continue
        if kind in found and found[kind][0] == rank:
            raise InputError(f"{folder}: {kind}: both {found[kind][1].name} and {path.name}; keep one of them")
        if kind not in found or rank < found[kind][0]:
            found[kind] = (rank, path)
    for kind, path in unread.items():
        if kind not in found:
            raise InputError(f"{path}: {kind}: maps must be {', '.join(SUFFIXES)}; download it as PNG or JPG")
    if "colour" not in found:
        raise InputError(
            f"{folder}: no base colour map; expected a picture named like Bricks_Color.jpg or brick_diff_2k.png"
        )
    return {kind: path for kind, (_, path) in found.items()}


def _kind(stem: str) -> tuple[str, int]:
    """Return the kind of map that a name tells, and its ending's place in `PATTERNS`; an empty name for none.

    Poly Haven puts the resolution behind it: `rough_wood_diff_2k`. Of several that a name has, the last one counts.
    """
    told = [
        (stem.rfind(ending), kind, rank)
        for kind, endings in PATTERNS.items()
        for rank, ending in enumerate(endings)
        if stem.endswith(ending) or f"{ending}_" in stem
    ]
    _, kind, rank = max(told, default=(0, "", 0), key=lambda each: each[0])
    return kind, rank


@lru_cache(maxsize=4)
def _read(folder: str, files: tuple[tuple[str, str, int], ...]) -> MapFolder:
    pictures: dict[str, np.ndarray] = {}
    for kind, path, _ in files:
        pixels = to_unit(read_image(path, channels=3 if kind in ("colour", "normal") else None))
        if max(pixels.shape[:2]) > _LARGEST or min(pixels.shape[:2]) < 2:
            size = "{1}x{0}".format(*pixels.shape)
            raise InputError(f"{path}: {size} pixels; maps may have 2 to {_LARGEST} a side, scale them")
        pictures[kind] = pixels
    first = Path(files[0][1]).name
    shape = pictures[files[0][0]].shape[:2]
    for kind, path, _ in files:
        if pictures[kind].shape[:2] != shape:
            sizes = ("{1}x{0}".format(*size) for size in (pictures[kind].shape, shape))
            raise InputError(f"{path}: {next(sizes)} pixels, but {first} has {next(sizes)}; scale them to one size")
    values = np.empty((*shape, 5), np.float32)
    colour = pictures["colour"]
    values[..., :3] = np.where(colour <= 0.04045, colour / 12.92, ((colour + 0.055) / 1.055) ** 2.4)
    values[..., 3] = pictures.get("roughness", np.float32(0.6))
    values[..., 4] = pictures.get("metallic", np.float32(0))
    names = {kind: Path(path).stem.lower() for kind, path, _ in files}
    return MapFolder(folder, values, _slopes(pictures, names))


def _slopes(pictures: dict[str, np.ndarray], names: dict[str, str]) -> np.ndarray | None:
    """Return the slopes of the normal map, or of the height map by central differences over the repeating picture."""
    if "normal" in pictures:
        x, y, z = np.moveaxis(2 * pictures["normal"] - 1, -1, 0)
        if "normaldx" in names["normal"] or "nor_dx" in names["normal"]:
            y = -y  # DirectX: green points down
        slopes = np.stack([-x, -y], -1) / np.maximum(z, 0.05)[..., None]
        return np.clip(slopes, -_STEEPEST, _STEEPEST).astype(np.float32)
    if "height" not in pictures:
        return None
    height, width = pictures["height"] * _DEPTH, pictures["height"].shape[1]
    along_u = (np.roll(height, -1, 1) - np.roll(height, 1, 1)) * (width / 2)
    along_v = (np.roll(height, 1, 0) - np.roll(height, -1, 0)) * (width / 2)
    return np.clip(np.stack([along_u, along_v], -1), -_STEEPEST, _STEEPEST).astype(np.float32)
