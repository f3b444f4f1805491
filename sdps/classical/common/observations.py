"""What every classical method starts from: checked images of the object's pixels, and their rank."""

import logging
from dataclasses import dataclass

import numpy as np

from render.shared.errors import InputError

_log = logging.getLogger(__name__)

REC601 = (0.299, 0.587, 0.114)
"""Rec. 601 weights of R, G, B, as in the DiLiGenT benchmark's own baseline; blue is the noisiest channel there."""

MEAN = (1 / 3, 1 / 3, 1 / 3)
"""Equal weights of R, G, B."""

_NO_VARIATION = 1e-4
"""Spread of a set over its brightest value below which nothing moved, neither lamp nor shading."""


@dataclass(frozen=True, eq=False)
class Observations:
    """The images of an object under changing light, at its pixels.

    Attributes:
        values: (L, P, C) float32, linear radiance; C is 3, or 1 for grey images.
        mask: (H, W) bool with P true pixels, in row-major order.
    """

    values: np.ndarray
    mask: np.ndarray

    @property
    def count(self) -> int:
        """Number of images L."""
        return len(self.values)

    def grey(self) -> np.ndarray:  # (P, L)
        """Return the mean of the channels, (P, L) float64: one intensity profile per row."""
        parts = MEAN if self.values.shape[-1] == 3 else (1.0,)
        return np.tensordot(self.values, np.array(parts), axes=(-1, 0)).T.astype(np.float64, order="C")

    def to_map(self, values: np.ndarray, background: float = 0.0) -> np.ndarray:  # (H, W, ...)
        """Lay values (P, ...) out as a float32 map (H, W, ...)."""
        values = np.asarray(values)
        result = np.full((*self.mask.shape, *values.shape[1:]), background, np.float32)
        result[self.mask] = values
        return result


def observe(images: np.ndarray, mask: np.ndarray, *, minimum: int = 3) -> Observations:
    """Check images and keep those of the object's pixels.

    Args:
        images: (L, H, W, 3) or (L, H, W), linear radiance.
        mask: (H, W) bool.
        minimum: Fewest images the method can work with.

    Raises:
        InputError: sizes that differ, too few images, an empty mask, non-finite values, or images without any change
            of shading. Black images only draw a warning.
    """
    images, mask = np.asarray(images), np.asarray(mask, bool)
    images = images[..., None] if images.ndim == 3 else images
    if images.ndim != 4 or images.shape[1:3] != mask.shape or images.shape[3] not in (1, 3):
        raise InputError(f"images of shape {images.shape} do not fit a mask of {mask.shape}; want (L, H, W, 3)")
    if len(images) < minimum:
        raise InputError(f"the method needs at least {minimum} images, got {len(images)}")
    if not mask.any():
        raise InputError("the mask is empty; mark the object's pixels")
    values = images[:, mask].astype(np.float32)
    if not np.isfinite(values).all():
        raise InputError("the images contain NaN or infinite values inside the mask; repair them first")
    peak = float(values.max())
    if peak <= 0.0:
        raise InputError("all images are black inside the mask")
    if float((values.max(0) - values.min(0)).max()) < _NO_VARIATION * peak:
        raise InputError("all images are alike inside the mask; photometric stereo needs light that moves")
    black = int((values.max((1, 2)) <= 0.0).sum())
    if black:
        _log.warning("%d of %d images are black inside the mask; their lights cannot be found", black, len(values))
    return Observations(values, mask)
