"""Photographs that are reduced as they are read: their brightness, their mask, and what is too large all the same."""

from pathlib import Path

import numpy as np

from render.shared.errors import InputError
from render.shared.imaging.reducing import reduce_image, reduce_mask
from sdps.photos.faults import Faults
from sdps.photos.masks import read_mask
from sdps.photos.response import brightness, to_linear

MOST_PIXELS = 50_000_000
"""Of a picture, once reduced: the checks hold one at a time, and 70 bytes for each of its pixels."""
_AT_ONCE = 2**20


def reduce_grey(pixels: np.ndarray, gamma: str | float, shape: tuple[int, int]) -> np.ndarray:
    """Return the linear brightness of pixels (H, W, 3), a few rows at a time, reduced to a shape (h, w)."""
    step = max(1, _AT_ONCE // pixels.shape[1])
    rows = (pixels[start : start + step] for start in range(0, len(pixels), step))
    return reduce_image(np.concatenate([brightness(to_linear(some, gamma)) for some in rows]), shape)


def reduce_linear(pixels: np.ndarray, gamma: str | float, shape: tuple[int, int]) -> np.ndarray:
    """Return pixels (H, W, 3) as linear radiance reduced to a shape, (h, w, 3) float32, one channel at a time."""
    image = np.empty((*shape, 3), np.float32)
    for channel in range(3):  # a whole picture of floats may take a gigabyte
        image[..., channel] = reduce_image(to_linear(pixels[..., channel], gamma), shape)
    return image


def refuse_huge(path: Path, full: tuple[int, int], shape: tuple[int, int], faults: Faults) -> None:
    """Refuse pictures that would fill the memory one by one."""
    if shape[0] * shape[1] > MOST_PIXELS:
        fits = int(20 * (MOST_PIXELS / (full[0] * full[1])) ** 0.5) / 20
        faults.stop(
            f"{path}: is {full[1]}x{full[0]} pixels; more than {MOST_PIXELS // 10**6} million would take more than "
            f"4 GiB of memory; give --scale {fits:g} (in Python load(..., scale={fits:g}))"
        )


def read_reduced_mask(path: Path, full: tuple[int, int], shape: tuple[int, int]) -> np.ndarray:
    """Read a mask of the files' size and reduce it as the pictures are, or one that is of their size already.

    Raises:
        InputError: as `read_mask`, or nothing is left of it.
    """
    try:
        mask = reduce_mask(read_mask(path, full), shape)
    except InputError as error:
        try:
            mask = read_mask(path, shape)
        except InputError:
            raise error from error.__cause__
    if not mask.any():
        raise InputError(f"{path}: nothing is left of the mask once it is reduced; give a larger scale")
    return mask


def scale_note(full: tuple[int, int], shape: tuple[int, int]) -> list[str]:
    """Say from what to what pictures were reduced, if they were."""
    if full == shape:
        return []
    return [f"pictures and mask were reduced from {full[1]}x{full[0]} to {shape[1]}x{shape[0]} pixels (--scale)"]
