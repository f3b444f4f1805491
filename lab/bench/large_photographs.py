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
    try:
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir(parents=True)
        for number in progress_bar(range(config.pictures), desc="photograph", unit="picture"):
            picture = np.concatenate(
                [_shade(rows, lights[number], gains[number], config, rng) for rows in _bands(config)]
            )
            Image.fromarray(picture).save(folder / f"{number:03d}.jpg", quality=_QUALITY)
        if config.share < 1.0:
            mask = np.concatenate([_relief(rows, config)[2] for rows in _bands(config)])
            Image.fromarray(mask.astype(np.uint8) * 255).save(folder / "mask.png")
    except OSError as error:
        raise InputError(f"{folder}: cannot be written ({error.strerror or error}); choose another --out") from error
    return folder


def _bands(config: LargeConfig) -> list[slice]:
    return [slice(start, min(start + _BAND, config.height)) for start in range(0, config.height, _BAND)]


def _relief(rows: slice, config: LargeConfig) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return unit normals (h, W, 3) and albedo (h, W, 3), float32, and the mask (h, W) of some rows."""
    half = max(config.height, config.width) / 2
    x = (np.arange(config.width, dtype=np.float32) - config.width / 2) / half
    y = (config.height / 2 - np.arange(rows.start, rows.stop, dtype=np.float32))[:, None] / half
    area = config.share * config.height * config.width / half**2
    radius = np.float32(np.sqrt(area / np.pi))
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
    rows: slice, light: np.ndarray, gain: float, config: LargeConfig, rng: np.random.Generator
) -> np.ndarray:  # (h, W, 3) uint8
    normals, albedo, mask = _relief(rows, config)
    half = half_vectors(light)
    shading = np.maximum(normals @ light.astype(np.float32), 0.0)[..., None]
    gloss = np.maximum(normals @ half.astype(np.float32), 0.0)[..., None] ** _SHININESS
    linear = np.where(mask[..., None], gain * (albedo + _GLOSS * gloss) * shading, _GROUND)
    return display(linear + rng.normal(0.0, _NOISE, linear.shape).astype(np.float32))
