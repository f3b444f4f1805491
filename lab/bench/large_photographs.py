"""A folder of large photographs, made in bands so that making them takes little memory, for `bench-infer`.

A dome with waves and dents, two-coloured and glossy, under one distant light a picture, with noise, saved as a camera
saves JPEG files. It stands for a real one in size and kind only; nothing is to be learned from its errors.
"""

import shutil
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image

from render.shared.errors import InputError
from render.shared.imaging.vectors import half_vectors, unit
from render.shared.progress import progress_bar
from render.shared.seeds import generator
from sdps.photos.response import display

_BAND = 256  # rows made at once
_GLOSS, _SHININESS, _NOISE, _GROUND = 0.25, 50.0, 0.003, 0.002
_QUALITY = 92


@dataclass(frozen=True, kw_only=True)
class LargeConfig:
    """How large the photographs are.

    Attributes:
        width: Columns.
        height: Rows.
        pictures: Number of photographs.
        share: Of the frame that the object covers; 1 for the whole frame, without a mask file.
        seed: Of lights and noise.
    """

    width: int = 4000
    height: int = 3000
    pictures: int = 7
    share: float = 0.18
    seed: int = 0

    def __post_init__(self) -> None:
        if min(self.width, self.height) < 64 or self.pictures < 3 or not 0.01 <= self.share <= 1.0:
            raise InputError("width and height must be at least 64, pictures at least 3, share between 0.01 and 1")


def photograph_large(folder: Path, config: LargeConfig) -> Path:
    """Write the photographs as `000.jpg` and so on, and `mask.png` unless the object fills the frame.

    Raises:
        InputError: the folder cannot be written.
    """
    rng = generator(config.seed, "large photographs")
    azimuth = 2 * np.pi * (np.arange(config.pictures) * 0.618 % 1.0)
    across = np.sin(np.radians(rng.uniform(20.0, 50.0, config.pictures)))
    lights = np.stack([across * np.cos(azimuth), across * np.sin(azimuth), np.sqrt(1.0 - across**2)], axis=1)
    gains = rng.uniform(0.7, 1.0, config.pictures)
    ground = display(_GROUND + _noise(rng, (_BAND, config.width, 3)))
    try:
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir(parents=True)
        for number in progress_bar(range(config.pictures), desc="photograph", unit="picture"):
            picture = np.concatenate(
                [_band(rows, lights[number], gains[number], config, ground, rng) for rows in _bands(config)]
            )
            Image.fromarray(picture).save(folder / f"{number:03d}.jpg", quality=_QUALITY)
        if config.share < 1.0:
            everywhere = slice(0, config.width)
            mask = np.concatenate([_relief(rows, everywhere, config)[2] for rows in _bands(config)])
            Image.fromarray(mask.astype(np.uint8) * 255).save(folder / "mask.png")
    except OSError as error:
        raise InputError(f"{folder}: cannot be written ({error.strerror or error}); choose another --out") from error
    return folder


def _bands(config: LargeConfig) -> list[slice]:
    return [slice(start, min(start + _BAND, config.height)) for start in range(0, config.height, _BAND)]


def _noise(rng: np.random.Generator, shape: tuple[int, ...]) -> np.ndarray:
    return np.float32(_NOISE) * rng.standard_normal(shape, np.float32)


def _reach(config: LargeConfig) -> float:
    """Return the object's radius in pixels."""
    return float(np.sqrt(config.share * config.height * config.width / np.pi))


def _band(
    rows: slice, light: np.ndarray, gain: float, config: LargeConfig, ground: np.ndarray, rng: np.random.Generator
) -> np.ndarray:  # (h, W, 3) uint8
    """Return some rows of a picture: the ground's noise, shifted, and the object where it is."""
    band = np.roll(ground, rng.integers(config.width), 1)[: rows.stop - rows.start]
    if config.share >= 1.0:
        return _shade(rows, slice(0, config.width), light, gain, config, rng)
    middle, reach = config.width / 2, _reach(config)
    if rows.stop < config.height / 2 - reach or rows.start > config.height / 2 + reach:
        return band
    columns = slice(max(int(middle - reach), 0), min(int(middle + reach) + 1, config.width))
    band[:, columns] = _shade(rows, columns, light, gain, config, rng)
    return band


def _relief(rows: slice, columns: slice, config: LargeConfig) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return unit normals (h, w, 3) and albedo (h, w, 3), float32, and the mask (h, w) of some rows and columns."""
    half = max(config.height, config.width) / 2
    x = (np.arange(columns.start, columns.stop, dtype=np.float32) - config.width / 2) / half
    y = (config.height / 2 - np.arange(rows.start, rows.stop, dtype=np.float32))[:, None] / half
    radius = np.float32(_reach(config) / half)
    mask = np.ones((len(y), len(x)), bool) if config.share >= 1.0 else x**2 + y**2 < radius**2
    reach = np.float32(1.5) if config.share >= 1.0 else 1.02 * radius
    dome = np.sqrt(np.maximum(reach**2 - x**2 - y**2, 1e-4))
    waves = 0.15 * np.cos(40 * x + 9 * np.sin(11 * y)), 0.15 * np.cos(31 * y + 7 * np.sin(17 * x))
    slopes = (-x / dome + waves[0], -y / dome + waves[1])
    normals = unit(np.stack([-slopes[0], -slopes[1], np.ones_like(dome)], axis=-1))
    cells = (np.floor(14 * x) + np.floor(14 * y)) % 2
    colours = np.array([[0.3, 0.4, 0.5], [0.6, 0.3, 0.2]], np.float32)
    return normals, colours[cells.astype(int)], mask


def _shade(
    rows: slice, columns: slice, light: np.ndarray, gain: float, config: LargeConfig, rng: np.random.Generator
) -> np.ndarray:  # (h, w, 3) uint8
    normals, albedo, mask = _relief(rows, columns, config)
    half = half_vectors(light)
    shading = np.maximum(normals @ light.astype(np.float32), 0.0)[..., None]
    gloss = np.maximum(normals @ half.astype(np.float32), 0.0)[..., None] ** _SHININESS
    linear = np.where(mask[..., None], gain * (albedo + _GLOSS * gloss) * shading, _GROUND)
    return display(linear + _noise(rng, linear.shape))
