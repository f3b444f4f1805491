"""One picture file, decoded at its own depth.

OpenCV reads PNG and TIFF, since Pillow reduces 16-bit RGB to 8 bits; Pillow reads JPEG, since OpenCV fills what a
truncated file lacks with grey and says nothing; OpenEXR reads EXR.
"""

import io
import struct
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import tifffile
from PIL import Image

from render.shared.decoding import check_picture, check_unpacked, decoding, exr_parts
from render.shared.errors import InputError
from render.shared.files import read_bytes
from sdps.photos.response import profile_exponent

SUFFIXES = {".png": "PNG", ".tif": "TIFF", ".tiff": "TIFF", ".jpg": "JPEG", ".jpeg": "JPEG", ".exr": "EXR"}
"""Suffixes that are read, in lower case, and the kinds they stand for."""

_ORIENTATION = 274
_PROFILE = 34675


@dataclass(frozen=True)
class Coding:
    """What must be the same in all pictures of a folder.

    Attributes:
        kind: PNG, TIFF, JPEG or EXR.
        bits: Per channel.
        floating: Whether values are floating-point numbers.
        curve: Exponent of the embedded colour profile's curve, 1 for linear; None without profile.
    """

    kind: str
    bits: int
    floating: bool
    curve: float | None = None

    def __str__(self) -> str:
        profile = "" if self.curve is None else f" with a profile of exponent {self.curve:.2f}"
        return f"{self.bits}-bit {'float ' if self.floating else ''}{self.kind}{profile}"


@dataclass(frozen=True, eq=False)
class Picture:
    """A decoded file.

    Attributes:
        pixels: (H, W, 3) uint8, uint16 or float32, RGB as stored, not turned.
        alpha: (H, W) of the same type, None where there is none.
        coding: How the values are meant.
        orientation: EXIF orientation tag, 1 to 8.
    """

    pixels: np.ndarray
    alpha: np.ndarray | None
    coding: Coding
    orientation: int = 1


def decode(path: Path) -> Picture:
    """Read a picture file; grey pictures are repeated to three channels.

    Raises:
        InputError: missing, damaged or truncated, or of a kind that is not read.
    """
    kind = SUFFIXES.get(path.suffix.lower())
    if kind is None:
        raise InputError(f"{path}: pictures of this kind are not read; convert it to 16-bit TIFF or PNG")
    data = read_bytes(path, "no such picture; copy it there or drop it from the list that names it")
    with _quiet(), decoding(path, f"a {kind}", "copy it again or leave it out"):
        return {"PNG": _png, "TIFF": _tiff, "JPEG": _jpeg, "EXR": _exr}[kind](path, data)


def turned(pixels: np.ndarray, orientation: int) -> np.ndarray:
    """Return (H, W, ...) pixels turned as an EXIF orientation tag asks."""
    if orientation >= 5:
        pixels = np.swapaxes(pixels, 0, 1)
    # After the transposition, tags 5 to 8 are none, mirrored left-right, turned by 180 degrees, mirrored top-bottom.
    flips = {2: (1,), 3: (0, 1), 4: (0,), 6: (1,), 7: (0, 1), 8: (0,)}.get(orientation, ())
    return np.flip(pixels, flips) if flips else pixels


@contextmanager
def _quiet() -> Iterator[None]:
    """Keep the decoders' own complaints off standard error; what matters of them is raised."""
    before = cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        cv2.utils.logging.setLogLevel(before)


def _png(path: Path, data: bytes) -> Picture:
    with Image.open(io.BytesIO(data), formats=["PNG"]) as picture:
        check_picture(path, picture, data)
        profile, exif = picture.info.get("icc_profile"), Image.Exif()
        exif.load(picture.info.get("exif", b""))  # not getexif(), which decodes the pixels
        picture.verify()  # its checksums; libpng would print
    return _by_opencv(path, data, "PNG", profile, exif.get(_ORIENTATION, 1))


def _tiff(path: Path, data: bytes | bytearray) -> Picture:
    with tifffile.TiffFile(io.BytesIO(data)) as file:
        page: Any = file.pages[0]  # a TiffPage; only later ones may be frames
        check_unpacked(path, page.nbytes, "its pixels")
        tags, order = page.tags, file.byteorder
        profile = bytes(tags[_PROFILE].value) if _PROFILE in tags else None
        orientation = int(tags[_ORIENTATION].value) if _ORIENTATION in tags else 1
        if orientation != 1:  # OpenCV turns such pictures by itself, or fails; the tag must be gone before
            data = bytearray(data)
            struct.pack_into(f"{order}H", data, tags[_ORIENTATION].valueoffset, 1)
    return _by_opencv(path, data, "TIFF", profile, orientation)


def _by_opencv(path: Path, data: bytes | bytearray, kind: str, profile: bytes | None, orientation: int) -> Picture:
    pixels = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    if pixels is None:
        raise InputError(f"{path}: damaged or not a {kind}; copy it again or leave it out")
    if pixels.dtype == np.float64:
        pixels = pixels.astype(np.float32)
    if pixels.dtype not in (np.uint8, np.uint16, np.float32):
        raise InputError(f"{path}: pixels are {pixels.dtype}; save it with 8 or 16 bits or 32-bit floats")
    coding = Coding(kind, 8 * pixels.dtype.itemsize, pixels.dtype.kind == "f", profile_exponent(profile))
    channels = 1 if pixels.ndim == 2 else pixels.shape[2]
    alpha = pixels[..., 3] if channels == 4 else None
    rgb = pixels[..., 2::-1] if channels >= 3 else np.repeat(pixels.reshape(*pixels.shape[:2], -1)[..., :1], 3, axis=2)
    return Picture(np.ascontiguousarray(rgb), alpha, coding, orientation if 1 <= orientation <= 8 else 1)


def _jpeg(path: Path, data: bytes) -> Picture:
    with Image.open(io.BytesIO(data), formats=["JPEG", "MPO"]) as picture:
        check_picture(path, picture, data)
        profile, orientation = picture.info.get("icc_profile"), picture.getexif().get(_ORIENTATION, 1)
        pixels = np.asarray(picture.convert("RGB"))
    return Picture(
        pixels, None, Coding("JPEG", 8, False, profile_exponent(profile)), orientation if 1 <= orientation <= 8 else 1
    )


def _exr(path: Path, data: bytes) -> Picture:
    channels = {name: channel.pixels for name, channel in exr_parts(path)[0].channels.items()}
    colour = [name for name in channels if name.split(".")[-1] in ("RGB", "RGBA")]
    grey = [name for name in channels if name.split(".")[-1] in ("Y", "YA")]
    name = next((name for name in ("RGB", "RGBA", "Y", "YA") if name in channels), None)
    name = name or (colour[0] if len(colour) == 1 else None) or (grey[0] if len(grey) == 1 else None)
    if name is None:
        raise InputError(
            f"{path}: wants channels R, G, B, has {', '.join(sorted(channels))[:80]}; save the colour alone"
        )
    pixels = np.asarray(channels[name])
    bits = 8 * pixels.dtype.itemsize
    pixels = pixels.astype(np.float32)
    rgb = (
        pixels[..., :3] if pixels.ndim == 3 and pixels.shape[2] >= 3 else pixels.reshape(*pixels.shape[:2], -1)[..., :1]
    )
    alpha = pixels[..., 3] if pixels.ndim == 3 and pixels.shape[2] == 4 else None
    return Picture(np.ascontiguousarray(np.broadcast_to(rgb, (*rgb.shape[:2], 3))), alpha, Coding("EXR", bits, True))
