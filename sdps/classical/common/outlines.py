"""Small geometry that several methods share: unit normals, and which way is out of the object's outline."""

import numpy as np
from scipy import ndimage

MIN_CONDITION = 1e-3
"""Smallest over largest singular value of the light matrix below which lights count as coplanar."""


def unit_normals(vectors: np.ndarray) -> np.ndarray:  # (P, 3)
    """Return vectors (P, 3) at length 1; (0, 0, 1) where one is zero."""
    length = np.linalg.norm(vectors, axis=1, keepdims=True)
    return np.where(length > 0.0, vectors / np.maximum(length, 1e-300), [0.0, 0.0, 1.0])


def outward_gradient(mask: np.ndarray, smoothing: float) -> np.ndarray:  # (P, 2)
    """Return the slope, downhill, of the smoothed mask at its pixels: out of the object, y up, zero well inside.

    The object goes on beyond the image's frame, so that an outline cut by the frame has no slope there.

    Args:
        mask: (H, W) bool with P true pixels.
        smoothing: Standard deviation of the Gaussian in pixels.
    """
    soft = ndimage.gaussian_filter(mask.astype(float), smoothing, mode="nearest")
    return np.stack([-np.gradient(soft, axis=1), np.gradient(soft, axis=0)], axis=-1)[mask]
