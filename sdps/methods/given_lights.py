"""What photographs say of lights that are given: how strong each was, and whether the directions are theirs.

Two witnesses are heard. A lighting network finds the directions again, to a few degrees on objects with an outline, and
may be wrong on reliefs. Least squares under the given directions leaves a small residual only if each picture has its
own light, and normals without curl only if no axis is flipped; it says nothing of a half turn.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import NamedTuple

import cv2
import numpy as np
from scipy.optimize import linear_sum_assignment

from render.shared.imaging.reducing import reduce_image
from render.shared.imaging.vectors import unit
from render.shared.seeds import generator
from sdps.core.intensities import scale_to_mean
from sdps.core.metrics import angle_degrees
from sdps.inference.image_source import ImageSource
from sdps.inference.stray_light import remove_stray_light, stray_light

_SIDE = 96
"""Longest side of the reduced images: enough for smooth normals, and noise averages out."""
_PIXELS = 1500
"""Pixels that intensities and residuals are measured on at most."""
_ROUNDS = 6
_DARK = 0.05  # shading, relative to the pixel's brightest, below which a picture tells nothing of its light
_LEVEL = 0.1  # residual, relative to the pixel's mean, that counts half
_FEWEST_TO_CARRY = 8  # lights; the map has nine numbers
_CARRIED = 5.0  # degrees between the directions a network finds, carried, and the known ones, on average
_PRIOR = 0.2  # weight of the network's intensity, as a share of the data's, where Lambert's law fits
_MISFIT = 0.2  # residual, relative to the images' mean, of an object that does not fit it

AXES = tuple(
    np.diag((x, y, 1.0)) @ (np.eye(3)[[1, 0, 2]] if swapped else np.eye(3))
    for swapped, y, x in product((False, True), (1.0, -1.0), (1.0, -1.0))
)
"""The eight ways to name the picture's axes, (3, 3) each, the right one first."""
_HALF_TURN = 3
"""Place in `AXES` of x and y both flipped: normals without curl stay so, and the surface is turned inside out."""
_APART, _NEAR = 15.0, 12.0
"""Degrees between given lights and a network's: surely no longer its error; surely no chance."""
_OUTWARD, _MORE = 0.4, 0.1
"""Mean outward part of normals along an outline, 0.54 and more on every object with one, real or rendered; and how much
more of it another reading must have."""
_FEWEST_OUTLINE, _FEWEST_ROWS = 20, 6


class Reading(NamedTuple):
    """One way to read a file of lights.

    Attributes:
        axes: (3, 3), what the directions are multiplied by.
        order: (L,), which row belongs to each picture.
        sorting: Name of the order: empty as it is, `sorted` (by text, p1, p10, p2), `reversed` or `other`.
        apart: Mean angle in degrees to the directions a network finds.
    """

    axes: np.ndarray
    order: np.ndarray
    sorting: str
    apart: float


class LightFit(NamedTuple):
    """How given lights fit photographs.

    Attributes:
        given: The lights as they are given.
        better: The reading that fits, where that is another; else None.
        sure: Which of two readings that differ by a half turn is right is known.
    """

    given: Reading
    better: Reading | None
    sure: bool


@dataclass(frozen=True, eq=False)
class ReducedImages:
    """Images of the object's box at low resolution, without stray light.

    Attributes:
        values: (L, P) float64, grey radiance of the object's pixels, mean 1.
        mask: (h, w) bool, P true pixels, all of them wholly on the object.
        outline: (h, w) bool, pixels of `mask` at the object's rim that do not touch the frame.
    """

    values: np.ndarray
    mask: np.ndarray
    outline: np.ndarray


def reduce_images(images: ImageSource, mask: np.ndarray) -> ReducedImages:
    """Read images (L, H, W, 3) one at a time and reduce the object's box to a hundred pixels a side.

    Args:
        images: Linear radiance of any overall scale.
        mask: (H, W) bool, not empty.
    """
    read, share = read_small(images, mask, range(len(images)), _SIDE)
    small = share > (0.99 if (share > 0.99).sum() >= 50 else 0.5)
    values = read[:, small] / np.maximum(share, 1e-6)[small][:, None]  # (L, P, 3)
    values = remove_stray_light(values, stray_light(values)).mean(-1).astype(np.float64)
    rows, columns = _box(mask)
    return ReducedImages(values / max(values.mean(), 1e-12), small, small & _rim(mask, rows, columns, small.shape))


