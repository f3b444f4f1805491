"""Folders of PBR maps, as ambientCG and Poly Haven ship them: pictures of base colour, roughness, metallic and relief.

Base colour is sRGB, all others are linear. Maps repeat over the surface. 16-bit pictures keep their depth.
"""

import io
import logging
import os
import warnings
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
from PIL import Image

from render.materials.textures.map_names import DX, Maps, Source, find
from render.shared.decoding import check_picture, decoding
from render.shared.errors import InputError
from render.shared.files import read_bytes
from render.shared.images import read_channels, to_unit
from render.shared.imaging.srgb import from_srgb

_log = logging.getLogger(__name__)
_LARGEST = 4096
_DEPTH = 0.03  # relief of a height map from black to white, in widths of the map
_STEEPEST = 3.0  # slopes of a normal map are cut here, 72 degrees
_ROUGHNESS = 0.6  # without a map
_CLEARLY = 0.5  # of the curl of the slopes: less than this share of it with green down says that it is


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

    The console says once which pictures of the folder are not used.

    Raises:
        InputError: no folder, no base colour, two maps of one kind, maps of different sizes, or a damaged picture.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder of maps")
    maps = find(folder)
    found = _read(
        str(folder), tuple((kind, each, os.stat(each.path).st_mtime_ns) for kind, each in maps.sources.items())
    )
    _say(folder, maps, found)
    return found


_said: set[str] = set()


def _say(folder: Path, maps: Maps, found: MapFolder) -> None:
    """Say once in a process what of a folder is not used, and how a normal map is taken that does not say it."""
    lines = []
    normal = maps.sources.get("normal")
    if normal and not normal.convention and found.slopes is not None:
        line = f"{normal.path}: taken as OpenGL, green up; "
        if _fits_green_down(found.slopes):
            lines.append(f"{line}but its slopes fit together better with green down: if so, name it _NormalDX")
        else:
            lines.append(f"{line}name it _NormalDX if green is down")
    if maps.unused:
        lines.append(f"{folder}: not used: {', '.join(path.name for path in maps.unused)}")
    for line in lines:
        if line not in _said:
            _said.add(line)
            _log.warning("%s", line)


def _fits_green_down(slopes: np.ndarray) -> bool:
    """Return whether slopes (H, W, 2) are those of a height only when the second is turned: mixed derivatives agree."""
    along_v = np.roll(slopes[..., 0], 1, 0) - np.roll(slopes[..., 0], -1, 0)
    along_u = np.roll(slopes[..., 1], -1, 1) - np.roll(slopes[..., 1], 1, 1)
    up, down = float(np.square(along_v - along_u).mean()), float(np.square(along_v + along_u).mean())
    return down < _CLEARLY * up


@lru_cache(maxsize=4)
def _read(folder: str, files: tuple[tuple[str, Source, int], ...]) -> MapFolder:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # Pillow's of very large pictures, which are refused in a line
        pictures = {kind: _map(kind, source) for kind, source, _ in files}
    first = files[0][1].path
    shape = pictures[files[0][0]].shape[:2]
    for kind, source, _ in files:
        if pictures[kind].shape[:2] != shape:
            sizes = ("{1}x{0}".format(*size) for size in (pictures[kind].shape, shape))
            raise InputError(
                f"{source.path}: {next(sizes)} pixels, but {first.name} has {next(sizes)}; scale them to one size"
            )
    values = np.empty((*shape, 5), np.float32)
    values[..., :3] = from_srgb(pictures["colour"])
    values[..., 3] = pictures.get("roughness", np.float32(_ROUGHNESS))
    values[..., 4] = pictures.get("metallic", np.float32(0))
    down = any(kind == "normal" and source.convention == DX for kind, source, _ in files)
    return MapFolder(folder, values, _slopes(pictures, down))


def _map(kind: str, source: Source) -> np.ndarray:
    """Read one map: (H, W, 3) float32 in [0, 1] of base colour and normals, (H, W) of the others."""
    path = source.path
    pixels = _channels(path)
    if max(pixels.shape[:2]) > _LARGEST or min(pixels.shape[:2]) < 2:
        size = "{1}x{0}".format(*pixels.shape)
        raise InputError(f"{path}: {size} pixels; maps may have 2 to {_LARGEST} a side, scale them")
    if kind == "colour":
        return to_unit(pixels[..., :3] if pixels.shape[2] >= 3 else np.repeat(pixels[..., :1], 3, axis=2))
    needed = 3 if kind == "normal" else (source.channel or 0) + 1
    if pixels.shape[2] < needed:
        raise InputError(f"{path}: {kind}: {pixels.shape[2]} channel(s) where {needed} are needed; save it as RGB"
                         + ("A" if needed > 3 else ""))  # fmt: skip
    values = to_unit(pixels[..., :3] if kind == "normal" else pixels[..., source.channel or 0])
    return 1 - values if source.inverted else values


def _channels(path: Path) -> np.ndarray:
    """Read a picture (H, W, C); TGA, which OpenCV does not read, by Pillow."""
    if path.suffix.lower() != ".tga":
        return read_channels(path)
    data = read_bytes(path, "no such picture")
    with decoding(path, "a picture"), Image.open(io.BytesIO(data), formats=["TGA"]) as picture:
        check_picture(path, picture, data)
        pixels = np.asarray(picture.convert("RGB") if picture.mode == "P" else picture)
    return pixels[..., None] if pixels.ndim == 2 else pixels


def _slopes(pictures: dict[str, np.ndarray], green_down: bool) -> np.ndarray | None:
    """Return the slopes of the normal map, or of the height map by central differences over the repeating picture."""
    if "normal" in pictures:
        x, y, z = np.moveaxis(2 * pictures["normal"] - 1, -1, 0)
        if green_down:
            y = -y
        slopes = np.stack([-x, -y], -1) / np.maximum(z, 0.05)[..., None]
        return np.clip(slopes, -_STEEPEST, _STEEPEST).astype(np.float32)
    if "height" not in pictures:
        return None
    height, width = pictures["height"] * _DEPTH, pictures["height"].shape[1]
    along_u = (np.roll(height, -1, 1) - np.roll(height, 1, 1)) * (width / 2)
    along_v = (np.roll(height, 1, 0) - np.roll(height, -1, 0)) * (width / 2)
    return np.clip(np.stack([along_u, along_v], -1), -_STEEPEST, _STEEPEST).astype(np.float32)
