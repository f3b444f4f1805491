"""The curve of sRGB (IEC 61966-2-1)."""

import numpy as np


def encode_srgb(linear: np.ndarray) -> np.ndarray:
    """Return linear values on the sRGB curve, of the same type, both from 0 to 1; others are clipped."""
    linear = np.clip(linear, 0.0, 1.0)
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)


def decode_srgb(values: np.ndarray) -> np.ndarray:
    """Return the linear values of sRGB values, of the same type."""
    return np.where(values <= 0.04045, values / 12.92, ((values + 0.055) / 1.055) ** 2.4)
