"""What Gourd&Apple and the Light Stage Data Gallery share: photographs with measured lights and no normals."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pipelines.benchmarks.stacks import MARGIN, Stack, files_digest
from pipelines.evaluate.evaluation import TestObject
from render.exchange.ingest import crop_box
from render.shared.errors import InputError
from render.shared.files import read_text
from render.shared.images import read_image, to_unit
from render.shared.tables import natural_key, read_names, read_numbers
from sdps.photos.picture_file import decode


def object_folders(root: Path, pattern: str, want: str) -> list[Path]:
    """Return the folders of a benchmark's objects: listed in objects.txt, or the folders with a file of `pattern`.

    Raises:
        InputError: no such folder, or no object in it.
    """
    if not root.is_dir():
        raise InputError(f"{root}: no such folder; {want}")
    if (root / "objects.txt").is_file():
        return [root / name for name in read_names(root / "objects.txt")]
    folders = sorted({path.parent for path in root.glob(f"*/{pattern}")}, key=lambda path: natural_key(path.name))
    if not folders:
        raise InputError(f"{root}: no object's folder with {pattern}; {want}")
    return folders


def read_directions(path: Path, sign: float) -> tuple[np.ndarray, np.ndarray | None]:
    """Read light directions of three columns, or four of which the first numbers the lights.

    Args:
        path: The file.
        sign: 1 where vectors point to the light, -1 where they point the way light travels.

    Returns:
        Unit directions (L, 3) float64 from the surface to the light, and the numbers (L,), None where there are none.
    """
    table, numbers = read_table(path)
    length = np.linalg.norm(table, axis=1, keepdims=True)
    if not (length > 0).all():
        raise InputError(f"{path}: line {int(np.argmin(length)) + 1} is a zero vector; repair it")
    return sign * table / length, numbers


def read_intensities(path: Path, count: int) -> np.ndarray:  # (L, 3)
    """Read light intensities of R, G and B, numbered or not."""
    table, _ = read_table(path)
    if len(table) != count:
        raise InputError(f"{path}: {len(table)} rows for {count} lights; give one row per light")
    if not (table > 0).all():
        raise InputError(f"{path}: line {int(np.argmin(table.min(1))) + 1} is not positive; repair it")
    return table


def read_table(path: Path) -> tuple[np.ndarray, np.ndarray | None]:
    """Read (L, 3) numbers, and the numbering (L,) where there is a column of it in front."""
    wide = any(len(line.split()) == 4 for line in read_text(path).splitlines())
    table = read_numbers(path, 4 if wide else 3)
    if not len(table):
        raise InputError(f"{path}: no light in it; give one row per image")
    return (table[:, 1:], table[:, 0]) if wide else (table, None)


def picture_files(folder: Path, suffixes: Sequence[str], count: int) -> list[Path]:
    """Return the numbered pictures of a folder in natural order: of the first suffix that there are any of.

    Raises:
        InputError: none, or another number than of lights.
    """
    for suffix in suffixes:
        found = [
            path for path in folder.glob(f"*{suffix}") if path.stem[-1:].isdigit() and not path.name.startswith(".")
        ]
        if found:
            if len(found) != count:
                raise InputError(f"{folder}: {len(found)} {suffix} images for {count} lights; give one image per light")
            return sorted(found, key=lambda path: natural_key(path.name))
    raise InputError(f"{folder}: no images; want files numbered in their names that end in {' or '.join(suffixes)}")


def binary_mask(path: Path) -> np.ndarray:  # (H, W) bool
    """Read a mask, whatever its foreground value (1 in Gourd&Apple, 255 elsewhere)."""
    pixels = read_image(path, channels=None)
    mask = pixels > pixels.max() // 2
    if not mask.any():
        raise InputError(f"{path}: is black throughout; give the object's mask")
    return mask


def packed_images(path: Path, count: int) -> Callable[[int], np.ndarray]:
    """Return what reads image k of an array (H, W, 3 L) as the loaders of SDPS-Net's family keep them.

    Raises:
        InputError: damaged, or another number of images than of lights.
    """
    try:
        array = np.load(path, mmap_mode="r", allow_pickle=False)
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: damaged or not an array ({error}); convert the images again") from error
    if array.ndim != 3 or array.shape[2] != 3 * count:
        raise InputError(f"{path}: is {array.shape}; want height x width x {3 * count}, RGB of {count} lights in turn")
    return lambda number: np.asarray(array[..., 3 * number : 3 * number + 3], np.float32)


def picture_reader(files: Sequence[Path], gamma: float) -> Callable[[int], np.ndarray]:
    """Return what reads picture k as linear radiance: integers to the power `gamma`, floats as they are."""

    def read(number: int) -> np.ndarray:  # (H, W, 3) float32
        pixels = decode(files[number]).pixels
        return pixels if pixels.dtype.kind == "f" else to_unit(pixels) ** np.float32(gamma)

    return read


def photographed(
    name: str,
    read: Callable[[int], np.ndarray],
    names: Sequence[str],
    mask: np.ndarray,
    directions: np.ndarray,
    intensities: np.ndarray,
    *,
    files: Sequence[Path],
    settings: tuple[Any, ...],
    longest: int,
) -> TestObject:
    """Return an object of which the lights are known and the normals are not; its images stay on disk.

    Args:
        name: The object.
        read: Reads image k, (H, W, 3) float32.
        names: Of the L images, for complaints.
        mask: (H, W) bool.
        directions: (L, 3), from the surface to the light.
        intensities: (L, 3).
        files: Everything the images and the mask come from.
        settings: What else they depend on.
        longest: Greatest side in pixels, 0 for no limit.
    """
    stack = Stack(read, names, mask, crop_box(mask, MARGIN), longest)
    parts = (*settings, MARGIN, longest, directions.tolist(), intensities.tolist())
    return TestObject(
        name=name,
        digest=files_digest(files, *parts),
        load=lambda: stack,
        mask=stack.mask,
        light_directions=directions.astype(np.float32),
        intensities=intensities,
    )
