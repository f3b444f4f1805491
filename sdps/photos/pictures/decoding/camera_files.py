"""What cameras and phones write: RAW by LibRaw (rawpy), HEIC by libheif (pi-heif).

Both are optional packages. pillow-heif, the better known wrapper of libheif, is not used: its wheels hold
x265, which is under the GPL.
"""

import importlib
import io
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from render.shared.decoding import check_unpacked, silence
from render.shared.errors import InputError
from sdps.photos.pictures.decoding.decoded import Decoded, join_exposure, read_taken, repeat_grey
from sdps.photos.pictures.lens import EXIF, read_lens

_TURNS = {0: 1, 1: 2, 2: 4, 3: 3, 4: 5, 5: 8, 6: 6, 7: 7}
"""EXIF orientation by LibRaw's flip (1: left-right, 2: top-bottom, 4: transposed)."""
_ANGLES = {0: 1, 1: 8, 2: 3, 3: 6}
"""EXIF orientation by HEIF's rotation, in quarter turns anti-clockwise."""
_HDR = {16: "PQ", 18: "HLG"}


def read_raw(path: Path, data: bytes) -> Decoded:
    """Develop a camera's RAW file, every picture in the same way, to 16 bits of linear radiance.

    Black level off, the camera's daylight white balance (that of the moment may differ between the pictures), the
    sensor's own primaries, which are not mixed so that no channel falls below 0, and bilinear interpolation, so that
    each value is a fixed sum of what the sensor measured. Full scale is where the sensor's least amplified channel
    saturates, not the brightest value of the picture.

    Raises:
        InputError: rawpy is missing. Errors of LibRaw pass.
    """
    rawpy = _require("rawpy", "raw", path, "camera RAW")
    with silence(), rawpy.imread(io.BytesIO(data)) as raw:
        sizes = raw.sizes
        check_unpacked(path, 6 * sizes.raw_height * sizes.raw_width, "its pixels")
        balance = [float(gain) for gain in raw.daylight_whitebalance[:3]]
        if not all(0 < gain < 100 for gain in balance):
            balance = [1.0, 1.0, 1.0]
        pixels = raw.postprocess(
            gamma=(1, 1), no_auto_bright=True, output_bps=16, output_color=rawpy.ColorSpace.raw, user_flip=0,
            user_wb=[*balance, balance[1]], adjust_maximum_thr=0.0,
            demosaic_algorithm=rawpy.DemosaicAlgorithm.LINEAR,
        )  # fmt: skip
        other = getattr(raw, "other", None)
        exposure = 0.0 if other is None else join_exposure(other.shutter_speed, other.aperture, other.iso_speed)
    lens = read_lens(lambda: read_exif(path, data, "RAW").get_ifd(EXIF))
    return Decoded(repeat_grey(pixels), None, 16, None, _TURNS[sizes.flip & 7], "", lens, exposure)


def read_exif(path: Path, data: bytes, kind: str) -> Image.Exif:
    """Return the EXIF data of a file of kind `HEIC`, or `RAW` that is laid out as TIFF; no pixel is decoded.

    Raises:
        InputError: as `read_heif`. Errors of the libraries pass.
    """
    exif = Image.Exif()
    exif.load(_open_heif(path, data).info.get("exif") or b"" if kind == "HEIC" else b"Exif\0\0" + data)
    return exif


def read_heif(path: Path, data: bytes) -> Decoded:
    """Decode a HEIC picture, of 8 bits or, where it has more, of 16.

    Raises:
        InputError: pi-heif is missing, or values that no display curve of sRGB's kind explains. Errors of libheif pass.
    """
    with silence():
        picture = _open_heif(path, data)
        wide = ";" in picture.mode
        check_unpacked(path, picture.size[0] * picture.size[1] * len(picture.mode[:4]) * (2 if wide else 1), "it")
        curve = (picture.info.get("nclx_profile") or {}).get("transfer_characteristics")
        if curve in _HDR:
            raise InputError(f"{path}: its values are coded for HDR screens ({_HDR[curve]}); switch HDR off, or save "
                             "it as 16-bit TIFF")  # fmt: skip
        pixels = np.array(picture)  # a copy: its memory goes with it
    profile = picture.info.get("icc_profile")
    pixels = pixels.reshape(*pixels.shape[:2], -1)
    alpha = pixels[..., -1] if pixels.shape[2] in (2, 4) else None
    turned = _find_turn(data)
    if turned != 1:  # libheif has turned it; all kinds are handed on as the sensor saw them
        pixels, alpha = _turn_back(pixels, turned), None if alpha is None else _turn_back(alpha, turned)
    exif = Image.Exif()
    exif.load(picture.info.get("exif") or b"")
    lens, exposure = read_taken(lambda: exif.get_ifd(EXIF))
    return Decoded(repeat_grey(pixels), alpha, 16 if wide else 8, profile or None, turned, "", lens, exposure)


