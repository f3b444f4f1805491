"""Grey pictures of a depth map seen from the front and from the sides."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from render.shared.errors import InputError
from render.shared.imaging.vectors import unit
from sdps.core.integration import Depth

_LIGHT = (-0.35, 0.45, 0.82)  # in the viewer's frame
_CLAY = 0.85
_FINER = 2  # samples along the sides of a pixel


def depth_normals(depth: Depth) -> np.ndarray:
    """Return the unit normals (H, W, 3) float32 of a depth map, zero outside the mask.

    A pixel's slope is the mean of those to its neighbours left and right, or above and below; 0 without any.
    """
    z, mask = depth.z.astype(np.float64), depth.mask
    slopes = []
    for axis, sign in ((1, 1.0), (0, -1.0)):
        there = np.logical_and(*_neighbours(mask, axis))
        steps = np.where(there, np.subtract(*_neighbours(z, axis)[::-1]), 0.0)
        padding = [(0, 0), (0, 0)]
        total, number = np.zeros(mask.shape), np.zeros(mask.shape)
        for side in ((1, 0), (0, 1)):
            padding[axis] = side
            total += np.pad(steps, padding)
            number += np.pad(there, padding)
        slopes.append(sign * total / np.maximum(number, 1))
    normals = unit(np.stack([-slopes[0], -slopes[1], np.ones(mask.shape)], axis=-1))
    return np.where(mask[..., None], normals, 0.0).astype(np.float32)


def turned(depth: Depth, degrees: float, height: int, *, colour: np.ndarray | None = None) -> np.ndarray:
    """Draw the surface as seen by a viewer who has walked `degrees` to the right around it.

    The picture is orthographic, and so is the surface in it, every pixel at its place in the photograph. It is shaded
    by the normals of the depth itself, so that it shows what was integrated. Since the turn is about the vertical axis,
    every image row stays a row: its pixels' polyline is drawn segment by segment, the nearest wins, and what faces away
    is left out. There is no surface behind the visible one.

    Args:
        depth: Of `integrate`.
        degrees: Between -90 and 90, exclusively; positive shows the object's right side.
        height: Rows of the picture.
        colour: (H, W, 3) float, linear reflectance in [0, 1]; grey clay if not given.

    Returns:
        (height, height, 3) uint8, white where there is nothing; the mask's box fits the picture at every angle.
    """
    if not (-90 < degrees < 90 and height >= 8):
        raise InputError(f"degrees must be between -90 and 90 and height at least 8, got {degrees:g} and {height}")
    size = _FINER * height
    depth, colour = _of_the_box(depth, colour, _FINER * size)
    mask, z = depth.mask, depth.z.astype(np.float64)
    x = np.broadcast_to(np.arange(mask.shape[1]) - (mask.shape[1] - 1) / 2, mask.shape)
    z = z - (z[mask].min() + z[mask].max()) / 2
    # The same scale at every angle: the box's diagonal in the plane of the turn fits.
    scale = (size - 4 * _FINER) / max(mask.shape[0], np.hypot(mask.shape[1], np.ptp(z[mask])))
    angle = np.radians(degrees)
    across, towards = scale * (x * np.cos(angle) - z * np.sin(angle)), scale * (x * np.sin(angle) + z * np.cos(angle))
    # A row of the picture shows the nearest image row.
    shown = np.rint((np.arange(size) - (size - 1) / 2) / scale + (mask.shape[0] - 1) / 2).astype(int)
    inside = np.flatnonzero((shown >= 0) & (shown < mask.shape[0]))
    lines = shown[inside]
    shades = _shades(depth, angle, colour)
    picture = np.full((size, size, 3), 1.0)
    picture[inside] = _draw(across[lines] + (size - 1) / 2, towards[lines], mask[lines], shades[lines], size)
    linear = picture.reshape(height, _FINER, height, _FINER, 3).mean(axis=(1, 3))
    return (255 * linear ** (1 / 2.2) + 0.5).astype(np.uint8)


def _of_the_box(depth: Depth, colour: np.ndarray | None, side: int) -> tuple[Depth, np.ndarray | None]:
    """Return depth and colour of the mask's box, thinned to sides of about `side` pixels where they are twice that."""
    rows, columns = (np.flatnonzero(depth.mask.any(axis=axis)) for axis in (1, 0))
    every = max(1, int(max(np.ptp(rows), np.ptp(columns))) // side)
    few = slice(rows[0], rows[-1] + 1, every), slice(columns[0], columns[-1] + 1, every)
    z = depth.z[few] if every == 1 else depth.z[few] / np.float32(every)
    return replace(depth, z=z, mask=depth.mask[few]), None if colour is None else colour[few]


def strip(
    depth: Depth, height: int = 256, degrees: Sequence[float] = (-40.0, 0.0, 40.0), *, colour: np.ndarray | None = None
) -> np.ndarray:
    """Return the pictures of `turned` side by side, (height, height x n, 3) uint8."""
    return np.concatenate([turned(depth, angle, height, colour=colour) for angle in degrees], axis=1)


def _neighbours(array: np.ndarray, axis: int) -> tuple[np.ndarray, np.ndarray]:
    """Return everything but the last, and everything but the first along an axis."""
    return np.delete(array, -1, axis), np.delete(array, 0, axis)


def _shades(depth: Depth, angle: float, colour: np.ndarray | None) -> np.ndarray:  # (H, W, 3) float64, linear
    """Shade every pixel under a light that moves with the viewer."""
    right, up, towards = np.array(_LIGHT) / np.linalg.norm(_LIGHT)
    cosine, sine = np.cos(angle), np.sin(angle)
    light = np.array([cosine * right + sine * towards, up, cosine * towards - sine * right])
    shading = 0.08 + 0.92 * np.maximum(depth_normals(depth) @ light, 0.0)
    linear = shading[..., None] * (_CLAY if colour is None else np.clip(colour, 0.0, 1.0))
    return np.broadcast_to(linear, (*depth.mask.shape, 3))


def _draw(across: np.ndarray, towards: np.ndarray, mask: np.ndarray, shades: np.ndarray, width: int) -> np.ndarray:
    """Draw the segments between neighbours of each row (R, W); places are picture columns. Return (R, width, 3)."""
    row, left = np.nonzero(mask[:, 1:] & mask[:, :-1] & (np.diff(across, axis=1) > 0))
    start, stop = across[row, left], across[row, left + 1]
    first = np.ceil(start).astype(int)
    count = np.maximum(np.ceil(stop).astype(int) - first, 0)
    segment = np.repeat(np.arange(len(row)), count)
    column = first[segment] + np.arange(len(segment)) - np.repeat(np.cumsum(count) - count, count)
    kept = (column >= 0) & (column < width)
    segment, column = segment[kept], column[kept]
    row, left = row[segment], left[segment]
    share = (column - start[segment]) / (stop - start)[segment]
    nearness = (1 - share) * towards[row, left] + share * towards[row, left + 1]
    values = (1 - share)[:, None] * shades[row, left] + share[:, None] * shades[row, left + 1]
    order = np.argsort(nearness, kind="stable")  # of equal places the last is kept, the nearest
    picture = np.full((len(mask), width, 3), 1.0)
    picture[row[order], column[order]] = values[order]
    return picture
