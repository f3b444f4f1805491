"""Decoders of every kind of picture file, each at the file's own depth.

OpenCV reads PNG and TIFF, since Pillow reduces 16-bit RGB to 8 bits; Pillow reads JPEG, since OpenCV fills what a
truncated file lacks with grey and says nothing, and BMP, TGA, WebP and AVIF; OpenEXR reads EXR. `camera_files.py` reads
RAW and HEIC.
"""

import io
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import tifffile
from PIL import Image, features

from render.shared.decoding import check_picture, check_unpacked, silence
from render.shared.errors import InputError
from render.shared.imaging.exr_colours import read_exr_colours
from sdps.photos.pictures.decoding.camera_files import read_heif, read_raw
from sdps.photos.pictures.decoding.decoded import Decoded, read_orientation, read_taken, repeat_grey
from sdps.photos.pictures.decoding.netpbm import read_netpbm
from sdps.photos.pictures.lens import EXIF, Lens

_ORIENTATION = 274
_PROFILE = 34675
_PLANES = 2  # TIFF's PlanarConfiguration of channels one after another
_INKS = 5
_COLOURS = {_INKS: "inks (CMYK)", 8: "CIELAB", 9: "CIELAB", 10: "CIELAB", 32844: "LogL", 32845: "LogLuv"}
_BY_TIFFFILE = (np.dtype(np.uint32), np.dtype(np.int32), np.dtype(np.int16), np.dtype(np.float16))
_PIXELS = {b"IHDR", b"PLTE", b"tRNS", b"IDAT", b"IEND"}


def _png(path: Path, data: bytes) -> Decoded:
    with Image.open(io.BytesIO(data), formats=["PNG"]) as picture:
        check_picture(path, picture, data)
        profile, exif = picture.info.get("icc_profile"), Image.Exif()
        exif.load(picture.info.get("exif", b""))  # not getexif(), which decodes the pixels
        picture.verify()  # its checksums; libpng would print
    said = read_taken(lambda: exif.get_ifd(EXIF))
    return _by_opencv(path, _only_pixels(data), "PNG", profile, exif.get(_ORIENTATION, 1), *said)


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
        exif = tags[EXIF].value if EXIF in tags else {}
        said = read_taken(lambda: exif)
        _refuse_colours(path, page)
        if page.dtype in _BY_TIFFFILE or (page.planarconfig == _PLANES and page.samplesperpixel > 1):
            pixels = _read_page(path, page)
            alpha = pixels[..., 3] if pixels.ndim == 3 and pixels.shape[2] == 4 else None
            bits = 8 * page.dtype.itemsize
            return Decoded(repeat_grey(pixels), alpha, bits, profile, read_orientation(orientation), "", *said)
        if orientation != 1:  # OpenCV turns such pictures by itself, or fails; the tag must be gone before
            data = bytearray(data)
            struct.pack_into(f"{order}H", data, tags[_ORIENTATION].valueoffset, 1)
    return _by_opencv(path, data, "TIFF", profile, orientation, *said)


def _refuse_colours(path: Path, page: Any) -> None:
    """Refuse a TIFF whose values are not red, green and blue and are not converted to them."""
    kind = int(page.photometric)
    converted = kind == _INKS and page.bitspersample == 8 and page.planarconfig != _PLANES
    what = "" if converted else _COLOURS.get(kind, "")
    if what:
        raise InputError(f"{path}: its colours are {what}; save it as RGB or grey")


def _read_page(path: Path, page: Any) -> np.ndarray:  # (H, W[, C]) uint8, uint16 or float32
    """Read what OpenCV does not: channels one after another, half floats, and integers of other kinds as floats."""
    try:
        pixels = page.asarray()
    except ValueError as error:
        if "imagecodecs" not in str(error):
            raise
        raise InputError(f"{path}: is compressed in a way that is not read; save it without compression") from error
    if pixels.ndim == 3 and page.planarconfig == _PLANES:
        pixels = np.moveaxis(pixels, 0, -1)
    if pixels.dtype.kind in "iu" and pixels.dtype not in (np.uint8, np.uint16):
        return (pixels / float(np.iinfo(pixels.dtype).max)).astype(np.float32)
    return pixels.astype(np.float32) if pixels.dtype.kind == "f" else pixels


def _by_opencv(
    path: Path,
    data: bytes | bytearray,
    kind: str,
    profile: bytes | None,
    orientation: int,
    lens: Lens,
    exposure: float = 0.0,
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
    rgb = pixels[..., 2::-1] if channels >= 3 else repeat_grey(pixels)
    bits = 8 * pixels.dtype.itemsize
    return Decoded(np.ascontiguousarray(rgb), alpha, bits, profile, read_orientation(orientation), "", lens, exposure)


def _by_pillow(*formats: str) -> Callable[[Path, bytes], Decoded]:
    """Return a decoder of 8-bit files."""

    def decode(path: Path, data: bytes) -> Decoded:
        with Image.open(io.BytesIO(data), formats=formats) as picture:
            check_picture(path, picture, data)
            profile, orientation = picture.info.get("icc_profile"), picture.getexif().get(_ORIENTATION, 1)
            exif, alpha = picture.getexif(), None
            lens, exposure = read_taken(lambda: exif.get_ifd(EXIF))
            if "A" in picture.getbands() or "transparency" in picture.info:
                alpha = np.asarray(picture.convert("RGBA"))[..., 3]
            pixels = np.asarray(picture.convert("RGB"))
        return Decoded(pixels, alpha, 8, profile, read_orientation(orientation), "", lens, exposure)

    return decode


def _avif(path: Path, data: bytes) -> Decoded:
    if not features.check("avif"):
        raise InputError(f"{path}: is an AVIF picture, which this Pillow cannot read: pip install 'pillow>=11.3'")
    return _by_pillow("AVIF")(path, data)


def _exr(path: Path, data: bytes) -> Decoded:
    found = read_exr_colours(path, "copy it again or leave it out")
    pixels, bits = found.pixels.astype(np.float32), 8 * found.pixels.dtype.itemsize
    return Decoded(repeat_grey(pixels), found.alpha, bits, layer=found.layer)


def _pnm(path: Path, data: bytes) -> Decoded:
    pixels = read_netpbm(path, data)
    return Decoded(pixels if pixels.ndim == 3 else repeat_grey(pixels), None, 8 * pixels.dtype.itemsize)


DECODERS: dict[str, Callable[[Path, bytes], Decoded]] = {
    "PNG": _png, "TIFF": _tiff, "EXR": _exr, "PNM": _pnm, "JPEG": _by_pillow("JPEG", "MPO"), "BMP": _by_pillow("BMP"),
    "TGA": _by_pillow("TGA"), "WebP": _by_pillow("WEBP"), "RAW": read_raw, "HEIC": read_heif, "AVIF": _avif,
}  # fmt: skip
"""By kind, from a path for messages and the whole file; all raise InputError or their library's own errors."""
