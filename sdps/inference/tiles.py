"""Large objects in tiles, so that memory does not grow with the size of the pictures.

A tile's outer part has a halo as wide as the network sees, and begins at a multiple of what its strides ask for, so
that the inner parts together are what the whole would have given.
"""

import ctypes
import sys
from collections.abc import Iterator
from math import ceil
from typing import NamedTuple

import numpy as np

TILE_BYTES = 7 * 2**28
"""Memory for what networks make of a tile (1.75 GiB); objects whose box fits are one tile."""
PIXEL_BYTES = 2700
"""Memory a network takes per pixel, for any number of images: feature maps at full size, measured."""
_LEAST_SIDE = 64
_BAND_PIXELS = 2**20


class Tile(NamedTuple):
    """A rectangle of an image and the larger one that is looked at for it."""

    rows: slice
    columns: slice
    outer_rows: slice
    outer_columns: slice

    @property
    def inner(self) -> tuple[slice, slice]:
        """The place in the whole."""
        return self.rows, self.columns

    @property
    def within(self) -> tuple[slice, slice]:
        """The place in the outer part."""
        pairs = ((self.rows, self.outer_rows), (self.columns, self.outer_columns))
        rows, columns = (slice(own.start - outer.start, own.stop - outer.start) for own, outer in pairs)
        return rows, columns


def release_memory() -> None:
    """Return freed memory to the system, where the C library (glibc) would keep up to a gigabyte of it."""
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None) if sys.platform == "linux" else None
    if trim is not None:
        trim(0)


def tiles(mask: np.ndarray, most: int, halo: int, multiple: int = 1) -> list[Tile]:
    """Cut a mask (H, W) into tiles of at most about `most` pixels with their halos; those without object are left out.

    Args:
        mask: (H, W) bool, the object.
        most: Pixels; one tile if all fit.
        halo: Pixels around a tile that are looked at.
        multiple: Of which tiles and halos begin and end, but at the end of the image.
    """
    height, width = mask.shape
    if mask.size <= most:
        return [Tile(*2 * (slice(0, height), slice(0, width)))]
    halo = ceil(halo / multiple) * multiple
    side = max(int(most**0.5) - 2 * halo, _LEAST_SIDE)
    # Of a narrow image the tiles may be as long as it leaves room for.
    across = min(width, max(side, int(most / min(height, side + 2 * halo)) - 2 * halo))
    down = max(int(most / min(width, across + 2 * halo)) - 2 * halo, _LEAST_SIDE)
    found = [
        Tile(rows, columns, _widen(rows, halo, height), _widen(columns, halo, width))
        for rows in _cut(height, down, multiple)
        for columns in _cut(width, across, multiple)
    ]
    return [tile for tile in found if mask[tile.inner].any()]


def _cut(length: int, most: int, multiple: int) -> Iterator[slice]:
    """Cut a length into parts of about equal length, each a multiple but the last."""
    count = ceil(length / most)
    step = ceil(length / count / multiple) * multiple
    return (slice(start, min(start + step, length)) for start in range(0, length, step))


def _widen(part: slice, halo: int, length: int) -> slice:
    return slice(max(part.start - halo, 0), min(part.stop + halo, length))


def split(count: int, most: int) -> list[slice]:
    """Return slices of `count` things, of `most` and a rest, to work on one after another."""
    return [slice(start, min(start + most, count)) for start in range(0, count, most)]


def split_rows(shape: tuple[int, ...]) -> list[slice]:
    """Return the rows of a picture (H, W, ...) that are worked on at once: those with about a million pixels."""
    return split(shape[0], max(1, _BAND_PIXELS // shape[1]))