def read_small(
    images: ImageSource, mask: np.ndarray, numbers: Sequence[int], side: int
) -> tuple[np.ndarray, np.ndarray]:
    """Read some images, one at a time, and reduce the object's box to at most `side` pixels a side.

    Args:
        images: (L, H, W, 3).
        mask: (H, W) bool, not empty.
        numbers: Which images.
        side: Of the box's longer side.

    Returns:
        Images (l, h, w, 3) float32, black outside the object, and the object's share of each pixel, (h, w).
    """
    rows, columns = _box(mask)
    inside = mask[rows, columns]
    shrink = max(1.0, max(inside.shape) / side)
    shape = max(1, round(inside.shape[0] / shrink)), max(1, round(inside.shape[1] / shrink))
    found = []
    for number in numbers:
        image = np.asarray(images[number : number + 1])[0][rows, columns].astype(np.float32)
        found.append(reduce_image(np.where(inside[..., None], image, np.float32(0.0)), shape))
    return np.stack(found), reduce_image(inside.astype(np.float32), shape)


def _box(mask: np.ndarray) -> tuple[slice, slice]:
    """Return the rows and columns of the object's box in a mask (H, W)."""
    lines = (np.flatnonzero(mask.any(axis=axis)) for axis in (1, 0))
    rows, columns = (slice(int(found[0]), int(found[-1]) + 1) for found in lines)
    return rows, columns


def _rim(mask: np.ndarray, rows: slice, columns: slice, shape: tuple[int, int]) -> np.ndarray:
    """Return where the reduced box of a mask (H, W) is near the object's outline, but not where the frame cuts it."""
    box = mask[rows, columns].astype(np.uint8)
    whole = np.pad(cv2.resize(box, shape[::-1], interpolation=cv2.INTER_NEAREST), 1)
    rim = cv2.erode(whole, np.ones((5, 5), np.uint8))[1:-1, 1:-1] == 0
    top, left = rows.start == 0, columns.start == 0
    bottom, right = rows.stop == mask.shape[0], columns.stop == mask.shape[1]
    for cut, edge in ((top, np.s_[:3]), (bottom, np.s_[-3:]), (left, np.s_[:, :3]), (right, np.s_[:, -3:])):
        if cut:
            rim[edge] = False
    return rim


