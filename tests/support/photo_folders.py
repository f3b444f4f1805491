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


def plate(
    lights: np.ndarray,
    *,
    distance: float | None = None,
    lumps: bool = False,
    depth: float = 1.0,
    paint: bool = False,
    shape: tuple[int, int] = (96, 128),
    seed: int = 0,
) -> np.ndarray:
    """Return images (L, H, W, 3) with noise of a matte plate that fills the frame.

    Args:
        lights: (L, 3) unit directions.
        distance: Of the lamps from the middle, in longer sides of the frame; None for distant ones.
        lumps: Half balls lie on the plate, instead of a fine relief.
        depth: Factor of the relief's depth; 0 for a flat plate.
        paint: Random patches of colour.
        shape: (H, W).
        seed: Of relief, paint and noise.
    """
    rng, side = np.random.default_rng(seed), max(shape)
    down, right = ((np.arange(count) + 0.5 - count / 2) / side for count in shape)
    y, x = np.meshgrid(-down, right, indexing="ij")
    if lumps:
        height = np.zeros(shape)
        for row, column, radius in rng.uniform((-0.4, -0.5, 0.05), (0.4, 0.5, 0.1), (16, 3)):
            height = np.maximum(height, 0.7 * np.sqrt(np.maximum(radius**2 - (y - row) ** 2 - (x - column) ** 2, 0)))
        height = cv2.GaussianBlur(height, (0, 0), 1)
    else:
        height = cv2.GaussianBlur(rng.normal(size=shape), (0, 0), 2) * 0.015
    down, right = np.gradient(depth * height, 1 / side)
    normals = np.stack([-right, down, np.ones(shape)], axis=-1)
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    towards = np.broadcast_to(lights[:, None, None], (len(lights), *shape, 3))
    if distance is not None:
        towards = towards - np.stack([x, y, np.zeros(shape)], axis=-1) / distance
    squared = (towards**2).sum(-1)
    shading = np.maximum(np.einsum("lhwc,hwc->lhw", towards, normals), 0) / squared**1.5
    albedo = scenes.patches(np.ones(shape, bool), 12, rng) if paint else np.full((*shape, 3), 0.8)
    images = shading[..., None] * albedo
    images *= 0.9 / np.percentile(images, 99.9, axis=(1, 2, 3), keepdims=True)  # as cameras expose
    return np.clip(images + rng.normal(0, NOISE, images.shape), 0, 1).astype(np.float32)
