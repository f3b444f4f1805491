"""DiLiGenT (Shi et al. 2016) under the protocols of the published tables."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pipelines.benchmarks.stacks import MARGIN, Stack, files_digest
from pipelines.evaluate.evaluation import TestObject
from render.exchange.foreign_samples import Source
from render.exchange.ingest import crop_box
from render.exchange.read_diligent import diligent_sources
from render.shared.errors import InputError
from render.shared.images import bit_depth, read_image, to_unit

OBJECTS = ("ball", "cat", "pot1", "bear", "pot2", "buddha", "goblet", "reading", "cow", "harvest")
"""In the order of the published tables."""

_BEAR_CORRUPT = 20
"""First images of bear that CNN-PS and others leave out (README of CNN-PS)."""


@dataclass(frozen=True, kw_only=True)
class DiligentConfig:
    """How the files are read.

    Attributes:
        bits: 16 reads the PNGs exactly; 8 keeps the high byte, which is all that the published results of SDPS-Net saw.
        bear: Images of bear: 96, as in the paper, or 76 without the first 20.
        margin: Pixels kept around the mask's bounding box; sides are then rounded up to multiples of 4.
    """

    bits: int = 8
    bear: int = 96
    margin: int = MARGIN

    def __post_init__(self) -> None:
        if self.bits not in (8, 16):
            raise InputError(f"bits must be 8 or 16, got {self.bits}")
        if self.bear not in (76, 96):
            raise InputError(f"bear must be 96 or 76, got {self.bear}")
        if self.margin < 0:
            raise InputError(f"margin must be 0 pixels or more, got {self.margin}")

    def definition(self) -> str:
        """Say in words how images are read."""
        depth = "16 bits" if self.bits == 16 else "8 bits (the high byte of 16-bit files)"
        bear = "bear with all 96 images" if self.bear == 96 else "bear without its first 20 images (76)"
        return (
            f"{depth}; cropped to the mask's box with {self.margin} pixels of margin, sides multiples of 4; images "
            "divided by full scale, times the mask, not divided by the known intensities (methods that are given the "
            f"lights get the file's directions and intensities); {bear}"
        )


def diligent_objects(tree: Path, config: DiligentConfig) -> list[TestObject]:
    """Return the objects of a DiLiGenT folder in the order of the published tables, others after them.

    Args:
        tree: `pmsData`, the folder above it, or one object's folder.
        config: Bits, images of bear, crop.

    Raises:
        InputError: not such a folder, or files that are missing or do not fit together.
    """
    if not tree.is_dir():
        raise InputError(f"{tree}: no such folder; give DiLiGenT's pmsData, the folder above it, or one <object>PNG")
    found = {source.name: source for source in diligent_sources(tree)}
    names = [name for name in OBJECTS if name in found] + [name for name in found if name not in OBJECTS]
    return [_object(found[name], config) for name in names]


def _object(source: Source, config: DiligentConfig) -> TestObject:
    """Read what is small, and refer to the images."""
    truth = source.truth()
    drop = _BEAR_CORRUPT if source.name == "bear" and config.bear == 76 else 0
    if drop >= len(source.images):
        raise InputError(f"{source.folder}: {len(source.images)} images, --bear 76 drops the first {drop}")
    files = [source.folder / name for name in source.images[drop:]]
    box = crop_box(truth.mask, config.margin)
    stack = Stack(lambda number: _read(files[number], config.bits), [str(path) for path in files], truth.mask, box)
    directions, gains = source.directions[drop:], source.intensities[drop:]
    directions = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    parts = (config.bits, config.margin, directions.tolist(), gains.tolist())
    return TestObject(
        name=source.name,
        digest=files_digest([*files, source.folder / "mask.png", truth.origin], *parts),
        load=lambda: stack,
        mask=stack.mask,
        normals=box.cut(truth.normals),
        light_directions=directions.astype(np.float32),
        intensities=gains,
    )


def _read(path: Path, bits: int) -> np.ndarray:  # (H, W, 3) float32, full scale 1
    pixels = read_image(path)
    if bits == 16 and bit_depth(pixels) == 8:
        raise InputError(f"{path}: has 8 bits per channel, not the original's 16; evaluate with --bits 8")
    if bits == 8 and bit_depth(pixels) == 16:
        pixels = (pixels >> 8).astype(np.uint8)
    return to_unit(pixels)
