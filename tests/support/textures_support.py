"""A folder of PBR maps for tests."""

from pathlib import Path

import cv2
import numpy as np

SIZE = 32


def write_maps(folder: Path, size: int = SIZE) -> dict[str, np.ndarray]:
    """Write base colour, roughness, metallic (8 bits) and a normal map (16 bits) that repeat; return them in [0, 1]."""
    v, u = (grid / size for grid in np.mgrid[:size, :size])
    wave = np.sin(2 * np.pi * u) * np.sin(2 * np.pi * v)
    normal = np.stack([0.5 * np.cos(2 * np.pi * u), 0.4 * np.sin(4 * np.pi * v), np.ones_like(u)], -1)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    maps = {
        "Color": np.stack([0.6 + 0.3 * wave, 0.5 - 0.3 * wave, 0.4 + 0.2 * np.cos(2 * np.pi * u)], -1),
        "Roughness": 0.6 + 0.35 * np.sin(2 * np.pi * v),
        "Metalness": (wave > 0).astype(float),
        "NormalGL": (normal + 1) / 2,
    }
    for kind, values in maps.items():
        write(folder / f"Test_{kind}.png", values, 16 if kind == "NormalGL" else 8)
    return maps


def write(path: Path, values: np.ndarray, bits: int) -> None:
    """Write values in [0, 1], RGB or grey, as a picture of 8 or 16 bits."""
    scaled = np.rint(np.asarray(values) * (2**bits - 1)).astype(np.uint8 if bits == 8 else np.uint16)
    assert cv2.imwrite(str(path), scaled if scaled.ndim == 2 else scaled[..., ::-1])
