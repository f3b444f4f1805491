"""What every decoder of picture files returns."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from sdps.photos.pictures.lens import NO_LENS, Lens, read_lens

_TIME, _APERTURE, _ISO = (33434, "ExposureTime"), (33437, "FNumber"), (34855, "ISOSpeedRatings")


@dataclass(frozen=True, eq=False)
class Decoded:
    """What a file holds.

    Attributes:
        pixels: (H, W, 3) uint8, uint16 or float32, RGB as stored, not turned; grey is repeated.
        alpha: (H, W) of the same type, None where there is none.
        bits: Per channel in the file.
        profile: The embedded colour profile.
        orientation: EXIF orientation tag, 1 to 8.
        layer: Which layer of an EXR file it was, empty where it has no name.
        lens: What its EXIF data say.
        exposure: Seconds times ISO over the squared f-number, 0 where the file does not say all three.
    """

    pixels: np.ndarray
    alpha: np.ndarray | None
    bits: int
    profile: bytes | None = None
    orientation: int = 1
    layer: str = ""
    lens: Lens = NO_LENS
    exposure: float = 0.0


def read_exposure(tags: Callable[[], Mapping[Any, Any]]) -> float:
    """Return the exposure that the EXIF directory which `tags` reads states, by number or tifffile's names; else 0."""
    try:
        found = tags()
        time, aperture, iso = (_number(found, keys) for keys in (_TIME, _APERTURE, _ISO))
        return join_exposure(time, aperture, iso)
    except Exception:  # damaged in one of many ways
        return 0.0


def read_taken(tags: Callable[[], Mapping[Any, Any]]) -> tuple[Lens, float]:
    """Return what the EXIF directory which `tags` reads says of the lens, and the exposure."""
    return read_lens(tags), read_exposure(tags)


def join_exposure(time: float, aperture: float, iso: float) -> float:
    """Return time (s) times ISO over the squared f-number; 0 if one of them is not known."""
    value = time * iso / aperture**2 if aperture > 0 else 0.0
    return value if np.isfinite(value) and value > 0 else 0.0


def _number(tags: Mapping[Any, Any], keys: tuple[int, str]) -> float:
    value = next((tags[key] for key in keys if key in tags), 0)
    if isinstance(value, tuple):  # tifffile's rational number, or several values of which the first counts
        return float(value[0]) / float(value[1]) if len(value) == 2 else float(value[0])
    return float(value)


def repeat_grey(pixels: np.ndarray) -> np.ndarray:
    """Return (H, W), (H, W, C) with C >= 3, or with a grey channel first, as (H, W, 3)."""
    pixels = pixels.reshape(*pixels.shape[:2], -1)
    wide = pixels[..., :3] if pixels.shape[2] >= 3 else pixels[..., :1]
    return np.ascontiguousarray(np.broadcast_to(wide, (*wide.shape[:2], 3)))


def read_orientation(tag: object) -> int:
    """Return an EXIF orientation, 1 for what is none."""
    return tag if isinstance(tag, int) and 1 <= tag <= 8 else 1
