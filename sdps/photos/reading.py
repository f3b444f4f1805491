"""A folder of photographs as images that are read on demand, with mask and, where given, lights.

Legend: L pictures of H x W pixels.
"""

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from render.shared.errors import InputError
from render.shared.imaging.reducing import check_scale, reduced, reduced_mask, reduced_shape
from render.shared.progress import progress_bar, stage
from sdps.photos.doubts import Doubts
from sdps.photos.gamma import resolve_gamma
from sdps.photos.light_files import Lights, read_intensities, read_lights
from sdps.photos.listing import find_mask, list_pictures
from sdps.photos.masks import Variation, automatic_mask, read_mask
from sdps.photos.picture_file import Coding, Picture, decode, turned
from sdps.photos.response import brightness, to_linear

MOST_PIXELS = 50_000_000
"""Of a picture, once reduced: the checks hold one at a time, and 70 bytes for each of its pixels."""
_AT_ONCE = 2**20
_LOG = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class Photographs:
    """A folder of photographs; an `ImageSource` (sdps/inference/image_source.py) that holds no pixel in memory.

    `len(photos)` is L; `photos[2:5]` reads three files anew and returns (3, H, W, 3) float32, linear radiance with 1
    for full scale (floating-point files: as they are), 0 for what is negative or not finite.

    Attributes:
        folder: Where the files are.
        files: (L,) names below the folder: natural order, or that of names.txt, filenames.txt or `names`.
        shape: (H, W), once turned and reduced.
        bits: Per channel: 8 or 16, 32 of floating-point files (16 of half ones).
        gamma: The curve that was taken off: linear, srgb, or an exponent.
        mask: (H, W) bool, not empty; every pixel in it is finite in all pictures, but with `anyway`.
        mask_origin: `file` or `automatic`.
        light_directions: (L, 3) float32, unit, x right, y up, z to the camera, from the surface to the light; or None.
        intensities: (L,) or (L, 3) float32, relative; or None.
        notes: What was decided, in plain sentences.
        coding: Kind and depth of the files.
        orientation: EXIF orientation tag that all pictures were turned by.
        overridden: Faults that would have stopped `load`, but for `anyway`.
        scale: What the sides of the files' pictures are multiplied by as they are read.
    """

    folder: Path
    files: tuple[str, ...]
    shape: tuple[int, int]
    bits: int
    gamma: str | float
    mask: np.ndarray
    mask_origin: str
    light_directions: np.ndarray | None
    intensities: np.ndarray | None
    notes: tuple[str, ...]
    coding: Coding
    orientation: int
    overridden: tuple[str, ...] = ()
    scale: float = 1.0

    def __len__(self) -> int:
        return len(self.files)

    def __getitem__(self, part: slice, /) -> np.ndarray:
        """Read the pictures of `part`, (n, H, W, 3) float32.

        Raises:
            InputError: a file that changed or was removed since the folder was loaded.
        """
        return self.window(part, slice(None), slice(None))

    def window(self, part: slice, rows: slice, columns: slice) -> np.ndarray:
        """Read rows and columns of the pictures of `part`, (n, h, w, 3) float32, in less memory than all of them take.

        Raises:
            InputError: as indexing.
        """
        numbers = range(len(self))[part]
        sides = (len(range(length)[some]) for length, some in zip(self.shape, (rows, columns), strict=True))
        images = np.empty((len(numbers), *sides, 3), np.float32)
        for image, number in zip(images, numbers, strict=True):
            picture = decode(self.folder / self.files[number])
            pixels = turned(picture.pixels, self.orientation)
            if reduced_shape(pixels.shape[:2], self.scale) != self.shape or picture.coding != self.coding:
                raise InputError(f"{self.folder / self.files[number]}: changed while it was in use; start again")
            if self.scale == 1.0:
                to_linear(pixels[rows, columns], self.gamma, image)
            else:
                for channel in range(3):  # one by one: a whole picture of floats may take a gigabyte
                    linear = to_linear(pixels[..., channel], self.gamma)
                    image[..., channel] = reduced(linear, self.shape)[rows, columns]
        return images

    @property
    def saturation(self) -> float:
        """Linear value from which on a pixel of integer files counts as saturated; infinite for floating point."""
        return float("inf") if self.coding.floating else float(to_linear(np.array([253], np.uint8), self.gamma)[0])


