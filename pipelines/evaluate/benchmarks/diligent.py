"""`sdps evaluate diligent`: any objects of DiLiGenT, every method, the tables of the paper with all published rows.

Table (a) is light directions, (b) light intensities, (c) normals (SDPS-Net, table "Results of SDPS-Net on the DiLiGenT
benchmark"). Every number carries its protocol: bits, crop, mask, images of bear.
"""

import argparse
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pipelines.evaluate.benchmarks import suite
from pipelines.evaluate.benchmarks.stacks import MARGIN, Images, build_object
from pipelines.evaluate.evaluation import TestObject
from pipelines.shared.flags import from_flags
from render.exchange.layouts import LAYOUTS
from render.exchange.layouts.foreign_samples import Source
from render.shared.config import to_plain
from render.shared.errors import InputError
from render.shared.images import bit_depth, read_image, to_unit
from render.shared.seeds import generator
from sdps.core.geometry import Camera
from sdps.inference.inference_config import inference_config
from sdps.methods import select

OBJECTS = ("ball", "cat", "pot1", "bear", "pot2", "buddha", "goblet", "reading", "cow", "harvest")
"""In the order of the published tables."""

_BEAR_CORRUPT = 20
"""First images of bear that CNN-PS and others leave out (README of CNN-PS)."""

DILIGENT = suite.Benchmark(
    "diligent", "DiLiGenT", 40, OBJECTS,
    (
        ("DiLiGenT (a), light directions, degrees", "directions", "direction_mae", 2),
        ("DiLiGenT (b), light intensities, relative error", "intensities", "intensity_error", 3),
        ("DiLiGenT (c), normals, degrees", "normals", "normal_mae", 2),
    ),
    "Published rows: bear with 96 images; 'this object' and 'mean of' are over the objects present.",
)  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class DiligentConfig:
    """How the files are read.

    Attributes:
        bits: 16 reads the PNGs exactly; 8 keeps the high byte, which is all that the published results of SDPS-Net saw.
        bear: Images of bear: 96, as in the paper, or 76 without the first 20.
        margin: Pixels kept around the mask's bounding box; sides are then rounded up to multiples of 4.
        images: So many of each object, drawn by chance, the same in every run; 0: all.
        focal: Focal length in pixels, the benchmark's about 3772; 0: taken for orthographic. The principal point is the
            middle of the files' pictures.
    """

    bits: int = 8
    bear: int = 96
    images: int = 0
    margin: int = MARGIN
    focal: float = 0.0

    def __post_init__(self) -> None:
        if self.bits not in (8, 16):
            raise InputError(f"bits must be 8 or 16, got {self.bits}")
        if self.bear not in (76, 96):
            raise InputError(f"bear must be 96 or 76, got {self.bear}")
        if self.images < 0:
            raise InputError(f"images must be a number of images, or 0 for all, got {self.images}")
        if self.focal < 0:
            raise InputError(f"focal must be a length in pixels, or 0 for an orthographic camera, got {self.focal:g}")
        if self.margin < 0:
            raise InputError(f"margin must be 0 pixels or more, got {self.margin}")

    def describe(self) -> str:
        """Say in words how images are read."""
        depth = "16 bits" if self.bits == 16 else "8 bits (the high byte of 16-bit files)"
        some = f"; {self.images} images of each object, drawn by chance" if self.images else ""
        lens = f"; focal length {self.focal:g} px" if self.focal else ""
        bear = "bear with all 96 images" if self.bear == 96 else "bear without its first 20 images (76)"
        return (
            f"{depth}; cropped to the mask's box with {self.margin} pixels of margin, sides multiples of 4; images "
            "divided by full scale, times the mask, not divided by the known intensities (methods that are given the "
            f"lights get the file's directions and intensities); {bear}{some}{lens}"
        )


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the flags of `sdps evaluate diligent`."""
    suite.add_arguments(parser)
    parser.add_argument("--bits", type=int, default=8, choices=(8, 16),
                        help="16: the PNGs exactly; 8: their high byte, as published (default: 8)")  # fmt: skip
    parser.add_argument("--bear", type=int, default=96, choices=(96, 76),
                        help="images of bear; 76 drops the corrupted first 20 (default: 96, as the paper)")  # fmt: skip
    parser.add_argument("--images", type=int, default=0, metavar="N",
                        help="of each object, drawn by chance, the same every time (default: all)")  # fmt: skip
    parser.add_argument("--focal", type=float, default=0.0, metavar="PX",
                        help="focal length in pixels, 3772 of its camera (default: orthographic)")  # fmt: skip


def main(args: argparse.Namespace) -> int:
    """Evaluate, print the tables, and write <out>/diligent/results.json and the report's section."""
    config, chosen = from_flags(DiligentConfig, args), suite.named_methods(args)
    items = suite.pick_objects(diligent_objects(args.data, config), args.objects)
    chosen = chosen or select.every_method(select.runs_folder(args.models), inference_config(args))
    return suite.evaluate(
        DILIGENT, args, items, chosen, text=describe(items, config), protocol=to_plain(config),
        command=f"sdps evaluate diligent {args.data} --bits {args.bits} --bear {args.bear}"
        + (f" --images {args.images}" if args.images else "") + (f" --focal {args.focal:g}" if args.focal else ""),
    )  # fmt: skip


