"""Albedo on estimated normals and lights, pictures under new lights, and how well both explain the images.

Everything is Lambertian: radiance = albedo x intensity x max(n . l, 0), in the images' own scale. Under near lamps l is
each pixel's own direction, and the intensity counts times its falloff (`sdps.core.geometry`). Images are read a few at
a time and several times over, so that memory does not grow with their number.

Legend: L images, (H, W) their sides, n mask pixels, C = 3 channels.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import cv2
import numpy as np

from render.shared.errors import InputError
from render.shared.progress import repeat, stage
from sdps.core.geometry import Capture, reach
from sdps.core.integration import Depth, check_normals
from sdps.core.intensities import per_channel
from sdps.inference.tiles import split

if TYPE_CHECKING:
    from sdps.inference.image_source import ImageSource

_READ_PIXELS = 2**20  # read at once, whole images
_PART = 2**20  # pixels worked on at once
_BAND = 2**22  # pixels, of larger pictures only the object's rows are read, so many of the object at once
_TRACED = 2**20  # pixels of the box above which shadows are traced on a coarser grid
_LEAST = 0.02  # of a pixel's brightness: smaller residuals do not gain more weight
_LIFT = 1.0  # pixels by which an occluder must rise above a ray, since the depth has errors of its own


class Lamps(NamedTuple):
    """Near lamps, and the surface they stand before.

    Attributes:
        capture: The object before its camera.
        heights: (H, W) z of the surface in pixels, as of `sdps.core.integration.Depth`; not read outside the mask.
        nearness: (L,) rho of the lamps (`sdps.core.geometry`), at least 0 and under 1.
    """

    capture: Capture
    heights: np.ndarray
    nearness: np.ndarray


class _Scene(NamedTuple):
    """Pixels of an object and what lights them, all float32.

    Attributes:
        unit: (n, 3) normals.
        lights: (L, 3).
        intensities: (L, 3).
        places: (n, 3), (X - C) / R; None under distant lights.
        nearness: (L,); of no use without `places`.
    """

    unit: np.ndarray
    lights: np.ndarray
    intensities: np.ndarray
    places: np.ndarray | None
    nearness: np.ndarray

    def shade(self, number: int, some: slice) -> np.ndarray:  # (p, C)
        """Return what some pixels of albedo 1 show under a light."""
        intensity = self.intensities[number]
        if self.places is None:
            return np.maximum(self.unit[some] @ self.lights[number], 0.0)[:, None] * intensity
        one = slice(number, number + 1)
        directions, falloff = reach(self.places[some], self.lights[one], self.nearness[one])
        facing = np.maximum((self.unit[some] * directions[:, 0]).sum(axis=1), 0.0)
        return (facing * falloff[:, 0])[:, None] * intensity


@dataclass(frozen=True, eq=False)
class Residuals:
    """How far images are from Lambert's law on the estimated normals, lights and albedo.

    Attributes:
        images: (L,) float64, relative RMS of each image: |image - model| / |image| over mask pixels and channels.
        pixels: (H, W) float32, the same of each pixel over images and channels; 0 outside the mask.
        overall: The same over everything.
    """

    images: np.ndarray
    pixels: np.ndarray
    overall: float


def fit_albedo(
    images: "ImageSource", mask: np.ndarray, normals: np.ndarray, lights: np.ndarray, intensities: np.ndarray, *,
    passes: int = 3, lamps: Lamps | None = None,
) -> np.ndarray:  # fmt: skip
    """Estimate the Lambertian albedo of each pixel, robustly.

    The first pass over the images is least squares; the others weight each observation by one over its residual in the
    mean of the channels, which tends to the least sum of absolute residuals, so that highlights and cast shadows count
    little. Images in which a pixel faces away from the light say nothing about it.

    Args:
        images: L linear images (H, W, 3), read `passes` times.
        mask: (H, W) bool.
        normals: (H, W, 3).
        lights: (L, 3) unit, from the surface to the light.
        intensities: (L,) or (L, 3).
        passes: 1 for plain least squares.
        lamps: Where near lamps stand; None for distant lights.

    Returns:
        (H, W, 3) float32 >= 0 in units of image value per intensity; 0 outside the mask and where no light falls.

    Raises:
        InputError: sizes that do not fit, values that are not finite, `passes` under 1.
    """
    if passes < 1:
        raise InputError(f"passes must be at least 1, got {passes}")
    picture, bands = np.zeros((*mask.shape, 3), np.float32), _bands(mask)
    for number, rows in enumerate(bands):
        some = _Rows(images, rows, mask.shape) if rows != slice(0, len(mask)) else images
        with repeat(number, len(bands)):
            scene = _check(some, mask[rows], normals[rows], lights, intensities, _places(lamps, mask, rows))
            picture[rows][mask[rows]] = _fit(some, mask[rows], scene, passes)
    return picture


def _fit(images: "ImageSource", mask: np.ndarray, scene: _Scene, passes: int) -> np.ndarray:  # (n, C)
    """Return the albedo of the mask's pixels, which are those of the scene."""
    count = len(scene.unit)
    albedo = smallest = None
    for number in range(passes):
        above, below = np.zeros((2, count, 3), np.float32)
        for part, observed in _read(images, mask):
            for light, values in zip(range(part.start, part.stop), observed, strict=True):
                for some in split(count, _PART):
                    model = scene.shade(light, some)
                    weighted = model
                    if albedo is not None and smallest is not None:
                        off = np.abs((values[some] - model * albedo[some]).mean(axis=1))
                        weighted = model / np.maximum(off, smallest[some])[:, None]
                    above[some] += weighted * values[some]
                    below[some] += weighted * model
            stage("albedo", number * len(images) + part.stop, passes * len(images))
        albedo = np.maximum(above, 0.0, out=above)
        albedo /= np.maximum(below, np.finfo(np.float32).tiny, out=below)
        smallest = np.maximum(_LEAST * albedo.mean(axis=1), 1e-12)
    assert albedo is not None  # there is a pass
    return albedo