def _open_heif(path: Path, data: bytes) -> Any:
    """Open a HEIC picture; no pixel is decoded.

    Raises:
        InputError: pi-heif is missing, or parts lie outside the file or have no names, which it does not survive.
    """
    heif = _require("pi_heif", "heic", path, "a HEIC picture")
    if not (_parts_fit(data) and _have_names(data)):
        raise InputError(f"{path}: damaged or not a HEIC (its list of parts is wrong); copy it again or leave it out")
    return heif.open_heif(io.BytesIO(data), convert_hdr_to_8bit=False)


def _parts_fit(data: bytes) -> bool:
    """Tell whether all parts that a HEIF file's `iloc` box lists lie inside the file (ISO/IEC 14496-12, 8.11.3)."""
    box = data.find(b"iloc")
    version = data[box + 4]
    sizes = [data[box + 8] >> 4, data[box + 8] & 15, data[box + 9] >> 4, data[box + 9] & 15 if version else 0]
    if box < 0 or version > 2 or any(size not in (0, 4, 8) for size in sizes):
        return False
    place, wide = box + 10, 4 if version == 2 else 2

    def take(size: int) -> int:
        nonlocal place
        place += size
        return int.from_bytes(data[place - size : place], "big")

    for _ in range(take(wide)):
        take(wide)
        if version:
            take(2)
        take(2)
        start = take(sizes[2])
        for _ in range(take(2)):
            take(sizes[3])
            offset, length = take(sizes[0]), take(sizes[1])
            if start + offset + length > len(data) or place > len(data):
                return False
    return True


def _have_names(data: bytes) -> bool:
    """Tell whether kinds and names of all parts, in `infe` boxes (8.11.6), are ASCII."""
    place = data.find(b"infe")
    while place >= 0:
        size = int.from_bytes(data[place - 4 : place], "big")
        kind = place + (12 if data[place + 4 : place + 5] == b"\2" else 14)
        if not data[kind : place - 4 + size].isascii():
            return False
        place = data.find(b"infe", place + 4)
    return True


def _find_turn(data: bytes) -> int:
    """Return the rotation that a HEIF file asks for, as EXIF's orientation; 1 where several parts ask differently."""
    start = data.find(b"ipco")
    angles, place = set(), data.find(b"irot", max(start, 0))
    while start >= 0 and place >= 0 and place + 4 < min(len(data), start + 2**20):
        if data[place - 4 : place] == b"\0\0\0\x09":
            angles.add(data[place + 4] & 3)
        place = data.find(b"irot", place + 4)
    mirrored = start >= 0 and data.find(b"\0\0\0\x09imir", start, start + 2**20) >= 0
    return _ANGLES[angles.pop()] if len(angles) == 1 and not mirrored else 1


def _turn_back(pixels: np.ndarray, orientation: int) -> np.ndarray:
    """Undo a rotation by 90, 180 or 270 degrees."""
    return np.ascontiguousarray(np.rot90(pixels, {6: 1, 3: 2, 8: 3}[orientation]))


def read_size(path: Path, data: bytes, kind: str) -> tuple[int, int]:
    """Return (width, height) by the header of a file of kind `RAW` or `HEIC`; no pixel is decoded.

    Raises:
        InputError: the package is missing. Errors of the libraries pass.
    """
    if kind == "HEIC":
        width, height = _open_heif(path, data).size
        return int(width), int(height)
    with silence(), _require("rawpy", "raw", path, "camera RAW").imread(io.BytesIO(data)) as raw:
        return int(raw.sizes.raw_width), int(raw.sizes.raw_height)


def _require(module: str, extra: str, path: Path, what: str) -> Any:
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise InputError(f"{path}: is {what}; to read it, pip install 'sdps[{extra}]'") from error