def describe(items: Sequence[TestObject], config: DiligentConfig) -> str:
    """Say what the numbers are of."""
    counts = sorted({len(item.true_directions) for item in items})
    images = " or ".join(str(count) for count in counts)
    own = sum(item.name in OBJECTS for item in items)
    others = f" and {len(items) - own} others" if own < len(items) else ""
    return (
        f"{own} of DiLiGenT's ten objects{others}, {images} images each; {config.describe()}. Normals: mean angular "
        "error in degrees over mask pixels. Directions: mean angular error in degrees over images. Intensities: truth "
        "divided per channel by the first image's, one least-squares scale, mean relative error. A dash: not in the "
        "folder, not printed, or given to the method."
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
    found = {source.shape: source for source in (read() for read in LAYOUTS["diligent"].list_samples(tree))}
    names = [name for name in OBJECTS if name in found] + [name for name in found if name not in OBJECTS]
    return [_object(found[name], config) for name in names]


def _object(source: Source, config: DiligentConfig) -> TestObject:
    """Read what is small, and refer to the images."""
    truth = source.truth()
    drop = _BEAR_CORRUPT if source.shape == "bear" and config.bear == 76 else 0
    if drop >= len(source.images):
        raise InputError(f"{source.folder}: {len(source.images)} images, --bear 76 drops the first {drop}")
    taken = np.arange(drop, len(source.images))
    if config.images > len(taken):
        raise InputError(f"{source.folder}: {len(taken)} images, --images wants {config.images}")
    if config.images:
        taken = np.sort(generator(0, source.shape, "images").permutation(taken)[: config.images])
    files = [source.folder / source.images[number] for number in taken.tolist()]
    extra = [value for value in (config.images, config.focal) if value]
    return build_object(
        source.shape, Images.of_files(files, lambda path: _read(path, config.bits)), truth.mask,
        source.directions[taken], source.intensities[taken], normals=truth.normals, margin=config.margin,
        files=[source.folder / "mask.png", truth.origin], camera=Camera(config.focal) if config.focal else None,
        settings=(config.bits, *extra),
    )  # fmt: skip


def _read(path: Path, bits: int) -> np.ndarray:  # (H, W, 3) float32, full scale 1
    pixels = read_image(path)
    if bits == 16 and bit_depth(pixels) == 8:
        raise InputError(f"{path}: has 8 bits per channel, not the original's 16; evaluate with --bits 8")
    if bits == 8 and bit_depth(pixels) == 16:
        pixels = (pixels >> 8).astype(np.uint8)
    return to_unit(pixels)
