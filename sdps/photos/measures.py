"""What one pass over the photographs tells about each of them; memory of a few kilobytes per image.

Legend: L images, P sampled pixels of the object.
"""

import hashlib
import warnings
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from PIL import Image

from render.shared.errors import InputError
from render.shared.progress import progress_bar, stage
from render.shared.seeds import spread_evenly
from sdps.core.intensities import colour_balance
from sdps.photos.analysis.colours import colour_casts
from sdps.photos.analysis.fall_off import FallOff, block_means, fall_off
from sdps.photos.analysis.motion import Shift, Tracker, second_look
from sdps.photos.pictures.decoding.camera_files import read_exif
from sdps.photos.reading import Photographs
from sdps.photos.response import brightness

_PIXELS = 2048
_COLOUR_PIXELS = 512
_WHOLE = 0.95  # share of the frame from which on the object fills it
_EXPOSURE = {33434: "exposure time", 33437: "aperture", 34855: "ISO", 37386: "focal length"}
_EXIF = 0x8769


@dataclass(frozen=True, eq=False)
class Measures:
    """Statistics of the object's pixels, one entry per image.

    Attributes:
        observations: (L, P, 3) float32, the same pixels in all images.
        levels: (L,) 95th percentile of the brightness.
        peaks: (L,) its maximum.
        outside: Mean brightness outside the mask over that inside; 0 where the mask is the frame.
        saturated: (L,) share of the pixels with a channel at full scale.
        tops: (L,) the highest value of a channel, before anything was subtracted.
        topped: (L,) share of the pixels with a channel at it.
        casts: (L,) change of the light's colour, see `colour_casts`.
        digests: (L,) of the brightness of all pixels.
        settings: (L,) what the camera wrote about its exposure, by name.
        shifts: (L,) against the other images; of zero length unless the image moved.
        dimming: How the pictures dim over the frame, where the object fills it.
    """

    observations: np.ndarray
    levels: np.ndarray
    peaks: np.ndarray
    outside: float
    saturated: np.ndarray
    tops: np.ndarray
    topped: np.ndarray
    casts: np.ndarray
    digests: list[bytes]
    settings: list[dict[str, float]]
    shifts: list[Shift]
    dimming: FallOff


def measure(photos: Photographs) -> Measures:
    """Read every photograph once, and those that seem to have moved, and the first few, once more.

    Raises:
        InputError: a file that can no longer be read.
    """
    count = len(photos)
    pixels = np.flatnonzero(photos.mask)
    sample = pixels[spread_evenly(range(len(pixels)), _PIXELS)]
    observations = np.empty((count, len(sample), 3), np.float32)
    levels, peaks, saturated, tops, topped, outside = np.zeros((6, count))
    digests, settings, shifts, blocks = [], [], [], []
    tracker = Tracker(photos.mask)
    stored = replace(photos, background=None)
    for number in progress_bar(range(count), desc="checking", unit="picture", delay=5):
        image = stored[number : number + 1][0]
        highest = image[photos.mask].max(-1)  # (Q,), clipped or not: before anything is subtracted
        if photos.background is not None:
            photos.background.subtract(image, photos.files[number], (slice(None), slice(None)), photos.saturation)
        stage("checks", number, count)
        grey = brightness(image)
        digests.append(hashlib.blake2b(grey.tobytes(), digest_size=16).digest())
        settings.append(_camera_settings(photos.folder / photos.files[number], photos.coding.kind))
        shifts.append(tracker.add(grey))
        blocks.append(block_means(grey))
        observations[number] = image.reshape(-1, 3)[sample]
        bright = grey[photos.mask]  # (Q,)
        levels[number], peaks[number], tops[number] = np.percentile(bright, 95), bright.max(), highest.max()
        saturated[number], topped[number] = (highest >= photos.saturation).mean(), (highest >= tops[number]).mean()
        if len(pixels) < grey.size:
            rest = (grey.sum(dtype=np.float64) - bright.sum(dtype=np.float64)) / (grey.size - len(pixels))
            outside[number] = rest / max(float(bright.mean()), 1e-6)
    moved = second_look(tracker, shifts, lambda number: brightness(photos[number : number + 1][0]))
    casts = _casts(photos, observations)
    dimming = fall_off(np.stack(blocks), photos.shape) if photos.mask.mean() >= _WHOLE else FallOff()
    return Measures(
        observations, levels, peaks, float(np.median(outside)), saturated, tops, topped, casts, digests, settings,
        moved, dimming,
    )  # fmt: skip


def _casts(photos: Photographs, observations: np.ndarray) -> np.ndarray:  # (L,)
    """Find changes of colour that the given intensities do not explain, on a few hundred pixels."""
    some = observations[:, :: max(1, observations.shape[1] // _COLOUR_PIXELS)]
    saturation = photos.saturation
    balance = None if photos.intensities is None else colour_balance(photos.intensities)
    if balance is not None:
        full = np.any(some >= saturation, axis=-1, keepdims=True)
        some = np.where(full, np.inf, some / balance[:, None]).astype(np.float32)
        some[full[..., 0]] = saturation
    return colour_casts(some, saturation)


def measure_spread(observations: np.ndarray) -> np.ndarray:
    """Return the singular values, relative to the first, of the images scaled to unit length, (min(L, P),).

    For lights evenly within a cone the second is 0.07 to 0.10 per 10 degrees of its half-angle, on spheres and hills,
    plain and painted, frontal and tilted by 40 degrees (Lambertian); the third is 0.5 to 0.9 of the second, and under
    0.25 of it for lights along an arc of up to 100 degrees.
    """
    observations = observations.astype(np.float64)  # squares of float32 overflow where radiance has odd units
    lengths = np.linalg.norm(observations, axis=1, keepdims=True)
    lit = observations[lengths[:, 0] > 1e-6] / lengths[lengths[:, 0] > 1e-6]
    if not len(lit):
        return np.zeros(1)
    values = np.linalg.svd(lit, compute_uv=False)
    return values / values[0]


def _camera_settings(path: Path, kind: str = "") -> dict[str, float]:
    """Return what the EXIF header says about exposure and zoom; empty where there is none."""
    if path.suffix.lower() == ".exr":
        return {}
    try:
        with warnings.catch_warnings(action="ignore"):  # of damaged tags, of size
            if kind in ("RAW", "HEIC"):
                exif = read_exif(path, path.read_bytes(), kind)
                tags = dict(exif) | exif.get_ifd(_EXIF)
            else:
                with Image.open(path) as picture:
                    if picture.format not in ("JPEG", "MPO", "TIFF", "AVIF"):
                        return {}
                    tags = dict(picture.getexif()) | picture.getexif().get_ifd(_EXIF)
        return {name: float(np.max(tags[tag])) for tag, name in _EXPOSURE.items() if tag in tags}
    except FileNotFoundError as error:
        raise InputError(f"{path}: was removed while it was in use; start again") from error
    except (OSError, ValueError, TypeError, SyntaxError, ZeroDivisionError):
        return {}  # Pillow opens neither 16-bit nor float TIFF of all kinds