def fit_normals(
    images: ReducedImages, directions: np.ndarray, intensities: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Fit Lambert's law robustly, by least squares of which what is in shadow or shines counts less and less.

    Args:
        images: Of L images and P pixels.
        directions: (L, 3) unit.
        intensities: (L,).

    Returns:
        Normals times albedo (P, 3), weights (L, P) of the observations, and their shading (L, P).
    """
    seen = images.values / intensities[:, None]
    shading = np.zeros_like(seen)
    weights, normals = np.ones_like(seen), np.zeros((seen.shape[1], 3))
    floor = 1e-3 * np.eye(3)
    for _ in range(4):
        squares = np.einsum("lp,la,lb->pab", weights, directions, directions)
        normals = np.linalg.solve(squares + floor, np.einsum("lp,la,lp->pa", weights, directions, seen)[..., None])
        normals = normals[..., 0]
        shading = np.maximum(directions @ normals.T, 0.0)
        level = _LEVEL * np.abs(seen).mean(axis=0) + 1e-6
        weights = (shading > _DARK * shading.max(axis=0)) / (1.0 + ((seen - shading) / level) ** 2)
    return normals, weights, shading


def find_intensities(images: ReducedImages, directions: np.ndarray, start: np.ndarray) -> np.ndarray:
    """Return intensities (L,) float32, mean 1, under which one matte surface explains the images best.

    What a network says counts where the images say little, and most where Lambert's law does not fit.

    Args:
        images: Of L images.
        directions: (L, 3) unit, known.
        start: (L,), intensities that a network finds.
    """
    images = _sample_pixels(images)
    start = scale_to_mean(np.asarray(start, np.float64))
    held = _PRIOR * (1.0 + (_measure_misfit(images, directions, start) / _MISFIT) ** 4)
    found = start.copy()
    for _ in range(_ROUNDS):
        _, weights, shading = fit_normals(images, directions, found)
        prior = held * (weights * shading**2).sum(axis=1).mean()
        ratio = (weights * shading * images.values).sum(axis=1) + prior * start
        found = ratio / ((weights * shading**2).sum(axis=1) + prior)
        found = scale_to_mean(found)
    return np.maximum(found, 1e-3).astype(np.float32)


def carry_intensities(directions: np.ndarray, seen: np.ndarray, strengths: np.ndarray) -> np.ndarray:
    """Return the intensities (L,), mean 1, that a network would find if it knew the directions.

    Images of a matte surface tell intensities times directions only up to a linear map of all of them (Hayakawa, JOSA
    1994), and a network errs much like that: in both. The map that brings its directions to the known ones mends its
    intensities, too. Where no map does that, as with rows in another order, or too few lights tell it, they stay.

    Args:
        directions: (L, 3) unit, known.
        seen: (L, 3) unit, what a network finds.
        strengths: (L,), the same for intensities.
    """
    start = scale_to_mean(np.asarray(strengths, np.float64))
    if len(start) < _FEWEST_TO_CARRY:
        return start
    # The map after which nothing of the vectors lies across the known directions.
    vectors = seen * start[:, None]
    across = np.eye(3) - directions[:, :, None] * directions[:, None, :]  # (L, 3, 3)
    system = np.einsum("lab,lc->labc", across, vectors).reshape(-1, 9)  # (3 L, 9)
    carried = vectors @ np.linalg.svd(system, full_matrices=False)[2][-1].reshape(3, 3).T
    found = (carried * directions).sum(axis=1)
    carried, found = carried * np.sign(found.sum()), found * np.sign(found.sum())
    if found.min() <= 0.0:
        return start
    found = scale_to_mean(found)
    return found if angle_degrees(carried, directions).mean() < _CARRIED else start


def compare_lights(
    images: ReducedImages, files: Sequence[str], directions: np.ndarray, intensities: np.ndarray, seen: np.ndarray
) -> LightFit:
    """Look whether given lights are those of the photographs, or would be after another reading of their file.

    Args:
        images: Of L images.
        files: (L,) names of the pictures, in the order of the images.
        directions: (L, 3) unit, as given.
        intensities: (L,), given or found.
        seen: (L, 3) unit, what a network finds.
    """
    order, sorting = _find_order(images, files, directions, intensities, seen)
    readings = [_read(directions, axes, order, sorting, seen) for axes in AXES]
    given = _read(directions, AXES[0], np.arange(len(files)), "", seen)
    normals = fit_normals(images, directions[order], intensities[order])[0]
    best, sure = _find_axes(images, normals, readings)
    changed = bool(sorting) or best > 0
    return LightFit(given, readings[best] if changed else None, sure)


def _read(directions: np.ndarray, axes: np.ndarray, order: np.ndarray, sorting: str, seen: np.ndarray) -> Reading:
    return Reading(axes, order, sorting, float(angle_degrees(seen, directions[order] @ axes.T).mean()))


def _sample_pixels(images: ReducedImages) -> ReducedImages:
    """Return the images with some of their pixels only, the same each time."""
    chosen = generator(0, "given lights").permutation(images.values.shape[1])[:_PIXELS]
    return replace(images, values=images.values[:, np.sort(chosen)])


def _measure_misfit(images: ReducedImages, directions: np.ndarray, intensities: np.ndarray) -> float:
    """Return the mean absolute residual of Lambert's law, relative to the images' mean."""
    shading = fit_normals(images, directions, intensities)[2]
    return float(np.abs(images.values / intensities[:, None] - shading).mean())


def _find_order(
    images: ReducedImages, files: Sequence[str], directions: np.ndarray, intensities: np.ndarray, seen: np.ndarray
) -> tuple[np.ndarray, str]:
    """Return which row belongs to each picture, (L,), and the order's name; the given one unless another is clear."""
    images = _sample_pixels(images)
    plain = np.arange(len(files))
    rank = {name: place for place, name in enumerate(sorted(files))}

    def nearest(order: np.ndarray) -> float:
        return min(_read(directions, axes, order, "", seen).apart for axes in AXES)

    now, misfit = nearest(plain), _measure_misfit(images, directions, intensities)
    for order, name in ((np.array([rank[file] for file in files]), "sorted"), (plain[::-1], "reversed")):
        if (order == plain).all():
            continue
        left = _measure_misfit(images, directions[order], intensities[order])
        if (nearest(order) < 0.4 * now and now > _APART and left < misfit) or left < 0.5 * misfit:
            return order, name
    if len(files) >= _FEWEST_ROWS and now > _APART:
        pairs = angle_degrees(seen[:, None], directions[None])
        order = linear_sum_assignment(pairs)[1]
        left = _measure_misfit(images, directions[order], intensities[order])
        if pairs[plain, order].mean() < min(_NEAR, 0.4 * now) and left < 0.7 * misfit:
            return order, "other"
    return plain, ""


def _find_axes(images: ReducedImages, normals: np.ndarray, readings: Sequence[Reading]) -> tuple[int, bool]:
    """Return the place in `AXES` of the reading that fits, and whether a half turn of it is ruled out.

    Args:
        images: Reduced images.
        normals: (P, 3) of any length, fitted under the first reading.
        readings: One for each of `AXES`.
    """
    curls, outward = _curls(images, normals), _outward(images, normals)
    apart = np.array([reading.apart for reading in readings])
    best = int(np.argmin(apart))
    clear = apart[0] > _APART and apart[best] < 0.5 * apart[0]
    if outward is not None and outward.max() > _OUTWARD:
        # The outline tells a half turn, and the network's word is good on objects that have one.
        gain = outward[best] - outward[0]
        seconded = curls[best] < 0.75 * curls[0] or gain > 2 * _OUTWARD
        likely = (clear and curls[best] < 1.25 * curls[0]) or (apart[best] < 0.8 * apart[0] and seconded)
        return (best if likely and outward[best] > _OUTWARD and gain > _MORE else 0), True
    classes = np.flatnonzero(curls < 1.001 * curls.min())
    if curls.min() < 0.6 * curls[0]:  # the two readings without curl; which, the network says as well as it can
        return int(classes[np.argmin(apart[classes])]), False
    return 0, not (clear and best == _HALF_TURN)


def _curls(images: ReducedImages, normals: np.ndarray) -> np.ndarray:
    """Return how far normals are from being those of a surface under each of `AXES`, (8,): mean |curl| n_z^2."""
    length = np.linalg.norm(normals, axis=1)
    upright = (normals[:, 2] > 0.15 * length) & (length > 0.1 * np.median(length))
    fields = np.full((*images.mask.shape, 3), np.nan)
    fields[images.mask] = np.where(upright[:, None], normals / np.maximum(length, 1e-9)[:, None], np.nan)
    slopes = -fields[..., :2] / fields[..., 2:]
    # Means over 2x2 pixels; rows run down and y runs up.
    along_x = (slopes[:-1, 1:] + slopes[1:, 1:] - slopes[:-1, :-1] - slopes[1:, :-1]) / 2
    along_y = (slopes[:-1, :-1] + slopes[:-1, 1:] - slopes[1:, :-1] - slopes[1:, 1:]) / 2
    weight = fields[1:, 1:, 2] ** 2
    found = []
    for axes in AXES:
        (p_y, q_x) = along_y @ axes[0, :2], along_x @ axes[1, :2]
        curl = np.abs(p_y - q_x) * weight
        found.append(float(np.nanmean(curl)) if np.isfinite(curl).any() else 0.0)
    return np.array(found)


def _outward(images: ReducedImages, normals: np.ndarray) -> np.ndarray | None:
    """Return the mean outward part of unit normals along the outline under each of `AXES`, (8,); None without one."""
    rim = images.outline[images.mask]
    if rim.sum() < _FEWEST_OUTLINE:
        return None
    soft = cv2.GaussianBlur(np.pad(images.mask.astype(np.float32), 8), (0, 0), 3)[8:-8, 8:-8]
    down, right = np.gradient(soft)
    away = np.stack([-right, down], axis=-1)[images.outline]  # (N, 2), y up
    away, facing = unit(away), unit(normals[rim])
    return np.array([float(((facing @ axes.T)[:, :2] * away).sum(axis=1).mean()) for axes in AXES])