def relit(
    normals: np.ndarray, albedo: np.ndarray | float, direction: np.ndarray, *, depth: Depth | None = None,
    free: np.ndarray | None = None,
) -> np.ndarray:  # fmt: skip
    """Return the object under one light of intensity 1, (H, W, 3) float32 linear radiance, without highlights.

    Args:
        normals: (H, W, 3), zero outside the mask.
        albedo: (H, W, 3) of `fit_albedo`, or (H, W, 1) or a number.
        direction: (3,) from the surface to the light, of any length.
        depth: Of `integrate`; adds cast shadows.
        free: (H, W) bool, what `trace_light` found of them before.

    Raises:
        InputError: a direction that is none.
    """
    direction = np.asarray(direction, np.float64)
    length = np.linalg.norm(direction)
    if direction.shape != (3,) or not (np.isfinite(length) and length > 0):
        raise InputError(f"a light direction must be three finite numbers, not all zero, got {direction.tolist()}")
    free = trace_light(depth, direction) if free is None and depth is not None else free
    albedo = np.broadcast_to(albedo, (*normals.shape[:2], np.shape(albedo)[-1] if np.ndim(albedo) else 1))
    picture = np.empty((*normals.shape[:2], 3), np.float32)
    step = max(1, _PART // normals.shape[1])
    for rows in (slice(start, start + step) for start in range(0, len(normals), step)):
        shading = np.maximum(normals[rows] @ (direction / length), 0.0)
        if free is not None:
            shading = shading * free[rows]
        picture[rows] = shading[..., None] * albedo[rows]
    return picture


def trace_light(depth: Depth, direction: np.ndarray) -> np.ndarray:
    """Return which pixels see a distant light over the depth map, (H, W) bool; nothing outside the mask occludes.

    Rays march in steps of a pixel; of objects whose box has more than a million, of some, between as many pixels.
    Between components, and behind what the camera sees, shadows are a guess.
    """
    box = tuple(slice(int(at[0]), int(at[-1]) + 1) for at in (np.flatnonzero(depth.mask.any(axis=k)) for k in (1, 0)))
    inside = depth.mask[box]
    every = int(np.ceil(np.sqrt(inside.size / _TRACED)))
    few = tuple(slice(min(every // 2, side - 1), None, every) for side in inside.shape)
    found = np.zeros(depth.mask.shape, bool)
    if not inside[few].any():
        found[box] = inside
        return found
    free = _march(depth.z[box][few] / every if every > 1 else depth.z[box], inside[few], direction)
    if every > 1:
        free = cv2.resize(free.astype(np.float32), inside.shape[::-1], interpolation=cv2.INTER_LINEAR) > 0.5
    found[box] = free & inside
    return found


def _march(z: np.ndarray, mask: np.ndarray, direction: np.ndarray) -> np.ndarray:
    """Do what `trace_light` does for depth z (H, W) in pixels, pixel by pixel."""
    across, towards = np.asarray(direction[:2], np.float64), float(direction[2])
    length = np.linalg.norm(across)
    if length < 1e-9 * max(abs(towards), 1e-300):
        return mask.copy()
    step = across / length * (1.0, -1.0)  # columns and rows to the light
    inside = z[mask]
    lowest = float(inside.min()) - 1e4
    z = np.where(mask, z, np.float32(lowest))
    rise = towards / length  # of the ray, per pixel
    farthest = np.hypot(*mask.shape)
    if rise > 0:
        farthest = min(farthest, float(np.ptp(inside)) / rise)
    free = mask.copy()
    for distance in range(1, int(farthest) + 2):
        shift = np.array([[1.0, 0.0, -step[0] * distance], [0.0, 1.0, -step[1] * distance]])
        ahead = cv2.warpAffine(z, shift, z.shape[::-1], flags=cv2.INTER_LINEAR, borderValue=lowest)
        free &= ahead <= z + rise * distance + _LIFT
    return free


def residuals(
    images: "ImageSource", mask: np.ndarray, normals: np.ndarray, lights: np.ndarray, intensities: np.ndarray,
    albedo: np.ndarray, *, lamps: Lamps | None = None,
) -> Residuals:  # fmt: skip
    """Compare the images with Lambert's law; arguments as for `fit_albedo`, whose result `albedo` is.

    Highlights, cast shadows and interreflections add to the residual as much as wrong normals and lights do.
    """
    if albedo.shape != (*mask.shape, 3):
        raise InputError(f"albedo must be {(*mask.shape, 3)} like the mask, got {albedo.shape}")
    picture, wrong, bands = np.zeros(mask.shape, np.float32), np.zeros((2, len(images))), _bands(mask)
    for number, rows in enumerate(bands):
        with repeat(number, len(bands)):
            some = _Rows(images, rows, mask.shape) if rows != slice(0, len(mask)) else images
            scene = _check(some, mask[rows], normals[rows], lights, intensities, _places(lamps, mask, rows))
            sums, of_pixels = _sums(some, mask[rows], scene, albedo[rows])
        wrong += sums
        picture[rows][mask[rows]] = _relative(*of_pixels)
    return Residuals(_relative(*wrong), picture, float(_relative(*wrong.sum(axis=1, keepdims=True))[0]))


def _sums(images: "ImageSource", mask: np.ndarray, scene: _Scene, albedo: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the squared differences and the squared images, summed over each image (2, L) and each pixel (2, n)."""
    inside, count = albedo[mask].astype(np.float32), len(scene.unit)
    wrong, power = np.zeros((2, len(images))), np.zeros((2, count))
    for part, observed in _read(images, mask):
        for number, values in zip(range(part.start, part.stop), observed, strict=True):
            for some in split(count, _PART):
                model = scene.shade(number, some) * inside[some]
                off, squared = ((values[some] - model) ** 2).sum(axis=1), (values[some] ** 2).sum(axis=1)  # (p,)
                wrong[:, number] += off.sum(dtype=np.float64), squared.sum(dtype=np.float64)
                power[:, some] += off, squared
        stage("residuals", part.stop, len(images))
    return wrong, power


def _relative(off: np.ndarray, power: np.ndarray) -> np.ndarray:
    """Return the root of off / power; 1 where all is black and the model is not."""
    return np.sqrt(np.divide(off, power, out=(off > 0).astype(np.float64), where=power > np.finfo(np.float32).tiny))


def _places(lamps: Lamps | None, mask: np.ndarray, band: slice) -> tuple[np.ndarray, np.ndarray] | None:
    """Return (X - C) / R of the mask's pixels in some rows (n, 3), and nearness (L,), float32; None without lamps."""
    if lamps is None:
        return None
    nearness = np.asarray(lamps.nearness, np.float32)
    if lamps.heights.shape != mask.shape or lamps.capture.shape != mask.shape:
        raise InputError(f"heights must be {mask.shape} like the mask, got {lamps.heights.shape}")
    if not ((nearness >= 0.0) & (nearness < 1.0)).all():
        raise InputError("nearness must be at least 0 and under 1, which is a lamp at the object's edge")
    rows, columns = np.nonzero(mask[band])
    places = lamps.capture.place(rows + band.start, columns, lamps.heights[band][mask[band]])
    return places.astype(np.float32), nearness


def _check(
    images: "ImageSource", mask: np.ndarray, normals: np.ndarray, lights: np.ndarray, intensities: np.ndarray,
    near: tuple[np.ndarray, np.ndarray] | None,
) -> _Scene:  # fmt: skip
    """Return what is to be shaded, of some rows and what `_places` says of them."""
    unit = _unit(normals, mask)
    lights, intensities = np.asarray(lights, np.float32), np.asarray(intensities, np.float32)
    count = len(images)
    if lights.shape != (count, 3) or intensities.shape not in ((count,), (count, 3)):
        raise InputError(
            f"{count} images need lights ({count}, 3) and intensities ({count},) or ({count}, 3), got {lights.shape} "
            f"and {intensities.shape}"
        )
    if not (count and np.isfinite(lights).all() and np.isfinite(intensities).all()):
        raise InputError("there must be images, and their lights and intensities must be finite")
    places, nearness = near or (None, np.zeros(count, np.float32))
    if nearness.shape != (count,):
        raise InputError(f"{count} images need nearness ({count},), got {nearness.shape}")
    return _Scene(unit, lights, per_channel(intensities), places, nearness)


class _Rows:
    """Some rows of images."""

    def __init__(self, images: "ImageSource", rows: slice, shape: tuple[int, ...]) -> None:
        self.images, self.rows, self.shape = images, rows, shape

    def __len__(self) -> int:
        return len(self.images)

    def __getitem__(self, part: slice, /) -> np.ndarray:
        window = getattr(self.images, "window", None)
        if window is not None:
            return np.asarray(window(part, self.rows, slice(0, self.shape[1])))
        return np.asarray(self.images[part])[:, self.rows]


def _bands(mask: np.ndarray) -> list[slice]:
    """Return the rows that are worked on at once: all of small pictures, else those with some million of the object."""
    if mask.size <= _BAND or not mask.any():
        return [slice(0, len(mask))]
    sums = np.cumsum(mask.sum(axis=1))
    number = (np.maximum(sums - 1, 0) // _BAND)[mask.any(axis=1)]  # of the band that a row with object is in
    rows = np.flatnonzero(mask.any(axis=1))
    return [slice(int(some[0]), int(some[-1]) + 1) for some in (rows[number == k] for k in np.unique(number))]


def _unit(normals: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """Return the mask's unit normals (n, 3) float32, in double precision a few rows at a time."""
    step = max(1, _PART // mask.shape[-1]) if mask.size > _PART else mask.size
    bands = [slice(start, start + step) for start in range(0, len(mask), step)]
    if len(bands) < 2:
        return check_normals(normals, mask).astype(np.float32)
    found = [check_normals(normals[rows], mask[rows]).astype(np.float32) for rows in bands if mask[rows].any()]
    return np.concatenate(found) if found else check_normals(normals, mask).astype(np.float32)


def _read(images: "ImageSource", mask: np.ndarray) -> Iterator[tuple[slice, np.ndarray]]:
    """Yield which images, and their mask pixels, (k, n, C)."""
    step = max(1, _READ_PIXELS // mask.size)
    for start in range(0, len(images), step):
        part = slice(start, min(start + step, len(images)))
        observed = np.asarray(images[part])
        if observed.shape != (part.stop - start, *mask.shape, 3):
            raise InputError(f"images must be (L, {mask.shape[0]}, {mask.shape[1]}, 3), got {observed.shape}")
        observed = observed[:, mask].astype(np.float32, copy=False)
        if not np.isfinite(observed).all():
            raise InputError("the images contain NaN or infinite values inside the mask; repair them first")
        yield part, observed
