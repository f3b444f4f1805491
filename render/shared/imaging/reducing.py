"""Pictures reduced by area averaging, as a coarser sensor would have recorded them."""

import math

import cv2
import numpy as np

from render.shared.errors import InputError

_LEAST_SIDE = 8


def check_scale(scale: float) -> float:
    """Return a scale in (0, 1].

    Raises:
        InputError: anything else.
    """
    if isinstance(scale, bool) or not isinstance(scale, (int, float)) or not (math.isfinite(scale) and 0 < scale <= 1):
        raise InputError(f"scale (--scale) must be a number above 0 and at most 1, got {scale}; 0.5 halves the sides")
    return float(scale)


def smaller_shape(shape: tuple[int, int], scale: float) -> tuple[int, int]:
    """Return the sides (H, W) of a picture once it is reduced.

    Raises:
        InputError: less than 8 pixels would be left of a side.
    """
    if scale == 1.0:
        return shape
    height, width = (round(side * scale) for side in shape)
    if min(height, width) < _LEAST_SIDE:
        raise InputError(
            f"scale (--scale) {scale:g} leaves {width}x{height} pixels of pictures of {shape[1]}x{shape[0]}; give a "
            "larger one"
        )
    return height, width


def reduce_image(image: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """Return an image (H, W) or (H, W, C) float32 at a smaller size, every pixel the mean of the area it covers."""
    if image.shape[:2] == shape:
        return image
    return cv2.resize(image, shape[::-1], interpolation=cv2.INTER_AREA)


def reduce_mask(mask: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """Return a mask (H, W) bool at a smaller size, true where at least half of a pixel's area is."""
    return mask if mask.shape == shape else reduce_image(mask.astype(np.float32), shape) >= 0.5
