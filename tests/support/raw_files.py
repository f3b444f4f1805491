"""Camera RAW files that hold what a test wants, as DNG."""

import io
import struct

import numpy as np
import tifffile


def dng(
    mosaic: np.ndarray, *, black: int = 0, white: int = 65535, orientation: int = 1, as_shot: float = 1.0,
    seconds: float | None = None,
) -> bytes:  # fmt: skip
    """Return an uncompressed DNG of a mosaic (H, W) uint16 with the pattern RGGB.

    Args:
        mosaic: What the sensor measured.
        black: Level of no light.
        white: Level at which the sensor saturates.
        orientation: EXIF's.
        as_shot: How much less red and blue than green there was under the light of the moment.
        seconds: Exposure time, at ISO 100 and f/4; None for no EXIF data.
    """
    one, neutral = (10000, 10000), (round(10000 * as_shot), 10000)
    extra = [
        (271, "s", 0, "sdps", True), (274, "H", 1, orientation, True), (50706, "B", 4, bytes((1, 4, 0, 0)), True),
        (50707, "B", 4, bytes((1, 1, 0, 0)), True), (33421, "H", 2, (2, 2), True),
        (33422, "B", 4, bytes((0, 1, 1, 2)), True), (50708, "s", 0, "sdps test", True),
        (50714, "H", 1, black, True), (50717, "H", 1, white, True),
        (50721, "2i", 9, tuple(x for k in range(9) for x in (one if k % 4 == 0 else (0, 10000))), True),
        (50728, "2I", 3, (*neutral, *one, *neutral), True), (50778, "H", 1, 21, True),
    ]  # fmt: skip
    if seconds is not None:
        extra += [(_PLACE, "I", 1, 0, True)]
    file = io.BytesIO()
    tifffile.imwrite(file, mosaic, photometric=32803, extratags=extra, software=False, metadata=None, subfiletype=0)
    return file.getvalue() if seconds is None else _add_exif(file.getvalue(), seconds)


_PLACE, _EXIF = 0x8768, 0x8769  # tifffile does not write the second


def _add_exif(data: bytes, seconds: float) -> bytes:
    """Append a directory of EXIF data and make the placeholder lead to it."""
    start = len(data)
    entry = data.index(struct.pack("<HHI", _PLACE, 4, 1))
    rows = [struct.pack("<HHII", 33434, 5, 1, start + 42), struct.pack("<HHII", 33437, 5, 1, start + 50),
            struct.pack("<HHIHH", 34855, 3, 1, 100, 0)]  # fmt: skip
    directory = struct.pack("<H", 3) + b"".join(rows) + bytes(4)
    numbers = struct.pack("<4I", round(seconds * 10**6), 10**6, 4, 1)
    return data[:entry] + struct.pack("<HHII", _EXIF, 4, 1, start) + data[entry + 12 :] + directory + numbers


def mosaic(image: np.ndarray) -> np.ndarray:
    """Return what a sensor with the pattern RGGB measures of an image (H, W, 3), even sides."""
    found = image[..., 1].copy()
    found[0::2, 0::2], found[1::2, 1::2] = image[0::2, 0::2, 0], image[1::2, 1::2, 2]
    return found
