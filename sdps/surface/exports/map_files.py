"""Files of maps, each written to a temporary name, then renamed: PNG, EXR of vectors, TIFF with its resolution."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import tifffile

from render.records.shards import write_exr
from render.shared.files import atomic_path
from render.shared.images import write_png

_MILLIMETRES = 10.0  # in a centimetre, the unit of TIFF's resolution


def write_picture(path: Path, pixels: np.ndarray) -> Path:
    """Write (H, W, 3) RGB or (H, W), uint8 or uint16, as PNG."""
    with atomic_path(path) as temporary:
        write_png(temporary, pixels)
    return path


def write_vectors(path: Path, vectors: np.ndarray) -> Path:
    """Write (H, W, 3) float32 as the channels R, G, B of an EXR."""
    write_exr(path, [("rgb", {}, {"RGB": np.ascontiguousarray(vectors, np.float32)})])
    return path


def write_tiff(path: Path, values: np.ndarray, pixel_size: float | None, about: dict[str, Any]) -> Path:
    """Write (H, W), float32 or uint16, as a plain TIFF, which inspection software reads: one page, not compressed.

    Args:
        path: Destination.
        values: (H, W) float32 or uint16.
        pixel_size: Millimetres per pixel, for the resolution; None where it is not known.
        about: What the numbers mean, written as JSON into ImageDescription.
    """
    per_centimetre = None if pixel_size is None else _MILLIMETRES / pixel_size
    known: dict[str, Any] = {}
    if per_centimetre is not None:
        known = {"resolution": (per_centimetre, per_centimetre), "resolutionunit": "CENTIMETER"}
    with atomic_path(path) as temporary:
        tifffile.imwrite(temporary, values, photometric="minisblack", metadata=None, description=json.dumps(about),
                         **known)  # fmt: skip
    return path
