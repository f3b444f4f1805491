"""The curve of sRGB (IEC 61966-2-1)."""

import numpy as np


def to_srgb(linear: np.ndarray) -> np.ndarray:
    """Return values in [0, 1] on the sRGB curve, linear ones clipped to that range; floats of the same type."""
    linear = np.clip(linear, 0.0, 1.0)
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)


def from_srgb(values: np.ndarray) -> np.ndarray:
    """Undo `to_srgb`."""
    return np.where(values <= 0.04045, values / 12.92, ((values + 0.055) / 1.055) ** 2.4)
