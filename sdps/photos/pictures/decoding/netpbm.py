"""Netpbm pictures (PBM, PGM, PPM), as text and as bytes, up to 16 bits.

Pillow reduces 16-bit colours to 8 bits, and OpenCV leaves the values of a 12-bit picture in the lowest sixteenth of
their range; so they are read here. Reference: netpbm.sourceforge.net/doc, pages pbm, pgm and ppm.
"""

import re
from pathlib import Path

import numpy as np

from render.shared.decoding import check_unpacked
from render.shared.errors import InputError

_GAP = rb"(?:\s|#[^\r\n]*[\r\n])+"
_LONGEST_HEADER = 4096


def read_netpbm(path: Path, data: bytes) -> np.ndarray:  # (H, W) or (H, W, 3), uint8 or uint16
    """Decode a picture; its greatest value becomes 255, or 65535 where it is larger than 255.

    Raises:
        InputError: a header that is none, values above the greatest, or too few of them.
    """
    bitmap = data[1:2] in b"14"
    pattern = rb"P[1-6]" + (_GAP + rb"([0-9]{1,9})") * (2 if bitmap else 3) + rb"(?:\s|(?=#))"
    header = re.match(pattern, data[:_LONGEST_HEADER])
    if header is None:
        raise InputError(
            f"{path}: damaged or not a PNM picture (its header is incomplete); copy it again or leave it out"
        )
    width, height, *rest = (int(number) for number in header.groups())
    greatest = rest[0] if rest else 1
    if width < 1 or height < 1 or not 1 <= greatest <= 65535:
        raise InputError(f"{path}: its header says {width}x{height} pixels up to {greatest}; save it again")
    channels = 3 if data[1:2] in b"36" else 1
    check_unpacked(path, width * height * channels * (2 if greatest > 255 else 1), "its pixels")
    body, count = data[header.end() :], width * height * channels
    if data[1:2] in b"123":
        values = _text(body, count, bitmap)
    elif bitmap:
        values = _bits(body, width, height)
    else:
        values = _numbers(body, count, ">u2" if greatest > 255 else "u1")
    if len(values) < count:
        raise InputError(
            f"{path}: damaged or truncated ({len(values)} of {count} values); copy it again or leave it out"
        )
    if values.max() > greatest:
        raise InputError(f"{path}: has values above {greatest}, the greatest of its header; save it again")
    full = 65535 if greatest > 255 else 255
    if greatest != full:
        values = np.rint(values * (full / greatest))
    pixels = values.astype(np.uint16 if full > 255 else np.uint8)
    if bitmap:
        pixels = 255 - pixels  # 1 is black
    return pixels.reshape((height, width, 3) if channels == 3 else (height, width))


def _text(body: bytes, count: int, bitmap: bool) -> np.ndarray:
    """Return the first `count` numbers of a text; those of a bitmap are single digits, with or without gaps."""
    body = re.sub(rb"#[^\r\n]*", b"", body)
    if bitmap:
        return np.frombuffer(re.sub(rb"[^01]", b"", body)[:count], np.uint8) - ord("0")
    return np.array([int(number) for number in body.split(maxsplit=count)[:count]], np.uint32)


def _bits(body: bytes, width: int, height: int) -> np.ndarray:
    """Return the bits of rows that each begin with a byte of their own; none if there are too few."""
    across = -(-width // 8)
    if len(body) < across * height:
        return np.zeros(0, np.uint8)
    rows = np.frombuffer(body, np.uint8, across * height).reshape(height, across)
    return np.unpackbits(rows, axis=1)[:, :width].ravel()


def _numbers(body: bytes, count: int, kind: str) -> np.ndarray:
    """Return the first `count` binary numbers, or as many as there are."""
    size = np.dtype(kind).itemsize
    return np.frombuffer(body, kind, min(len(body) // size, count))