def load(
    folder: str | Path,
    *,
    mask: str | Path | None = None,
    lights: str | Path | None = None,
    intensities: str | Path | None = None,
    frame: str = "y-up",
    gamma: str | float = "auto",
    names: Sequence[str] | None = None,
    anyway: bool = False,
    scale: float = 1.0,
) -> Photographs:
    """Look through a folder of photographs of a static object under one distant light each, seen orthographically.

    Every file is decoded once, one at a time, so that a damaged one is found now (the folder: docs/guides/capture.md).

    Args:
        folder: PNG, TIFF, JPEG or EXR files of one kind and size, and what may lie beside them.
        mask: A picture, bright where the object is; None for the folder's mask.* or, without one, an automatic mask.
        lights: A lights file, or `folder` for its lights.json or light_directions.txt; None for unknown lights.
        intensities: A file of intensities, or `folder` for its light_intensities.txt; None for those of `lights`.
        frame: Axes of the lights file: y-up, y-down, x-left, z-away, several joined by commas.
        gamma: linear, srgb, the exponent of a power curve, or auto by kind of file and colour profile.
        names: Files or glob patterns to use, in this order; one that begins with `!` leaves files out.
        anyway: Go on where a check stops although one could: values that are not finite in the mask, pictures that
            never change without a mask, lights behind the object. `check` then lists these as errors.
        scale: Reduces pictures and mask by area averaging of linear values as they are read; 0.5 halves the sides, and
            takes a quarter of the time and memory. Above 0, at most 1.

    Raises:
        InputError: a folder that cannot be used: the file, what is wrong with it, and the remedy.
    """
    folder, scale = Path(folder), check_scale(scale)
    files, notes = list_pictures(folder, names)
    doubts = Doubts(anyway)
    survey = _survey(folder, files, gamma, find_mask(folder) if mask is None else Path(mask), doubts, scale)
    directions, strengths, told = _lights(folder, files, lights, intensities, frame, doubts)
    photos = Photographs(
        folder=folder, files=files, shape=survey.mask.shape, bits=survey.coding.bits, gamma=survey.gamma,
        mask=survey.mask, mask_origin=survey.origin, light_directions=directions, intensities=strengths,
        notes=(*notes, *survey.notes, *told), coding=survey.coding, orientation=survey.orientation,
        overridden=tuple(doubts.overridden), scale=scale,
    )  # fmt: skip
    if photos.mask_origin == "automatic" and photos.mask.all():
        _LOG.warning("%s", next(note for note in photos.notes if "whole frame" in note))
    return photos


@dataclass(frozen=True, eq=False)
class _Survey:
    """What one look at all files tells."""

    coding: Coding
    gamma: str | float
    orientation: int
    mask: np.ndarray
    origin: str
    notes: tuple[str, ...]


def _survey(
    folder: Path, files: tuple[str, ...], gamma: str | float, mask_file: Path | None, doubts: Doubts, scale: float
) -> _Survey:
    """Decode every file once: all of one kind and size, finite in the mask, and the mask if it has to be found."""
    first = decode(folder / files[0])
    applied, why = resolve_gamma(gamma, first.coding, folder)
    full = turned(first.pixels, first.orientation).shape[:2]
    shape = reduced_shape(full, scale)
    _refuse_huge(folder / files[0], full, shape, doubts)
    given = None if mask_file is None else _reduced_mask(mask_file, full, shape)
    variation = Variation(shape)
    broken = np.full(shape, -1, np.int32)  # the first picture with a value that is not finite
    turns = set()
    for number, file in enumerate(progress_bar(files, desc="photographs", unit="picture", delay=5)):
        picture = first if number == 0 else decode(folder / file)
        _refuse_other(folder, files[0], first, file, picture)
        turns.add(picture.orientation)
        pixels = turned(picture.pixels, first.orientation)
        if picture.coding.floating:
            touched = reduced((~np.isfinite(pixels).all(-1)).astype(np.float32), shape) > 0
            broken[(broken < 0) & touched] = number
        if given is None:
            variation.add(reduced(_grey(pixels, applied), shape))
        stage("reading", number + 1, len(files))
    notes = [why, *_orientation_note(first.orientation, turns), *_scale_note(full, shape)]
    if given is None and not variation.changes().any():
        doubts.stop(f"{folder}: nothing changes between the pictures; is the lamp on and moved? otherwise give a mask")
    known = None if given is None or mask_file is None else (given, f"the mask is {mask_file.name}")
    try:
        mask, said = known or automatic_mask(variation)
    except InputError as error:
        raise InputError(f"{folder}: {error}") from error
    _refuse_broken(folder, files, broken, mask, doubts)
    if (broken >= 0).any():
        notes.append("values that are not finite were set to 0")
    origin = "automatic" if given is None else "file"
    return _Survey(first.coding, applied, first.orientation, mask, origin, (*notes, said))


