"""What a picture's values say it is: masks have two values, pictures of normals decode to unit vectors."""

import cv2
import numpy as np

from sdps.photos.pictures.picture_names import MASK, NORMALS

_SAMPLES = 1 << 14
_SMALLEST = 256
"""Pixels of a picture that is judged at all."""

_PART = 0.005
"""Least share of the frame that either value of a mask has."""

_CONTRAST = 0.25
_SAME = 0.5
"""Least share of sampled pixels on either side that have its usual value; the others lie along edges."""

_SOFT, _SOFT_LOSSY = 2, 8
"""Width in pixels of a mask's edge, smoothed, or blurred by lossy compression in blocks of 8."""

_OFF, _OFF_LOSSY = 0.004, 0.012
"""How far from its value a mask may be away from edges; compression keeps even blocks even."""

_EQUAL = 0.95

_LENGTH, _LENGTH_LOSSY = 0.03, 0.08
"""How far from 1 a vector's length may be, after rounding to 8 bits or lossy compression."""

_UNIT, _UNIT_LOSSY = 0.9, 0.85
"""Least share of vectors that are unit; others lie where object and background blend."""

_GREY = 0.02


def judge_content(pixels: np.ndarray, *, lossy: bool = False) -> str | None:
    """Return `a mask` or `normals` if the values are those of one and of no photograph, otherwise None.

    A mask has two colours, far apart, and others along its edges only. A picture of normals has, but for a black, grey
    or white background, unit vectors with positive z, coded as 2 v - 1 (floating point: coded so, or as they are),
    that are not all grey.

    Args:
        pixels: (H, W, 3) uint8, uint16, or float32.
        lossy: They come from a lossy file and are a little off.
    """
    if pixels.shape[0] * pixels.shape[1] < _SMALLEST:
        return None
    step = max(1, int(np.sqrt(pixels.shape[0] * pixels.shape[1] / _SAMPLES)))
    few = _unit(pixels[::step, ::step])
    if not np.isfinite(few).all():
        return None
    if _may_be_mask(few, lossy) and _is_mask(pixels, lossy):
        return MASK
    return NORMALS if _are_normals(few, lossy) else None


def like_mask(pixels: np.ndarray) -> bool:
    """Tell whether nine tenths of (H, W, 3) pixels are near their darkest or brightest value, or all are bright."""
    grey = _unit(pixels).mean(-1)
    low, high = float(grey.min()), float(grey.max())
    if high == low:
        return high > 0.5
    return float((np.minimum(grey - low, high - grey) <= 0.15 * (high - low)).mean()) >= 0.9


def _unit(pixels: np.ndarray) -> np.ndarray:
    """Return values as float32, full scale = 1."""
    if pixels.dtype.kind == "f":
        return pixels
    return pixels.astype(np.float32) / np.float32(np.iinfo(pixels.dtype).max)


def _may_be_mask(few: np.ndarray, lossy: bool) -> bool:
    grey = few.mean(-1)
    low, high = float(grey.min()), float(grey.max())
    if high - low < _CONTRAST:
        return False
    off = (_OFF_LOSSY if lossy else _OFF) * high
    bright = grey > (low + high) / 2
    levels = [grey[part] for part in (bright, ~bright)]
    return all((np.abs(level - np.median(level)) <= off).mean() >= _SAME for level in levels)


def _is_mask(pixels: np.ndarray, lossy: bool) -> bool:
    """Look at all pixels: two even colours with a soft edge between."""
    values = _unit(pixels)
    grey = values.mean(-1)
    low, high = float(grey.min()), float(grey.max())
    bright = grey > (low + high) / 2
    if not _PART <= bright.mean() <= 1 - _PART:
        return False
    off = (_OFF_LOSSY if lossy else _OFF) * high
    if not lossy and all(_even(values[part], 0.0) for part in (bright, ~bright)):
        return True
    width = _SOFT_LOSSY if lossy else _SOFT
    square = np.ones((2 * width + 1, 2 * width + 1), np.uint8)
    inside = [
        cv2.erode(part.astype(np.uint8), square) > 0 for part in (bright, ~bright)
    ]  # the frame's border counts not
    return all(part.mean() >= _PART and _even(values[part], off) for part in inside)


def _even(colours: np.ndarray, off: float) -> bool:
    """Tell whether nearly all colours (N, 3) are the same, which noise forbids, and none differs by more than `off`."""
    usual = np.median(colours[:: max(1, len(colours) // 1000)], axis=0)
    difference = np.abs(colours - usual).max(-1)
    return bool(difference.max() <= off and (difference <= _OFF / 10).mean() >= _EQUAL)


def _are_normals(few: np.ndarray, lossy: bool) -> bool:
    flat = np.clip(few.reshape(-1, 3), -2, 2)  # radiance has no bounds, and its square may overflow
    ways = [2 * flat - 1]
    if few.dtype.kind == "f" and flat.min() < -0.01:
        ways.append(flat)
    return any(_unit_vectors(way, flat, lossy) for way in ways)


def _unit_vectors(vectors: np.ndarray, colours: np.ndarray, lossy: bool) -> bool:
    """Tell whether vectors (N, 3) are unit with positive z, but for the background; they must not be greys."""
    paper = np.array([[0, 0, 0], [0.5, 0.5, 0.5], [1, 1, 1]], np.float32)
    nearest = np.abs(colours[:, None] - paper).max(-1).min(1)
    vectors = vectors[nearest > _GREY]
    if len(vectors) < max(64, 0.01 * len(colours)):
        return False
    tolerance = _LENGTH_LOSSY if lossy else _LENGTH
    unit = (np.abs(np.linalg.norm(vectors, axis=1) - 1) <= tolerance) & (vectors[:, 2] > 0)
    if unit.mean() < (_UNIT_LOSSY if lossy else _UNIT):
        return False
    sides = np.abs(vectors[:, :2].mean(0))
    return bool(sides.max() < 0.8 * vectors[:, 2].mean() and (np.ptp(vectors, axis=0) > tolerance).any())
