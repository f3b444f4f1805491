"""Samples of foreign trees: what each layout lists, with the pixels of one read at a time."""

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from render.shared.errors import InputError
from render.shared.files import read_json
from render.shared.images import bit_depth, decode_normals, read_image, to_unit
from render.shared.tables import check_directions, line_of_row, read_numbers

Note = Callable[[str], None]
MARKER = "scene.json"  # what our own export leaves in the folder of a scene


class Truth(NamedTuple):
    """Normals (H, W, 3) float32, unit in the mask and zero outside; the mask (H, W) bool; the file they come from."""

    normals: np.ndarray
    mask: np.ndarray
    origin: Path

    @classmethod
    def of(cls, normals: np.ndarray, mask: np.ndarray, origin: Path) -> "Truth":
        """Bring normals to unit length; what has none leaves the mask.

        Raises:
            InputError: a mask of another size, or without a normal in it.
        """
        if normals.shape[:2] != mask.shape:
            raise InputError(
                f"{origin.parent / 'mask.png'}: is {size_text(mask.shape)}, {origin.name} is "
                f"{size_text(normals.shape)} (height x width); give both one size"
            )
        length = np.linalg.norm(np.nan_to_num(normals), axis=-1)
        mask = mask & np.isfinite(normals).all(-1) & (length > 0.1)
        if not mask.any():
            raise InputError(f"{origin}: no pixel with a normal inside the mask; give another normal map or mask")
        unit = np.where(mask[..., None], np.nan_to_num(normals) / np.maximum(length, 1e-6)[..., None], 0.0)
        return cls(unit.astype(np.float32), mask, origin)


@dataclass(frozen=True, kw_only=True, eq=False)
class Source:
    """One sample of a foreign tree, its pixels still on disk.

    Attributes:
        shape: Name of the object (and view).
        material: Name of the material, or of the object where the layout knows no material.
        split: `train`, `val` or `test`.
        folder: Folder of the images.
        where: The same, relative to the tree, for records.
        images: Names of the image files, one per light.
        directions: (L, 3) float64, unit to the precision of the file; (0, 3) where the tree has none.
        intensities: (L, 3) float64, ones where the tree has none.
        truth: Reads normals and mask.
    """

    shape: str
    material: str
    split: str = "test"
    folder: Path
    where: str
    images: Sequence[str]
    directions: np.ndarray
    intensities: np.ndarray
    truth: Callable[[], Truth] = field(repr=False)

    @classmethod
    def of_object(
        cls, folder: Path, suffix: str, images: Sequence[str], lights: tuple[np.ndarray, np.ndarray],
        truth: Callable[[], Truth],
    ) -> "Source":  # fmt: skip
        """Describe the sample of a layout with a folder per object, called by the object's name and a suffix."""
        name = folder.name.removesuffix(suffix) or folder.name
        return cls(
            shape=name, material=name, folder=folder, where=folder.name, images=images, directions=lights[0],
            intensities=lights[1], truth=truth,
        )  # fmt: skip

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
        result, bits = np.empty((len(self.images), *size, 3), np.float32), 0
        for image, name, intensity in zip(result, self.images, self.intensities, strict=True):
            path = self.folder / name
            pixels = read_image(path)
            if pixels.shape[:2] != size:
                raise InputError(
                    f"{path}: is {size_text(pixels.shape)}, the mask or normal map is {size_text(size)} (height x "
                    "width); give all pictures of a sample one size"
                )
            bits = bits or bit_depth(pixels)
            if bit_depth(pixels) != bits:
                raise InputError(f"{path}: {bit_depth(pixels)} bits, the others {bits}; save all alike")
            image[:] = to_unit(pixels) / intensity.astype(np.float32)
        return result, bits

    def digest(self) -> str:
        """Return the SHA-256 of all image files and the file of the normals, in order."""
        digest = hashlib.sha256()
        for path in [*(self.folder / name for name in self.images), self.truth().origin]:
            digest.update(path.read_bytes())
        return digest.hexdigest()


def read_record(path: Path) -> dict[str, Any]:
    """Read a record of an export or import.

    Raises:
        InputError: not a JSON object.
    """
    value = read_json(path, "delete the folder and export it again")
    if not isinstance(value, dict):
        raise InputError(f"{path}: is not a record of an export; delete the folder and export it again")
    return value


def read_lights(folder: Path, count: int, *, optional: bool = False) -> tuple[np.ndarray, np.ndarray]:
    """Read light_directions.txt and light_intensities.txt of so many images, as `Source` holds them.

    Raises:
        InputError: a file that is missing though not optional, another number of rows, directions that are not unit
            vectors, or intensities that are not positive.
    """
    directions, intensities = np.zeros((0, 3)), np.ones((count, 3))
    path = folder / "light_directions.txt"
    if path.is_file() or not optional:
        directions = check_directions(read_numbers(path, 3, count, "image"), path)
    path = folder / "light_intensities.txt"
    if path.is_file() or not optional:
        intensities = read_numbers(path, 3, count, "image")
        dark = np.flatnonzero(intensities.min(1) <= 0)
        if dark.size:
            raise InputError(f"{path}: line {line_of_row(path, int(dark[0]))} is not positive; repair it")
    return directions, intensities


def read_mask(path: Path) -> np.ndarray:
    """Read a picture as a mask (H, W) bool: above half brightness, but not empty."""
    pixels = read_image(path, channels=None)
    mask: np.ndarray = pixels > np.iinfo(pixels.dtype).max // 2
    if not mask.any():
        raise InputError(f"{path}: the mask is empty; mark the object")
    return mask


def read_painted_truth(folder: Path, normals_name: str) -> Truth:
    """Read mask.png and a normal map, which may be missing: normals are zero then.

    Raises:
        InputError: a damaged picture, another size, or a pixel of the mask without a normal.
    """
    mask, path = read_mask(folder / "mask.png"), folder / normals_name
    if not path.is_file():
        return Truth(np.zeros((*mask.shape, 3), np.float32), mask, folder / "mask.png")
    truth = Truth.of(decode_normals(read_image(path))[0], mask, path)
    lacking = int((mask & ~truth.mask).sum())
    if lacking:
        raise InputError(f"{path}: {lacking} pixels of mask.png have no normal; shrink it")
    return truth


def refuse_several(root: Path, pattern: str, up: int) -> None:
    """Name the trees below `root` when there are any."""
    below = sorted({path.parents[up - 1].name for path in root.glob(pattern)})
    if below:
        raise InputError(f"{root}: give one tree itself, not the folder above (which holds {', '.join(below[:4])})")


def size_text(shape: tuple[int, ...]) -> str:
    """Write a size as height x width."""
    return f"{shape[0]}x{shape[1]}"