def _refuse_other(folder: Path, one: str, first: Picture, other: str, picture: Picture) -> None:
    """Refuse a picture of another size or coding than the first."""
    if picture.pixels.shape != first.pixels.shape:
        sizes = [f"{pixels.shape[1]}x{pixels.shape[0]}" for pixels in (picture.pixels, first.pixels)]
        raise InputError(
            f"{folder / other}: is {sizes[0]} pixels, {one} is {sizes[1]}; all pictures must have one size and the "
            "camera must not move"
        )
    if picture.coding != first.coding:
        raise InputError(
            f"{folder / other}: is {picture.coding}, {one} is {first.coding}; keep one kind in the folder or name the "
            "pictures to use"
        )


def _refuse_broken(folder: Path, files: tuple[str, ...], broken: np.ndarray, mask: np.ndarray, doubts: Doubts) -> None:
    """Refuse values that are not finite inside the mask."""
    inside = broken[mask]
    bad = inside[inside >= 0]
    if len(bad):
        name = files[int(bad.min())]
        doubts.stop(
            f"{folder / name}: NaN or infinite values inside the mask ({len(bad)} pixels over all pictures); write it "
            "again or cut them out of the mask"
        )


def _grey(pixels: np.ndarray, gamma: str | float) -> np.ndarray:
    """Return the brightness of pixels (H, W, 3), a few rows at a time."""
    step = max(1, _AT_ONCE // pixels.shape[1])
    rows = (pixels[start : start + step] for start in range(0, len(pixels), step))
    return np.concatenate([brightness(to_linear(some, gamma)) for some in rows])


def _refuse_huge(path: Path, full: tuple[int, int], shape: tuple[int, int], doubts: Doubts) -> None:
    """Refuse pictures that would fill the memory one by one."""
    if shape[0] * shape[1] > MOST_PIXELS:
        fits = int(20 * (MOST_PIXELS / (full[0] * full[1])) ** 0.5) / 20
        doubts.stop(
            f"{path}: is {full[1]}x{full[0]} pixels; more than {MOST_PIXELS // 10**6} million would take more than "
            f"4 GiB of memory; give --scale {fits:g} (in Python load(..., scale={fits:g}))"
        )


def _reduced_mask(path: Path, full: tuple[int, int], shape: tuple[int, int]) -> np.ndarray:
    """Read a mask of the files' size and reduce it as the pictures are, or one that is of their size already."""
    try:
        mask = reduced_mask(read_mask(path, full), shape)
    except InputError as error:
        try:
            mask = read_mask(path, shape)
        except InputError:
            raise error from error.__cause__
    if not mask.any():
        raise InputError(f"{path}: nothing is left of the mask once it is reduced; give a larger scale")
    return mask


def _scale_note(full: tuple[int, int], shape: tuple[int, int]) -> list[str]:
    if full == shape:
        return []
    return [f"pictures and mask were reduced from {full[1]}x{full[0]} to {shape[1]}x{shape[0]} pixels (--scale)"]


def _orientation_note(first: int, turns: set[int]) -> list[str]:
    if len(turns) > 1:
        return [
            "the pictures' orientation tags differ, as happens when the camera looks down; all were turned as the first"
        ]
    return [] if first == 1 else ["all pictures were turned upright as their orientation tag says"]


def _lights(
    folder: Path,
    files: tuple[str, ...],
    lights: str | Path | None,
    intensities: str | Path | None,
    frame: str,
    doubts: Doubts,
) -> tuple[np.ndarray | None, np.ndarray | None, tuple[str, ...]]:
    """Read directions and intensities where asked for; frame flags without lights are checked all the same."""
    directions = strengths = None
    notes: tuple[str, ...] = ("lights are unknown and will be estimated, where the method can",)
    path = _beside(folder, lights, ("lights.json", "light_directions.txt"))
    if path is not None:
        read: Lights = read_lights(path, files, frame, doubts)
        directions, strengths, notes = read.directions, read.intensities, read.notes
    second = _beside(folder, intensities, ("light_intensities.txt",))
    if second is None and path is not None and path.name == "light_directions.txt" and str(lights) == "folder":
        second = path.with_name("light_intensities.txt") if path.with_name("light_intensities.txt").is_file() else None
    if second is not None:
        if strengths is not None and path is not None:
            raise InputError(f"{second}: {path.name} holds intensities as well; keep those of one file")
        strengths = read_intensities(second, files)
        notes = (*notes, f"intensities are those of {second.name}")
    return directions, strengths, notes


def _beside(folder: Path, asked: str | Path | None, known: tuple[str, ...]) -> Path | None:
    """Resolve `folder` to the first known file of the folder."""
    if asked is None or str(asked) != "folder":
        return None if asked is None else Path(asked)
    found = next((folder / name for name in known if (folder / name).is_file()), None)
    if found is None:
        raise InputError(f"{folder}: no {' or '.join(known)} in it; give the file's path")
    return found
