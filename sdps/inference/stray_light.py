"""Light that reaches the camera from elsewhere, taken off photographs: room light, flare, a sensor's black level.

Where the object is in shadow, an image of one distant light is black, but for light from the object itself. Networks
learn from such images, and answer to a veil of half a per cent over the shadows with errors of degrees
(docs/studies/stray-light.md). Rendered images have no veil and stay as they are.

Legend: L images, P pixels.
"""

import numpy as np

_SHADOW = 0.05
"""A pixel counts as in shadow where it has less than this share of its bright values."""
_BRIGHT = 75.0
"""Percentile of a pixel's values over the images that is called bright; above are highlights, of metals above all."""
_FEWEST = 50
"""Pixels in shadow from which on an image shows its own level; others have the median of those that do."""
_MOST = 2.0
"""Times the images' median that a level is at most: what only some images show in shadow is light from the object."""
_NOISE = 3.0
"""Times the level up to which it hides everything."""


def stray_light(values: np.ndarray) -> np.ndarray:
    """Return what the images show in shadow: the level of stray light of every image and channel.

    Args:
        values: (L, P, 3) float32, linear radiance of object pixels, as many as tell (`image_source.survey`).

    Returns:
        (L, 3) float32, zero where nothing is in shadow.
    """
    shadow = _find_shadow(values)
    level = np.full((len(values), 3), np.nan, np.float32)
    for image, inside, found in zip(values, shadow, level, strict=True):
        for channel in np.flatnonzero(inside.sum(0) >= _FEWEST):
            found[channel] = np.median(image[inside[:, channel], channel])
    for column in level.T:
        known = column[np.isfinite(column)]
        column[np.isnan(column)] = np.median(known) if len(known) else 0.0
    most = _MOST * np.abs(np.median(level, axis=0))
    return np.clip(level, -most, most)


def _find_shadow(values: np.ndarray) -> np.ndarray:  # (L, P, ...) bool
    """Find where values (L, P, ...) float32 of object pixels are in shadow."""
    strength = values.mean(axis=tuple(range(1, values.ndim)), keepdims=True, dtype=np.float64)  # of the light, about
    relative = values / np.maximum(strength.astype(np.float32), np.float32(1e-12))
    return relative < _SHADOW * np.percentile(relative, _BRIGHT, axis=0)


def remove_stray_light(images: np.ndarray, level: np.ndarray) -> np.ndarray:
    """Return images less their stray light; up to three times its level they are black, as noise in shadow is.

    Below 0, where too much was taken off for a black level or a dark frame, the level is added back.

    Args:
        images: (L, ..., 3) float32.
        level: (L, 3), of `stray_light`.
    """
    level = level.reshape(len(level), *[1] * (images.ndim - 2), 3)
    return np.where(images > _NOISE * level, np.maximum(images - level, 0.0), np.float32(0.0))
