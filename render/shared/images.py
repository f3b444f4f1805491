"""Picture files of other layouts: 8 and 16 bits exactly, RGB order, and normals coded as colours.

OpenCV reads and writes them, since Pillow and imageio silently reduce 16-bit RGB to 8 bits. Its reader prints to
standard error on damaged files, so Pillow checks the PNG's checksums first.
"""

import io
from pathlib import Path

import cv2
import numpy as np
from PIL import Image

from render.shared.decoding import check_picture, decoding, silence
from render.shared.errors import InputError
from render.shared.files import read_bytes

MASK_THRESHOLD = 0.01
"""A pixel belongs to the object where the squared length of its decoded normal exceeds this (PS-FCN's rule)."""

_PNG_LEVEL = 6
_FULL = {8: 255, 16: 65535}
_TYPES = {8: np.uint8, 16: np.uint16}


def read_image(path: str | Path, *, channels: int | None = 3) -> np.ndarray:
    """Read a picture at its own depth.

    Args:
        path: The file.
        channels: 3 demands RGB; None takes anything and returns its first channel as (H, W).

    Returns:
        (H, W, 3) RGB or (H, W), uint8 or uint16.

    Raises:
        InputError: missing, damaged, another number of channels, or neither 8 nor 16 bits.
    """
    pixels = _decode(path)
    found = 1 if pixels.ndim == 2 else pixels.shape[2]
    if channels is None:
        return pixels if pixels.ndim == 2 else pixels[..., 2 if found >= 3 else 0]
    if found != channels:
        raise InputError(f"{path}: {found} channel(s) where {channels} are needed; save it as RGB")
    return np.ascontiguousarray(pixels[..., ::-1])


def read_channels(path: str | Path) -> np.ndarray:
    """Read a picture with all its channels at its own depth.

    Returns:
        (H, W, C) uint8 or uint16: grey, RGB, or RGB and alpha.

    Raises:
        InputError: missing, damaged, or neither 8 nor 16 bits.
    """
    pixels = _decode(path)
    if pixels.ndim == 2:
        return pixels[..., None]
    return np.concatenate([pixels[..., 2::-1], pixels[..., 3:]], axis=2) if pixels.shape[2] >= 3 else pixels


def _decode(path: str | Path) -> np.ndarray:
    """Return the pixels as OpenCV has them, BGR, uint8 or uint16."""
    data = read_bytes(path, "no such picture; copy it there or drop it from the list that names it")
    with decoding(path, "a picture"):
        with Image.open(io.BytesIO(data)) as picture:
            check_picture(path, picture, data)
            picture.verify()
        with silence():  # libpng and libtiff print about odd profiles and tags
            pixels = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    if pixels is None:
        raise InputError(f"{path}: damaged or not a picture; copy it again")
    if pixels.dtype not in _TYPES.values():
        raise InputError(f"{path}: pixels are {pixels.dtype}; save it with 8 or 16 bits per channel")
    return pixels


def write_png(path: str | Path, pixels: np.ndarray) -> None:
    """Write (H, W, 3) RGB or (H, W), uint8 or uint16, as PNG; an OSError of the disk passes through."""
    assert pixels.dtype in _TYPES.values() and (pixels.ndim == 2 or pixels.shape[2] == 3), pixels.shape
    ordered = pixels if pixels.ndim == 2 else pixels[..., ::-1]
    _, encoded = cv2.imencode(".png", np.ascontiguousarray(ordered), [cv2.IMWRITE_PNG_COMPRESSION, _PNG_LEVEL])
    Path(path).write_bytes(encoded.tobytes())


def bit_depth(pixels: np.ndarray) -> int:
    """Return 8 or 16."""
    return 8 * pixels.dtype.itemsize


def to_unit(pixels: np.ndarray) -> np.ndarray:
    """Return integer pixels as float32 in [0, 1] of their full scale."""
    return pixels.astype(np.float32) / np.float32(_FULL[bit_depth(pixels)])


def quantise(values: np.ndarray, bits: int) -> np.ndarray:
    """Round linear values, 1 = full scale, to `bits` bits; what is above full scale clips."""
    scaled = np.rint(np.asarray(values, np.float32) * np.float32(_FULL[bits]))
    return np.clip(scaled, 0, _FULL[bits]).astype(_TYPES[bits])


def encode_normals(normals: np.ndarray) -> np.ndarray:  # (H, W, 3) uint8
    """Code normals as colours, round((n + 1) / 2 x 255); the zero normals of the background become 128."""
    return quantise((np.asarray(normals, np.float64) + 1.0) / 2.0, 8)


def decode_normals(pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Decode colours to unit normals (H, W, 3) float32, zero outside the mask, and the mask (H, W) bool.

    The mask holds the pixels whose decoded vector is longer than 0.1, and not near (-1, -1, -1), the black that some
    folders have for background.
    """
    vectors = to_unit(pixels).astype(np.float64) * 2.0 - 1.0
    squared = (vectors**2).sum(-1)
    mask = (squared > MASK_THRESHOLD) & (pixels.max(-1) > 0)
    normals = np.where(mask[..., None], vectors / np.sqrt(np.maximum(squared, MASK_THRESHOLD))[..., None], 0.0)
    return normals.astype(np.float32), mask
