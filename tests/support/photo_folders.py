"""Folders of photographs of analytic scenes, as a camera would leave them."""

from pathlib import Path

import classical_scenes as scenes
import cv2
import numpy as np
import OpenEXR

NOISE = 0.003
PAD = 16


def matte(lights: np.ndarray, *, shape: str = "hills", paint: bool = False, size: int = 72, seed: int = 0):
    """Return images (L, H, W, 3) with noise and a faint background, and the mask (H, W), of a matte object."""
    normals, mask = getattr(scenes, shape)(size)
    albedo = scenes.patches(mask, 12, np.random.default_rng(seed)) if paint else 0.8
    images = scenes.lambertian(normals, mask, lights, albedo=albedo).images
    images = np.pad(images, ((0, 0), (PAD, PAD), (PAD, PAD), (0, 0)))
    noise = np.random.default_rng(seed + 1).normal(0, NOISE, images.shape)
    return np.clip(images + 0.004 + noise, 0, 1).astype(np.float32), np.pad(mask, PAD)


def to_srgb(values: np.ndarray) -> np.ndarray:
    """Apply sRGB's curve to linear values."""
    return np.where(values <= 0.0031308, 12.92 * values, 1.055 * np.maximum(values, 1e-9) ** (1 / 2.4) - 0.055)


def write(path: Path, image: np.ndarray, bits: int = 8) -> None:
    """Write values (H, W[, 3]) from 0 to 1, RGB, with the bits and format of the suffix."""
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.suffix == ".exr":
        OpenEXR.File({}, {"RGB": np.ascontiguousarray(image, np.float32)}).write(str(path))
        return
    if bits < 32:
        image = np.rint(np.clip(image, 0, 1) * (2**bits - 1)).astype(np.uint8 if bits == 8 else np.uint16)
    options = {".jpg": [cv2.IMWRITE_JPEG_QUALITY, 98], ".png": [cv2.IMWRITE_PNG_COMPRESSION, 1]}.get(path.suffix, [])
    assert cv2.imwrite(str(path), image if image.ndim == 2 else np.ascontiguousarray(image[..., ::-1]), options)


def write_folder(
    folder: Path, images: np.ndarray, mask: np.ndarray | None = None, *, suffix: str = ".png", bits: int = 16
) -> Path:
    """Write images as 1.png, 2.png, ... and mask.png."""
    for number, image in enumerate(images, start=1):
        write(folder / f"{number}{suffix}", image, bits)
    if mask is not None:
        write(folder / "mask.png", mask.astype(np.float32))
    return folder
