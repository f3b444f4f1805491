"""Samples of foreign trees: what the readers of each layout list, with the pixels of one read at a time."""

import hashlib
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import numpy as np

from render.exchange.folders import MARKER, read_record
from render.shared.errors import InputError
from render.shared.images import bit_depth, read_image, to_unit

Note = Callable[[str], None]


class Truth(NamedTuple):
    """Normals (H, W, 3) float32, unit in the mask and zero outside; the mask (H, W) bool; the file they come from."""

    normals: np.ndarray
    mask: np.ndarray
    origin: Path


@dataclass(frozen=True, kw_only=True, eq=False)
class Source:
    """One sample of a foreign tree, its pixels still on disk.

    Attributes:
        name: Short name, unique in the tree.
        shape: Name of the object (and view).
        material: Name of the material, or of the object where the layout knows no material.
        split: `train`, `val` or `test`.
        folder: Folder of the images.
        where: The same, relative to the tree, for records.
        images: Names of the image files, one per light.
        directions: (L, 3) float64, unit to the precision of the file.
        intensities: (L, 3) float64, ones where the layout has none.
        truth: Reads normals and mask.
    """

    name: str
    shape: str
    material: str
    split: str
    folder: Path
    where: str
    images: tuple[str, ...]
    directions: np.ndarray
    intensities: np.ndarray
    truth: Callable[[], Truth] = field(repr=False)

    def exposure(self) -> float | None:
        """Return the exposure our own export recorded next to the images, None in trees of others."""
        path = self.folder / MARKER
        if not path.is_file():
            return None
        value = read_record(path).get("exposure")
        if not isinstance(value, int | float) or not value > 0:
            raise InputError(f"{path}: exposure must be a positive number, got {value!r}; export the scene again")
        return float(value)

    def stack(self, size: tuple[int, int]) -> tuple[np.ndarray, int]:
        """Read the images: (L, H, W, 3) float32, full scale 1, divided per channel by the intensity; and their bits.

        Raises:
            InputError: a missing or damaged picture, or one of another size or depth than the others.
        """
        return read_stack([self.folder / name for name in self.images], size, self.intensities)

    def digest(self) -> str:
        """Return the SHA-256 of all image files and the file of the normals, in order."""
        digest = hashlib.sha256()
        for path in [*(self.folder / name for name in self.images), self.truth().origin]:
            digest.update(path.read_bytes())
        return digest.hexdigest()


def read_stack(paths: Sequence[Path], size: tuple[int, int], intensities: np.ndarray) -> tuple[np.ndarray, int]:
    """Read pictures of a size (H, W) under lights of intensities (L, 3); see `Source.stack`."""
    result, bits = np.empty((len(paths), *size, 3), np.float32), 0
    for image, path, intensity in zip(result, paths, intensities, strict=True):
        pixels = read_image(path)
        if pixels.shape[:2] != size:
            raise InputError(
                f"{path}: is {size_text(pixels.shape)}, the mask or normal map is {size_text(size)} (height x width); "
                "give all pictures of a sample one size"
            )
        bits = bits or bit_depth(pixels)
        if bit_depth(pixels) != bits:
            raise InputError(f"{path}: {bit_depth(pixels)} bits, the others {bits}; save all alike")
        image[:] = to_unit(pixels) / intensity.astype(np.float32)
    return result, bits


def read_mask(path: Path) -> np.ndarray:
    """Read a picture as a mask (H, W) bool: above half brightness."""
    pixels = read_image(path, channels=None)
    return pixels > np.iinfo(pixels.dtype).max // 2


@contextmanager
def noted(note: Note | None) -> Iterator[None]:
    """Give the complaint of an InputError to `note`; without one it is raised."""
    try:
        yield
    except InputError as error:
        if note is None:
            raise
        note(str(error))


def checked_truth(normals: np.ndarray, mask: np.ndarray, origin: Path) -> Truth:
    """Bring normals to unit length; what has none leaves the mask."""
    length = np.linalg.norm(np.nan_to_num(normals), axis=-1)
    mask = mask & np.isfinite(normals).all(-1) & (length > 0.1)
    if not mask.any():
        raise InputError(f"{origin}: no pixel with a normal inside the mask; give another normal map or mask")
    unit = np.where(mask[..., None], np.nan_to_num(normals) / np.maximum(length, 1e-6)[..., None], 0.0)
    return Truth(unit.astype(np.float32), mask, origin)


def refuse_several(root: Path, pattern: str, up: int) -> None:
    """Name the trees below `root` when there are any."""
    below = sorted({path.parents[up - 1].name for path in root.glob(pattern)})
    if below:
        which = f"{len(below)} trees" if len(below) > 1 else "a tree"
        raise InputError(
            f"{root}: holds {which} ({', '.join(below[:4])}); import one tree at a time, by its own folder"
        )


def size_text(shape: tuple[int, ...]) -> str:
    """Write a size as height x width."""
    return f"{shape[0]}x{shape[1]}"
