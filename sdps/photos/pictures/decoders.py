"""Decoders of every kind of picture file, each at the file's own depth.

OpenCV reads PNG and TIFF, since Pillow reduces 16-bit RGB to 8 bits; Pillow reads JPEG, since OpenCV fills what a
truncated file lacks with grey and says nothing, and BMP, TGA and WebP; OpenEXR reads EXR.
"""

import io
import struct
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import tifffile
from PIL import Image

from render.shared.decoding import check_picture, check_unpacked, silence
from render.shared.errors import InputError
from render.shared.imaging.exr_colours import read_exr_colours
from sdps.photos.pictures.lens import EXIF, NO_LENS, Lens, read_lens
from sdps.photos.pictures.netpbm import read_netpbm

_ORIENTATION = 274
_PROFILE = 34675
_PIXELS = {b"IHDR", b"PLTE", b"tRNS", b"IDAT", b"IEND"}


@dataclass(frozen=True, eq=False)
class Decoded:
    """What a file holds.

    Attributes:
        pixels: (H, W, 3) uint8, uint16 or float32, RGB as stored, not turned; grey is repeated.
        alpha: (H, W) of the same type, None where there is none.
        bits: Per channel in the file.
        profile: The embedded colour profile.
        orientation: EXIF orientation tag, 1 to 8.
        layer: Which layer of an EXR file it was, empty where it has no name.
        lens: What its EXIF data say.
    """

    pixels: np.ndarray
    alpha: np.ndarray | None
    bits: int
    profile: bytes | None = None
    orientation: int = 1
    layer: str = ""
    lens: Lens = NO_LENS


def _png(path: Path, data: bytes) -> Decoded:
    with Image.open(io.BytesIO(data), formats=["PNG"]) as picture:
        check_picture(path, picture, data)
        profile, exif = picture.info.get("icc_profile"), Image.Exif()
        exif.load(picture.info.get("exif", b""))  # not getexif(), which decodes the pixels
        picture.verify()  # its checksums; libpng would print
    lens = read_lens(lambda: exif.get_ifd(EXIF))
    return _by_opencv(path, _only_pixels(data), "PNG", profile, exif.get(_ORIENTATION, 1), lens)


def _only_pixels(data: bytes) -> bytes:
    """Drop the chunks of a verified PNG that OpenCV's libpng would print warnings about, such as odd profiles."""
    kept, place = [data[:8]], 8
    while place + 12 <= len(data):
        (length,) = struct.unpack_from(">I", data, place)
        if data[place + 4 : place + 8] in _PIXELS:
            kept.append(data[place : place + 12 + length])
        place += 12 + length
    return b"".join(kept)


def _tiff(path: Path, data: bytes | bytearray) -> Decoded:
    with tifffile.TiffFile(io.BytesIO(data)) as file:
        if not len(file.pages):
            raise InputError(f"{path}: damaged or truncated TIFF without a page; copy it again or leave it out")
        page: Any = file.pages[0]  # a TiffPage; only later ones may be frames
        check_unpacked(path, page.nbytes, "its pixels")
        tags, order = page.tags, file.byteorder
        profile = bytes(tags[_PROFILE].value) if _PROFILE in tags else None
        orientation = int(tags[_ORIENTATION].value) if _ORIENTATION in tags else 1
        lens = read_lens(lambda: tags[EXIF].value if EXIF in tags else {})
        if orientation != 1:  # OpenCV turns such pictures by itself, or fails; the tag must be gone before
            data = bytearray(data)
            struct.pack_into(f"{order}H", data, tags[_ORIENTATION].valueoffset, 1)
    return _by_opencv(path, data, "TIFF", profile, orientation, lens)


def _by_opencv(
    path: Path, data: bytes | bytearray, kind: str, profile: bytes | None, orientation: int, lens: Lens
) -> Decoded:
    with silence():
        pixels = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    if pixels is None:
        raise InputError(f"{path}: damaged or not a {kind}; copy it again or leave it out")
    if pixels.dtype == np.float64:
        pixels = pixels.astype(np.float32)
    if pixels.dtype not in (np.uint8, np.uint16, np.float32):
        raise InputError(f"{path}: pixels are {pixels.dtype}; save it with 8 or 16 bits or 32-bit floats")
    channels = 1 if pixels.ndim == 2 else pixels.shape[2]
    alpha = pixels[..., 3] if channels == 4 else None
    rgb = pixels[..., 2::-1] if channels >= 3 else _repeat_grey(pixels)
    bits = 8 * pixels.dtype.itemsize
    return Decoded(np.ascontiguousarray(rgb), alpha, bits, profile, _orientation(orientation), lens=lens)


def _by_pillow(*formats: str) -> Callable[[Path, bytes], Decoded]:
    """Return a decoder of 8-bit files."""

    def decode(path: Path, data: bytes) -> Decoded:
        with Image.open(io.BytesIO(data), formats=formats) as picture:
            check_picture(path, picture, data)
            profile, orientation = picture.info.get("icc_profile"), picture.getexif().get(_ORIENTATION, 1)
            lens, alpha = read_lens(lambda: picture.getexif().get_ifd(EXIF)), None
            if "A" in picture.getbands() or "transparency" in picture.info:
                alpha = np.asarray(picture.convert("RGBA"))[..., 3]
            pixels = np.asarray(picture.convert("RGB"))
        return Decoded(pixels, alpha, 8, profile, _orientation(orientation), lens=lens)

    return decode


def _exr(path: Path, data: bytes) -> Decoded:
    found = read_exr_colours(path, "copy it again or leave it out")
    pixels, bits = found.pixels.astype(np.float32), 8 * found.pixels.dtype.itemsize
    return Decoded(_repeat_grey(pixels), found.alpha, bits, layer=found.layer)


def _pnm(path: Path, data: bytes) -> Decoded:
    pixels = read_netpbm(path, data)
    return Decoded(pixels if pixels.ndim == 3 else _repeat_grey(pixels), None, 8 * pixels.dtype.itemsize)


def _repeat_grey(pixels: np.ndarray) -> np.ndarray:
    """Return (H, W), (H, W, C) with C >= 3, or with a grey channel first, as (H, W, 3)."""
    pixels = pixels.reshape(*pixels.shape[:2], -1)
    wide = pixels[..., :3] if pixels.shape[2] >= 3 else pixels[..., :1]
    return np.ascontiguousarray(np.broadcast_to(wide, (*wide.shape[:2], 3)))


def _orientation(tag: object) -> int:
    return tag if isinstance(tag, int) and 1 <= tag <= 8 else 1


DECODERS: dict[str, Callable[[Path, bytes], Decoded]] = {
    "PNG": _png, "TIFF": _tiff, "EXR": _exr, "PNM": _pnm, "JPEG": _by_pillow("JPEG", "MPO"), "BMP": _by_pillow("BMP"),
    "TGA": _by_pillow("TGA"), "WebP": _by_pillow("WEBP"),
}  # fmt: skip
"""By kind, from a path for messages and the whole file; all raise InputError or their library's own errors."""
