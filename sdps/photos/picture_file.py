"""One picture file, decoded at its own depth, by content and not by name."""

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from render.shared.decoding import decoding
from render.shared.errors import InputError
from render.shared.files import read_bytes
from render.shared.imaging.reducing import smaller_shape
from sdps.photos.pictures.decoding.decoders import DECODERS
from sdps.photos.pictures.lens import NO_LENS, Lens
from sdps.photos.pictures.picture_kinds import NAMED, SUFFIXES, Coding, foreign_kind, name_kind, picture_kind
from sdps.photos.pictures.profiles import read_profile


@dataclass(frozen=True, eq=False)
class Picture:
    """A decoded file.

    Attributes:
        pixels: (H, W, 3) uint8, uint16 or float32, RGB as stored, not turned.
        alpha: (H, W) of the same type, None where there is none.
        coding: How the values are meant.
        orientation: EXIF orientation tag, 1 to 8.
        layer: Which layer of an EXR file it was, empty where it has no name.
        lens: What its EXIF data say.
        exposure: Seconds times ISO over the squared f-number, 0 where it is not known.
    """

    pixels: np.ndarray
    alpha: np.ndarray | None
    coding: Coding
    orientation: int = 1
    layer: str = ""
    lens: Lens = NO_LENS
    exposure: float = 0.0


def decode(path: Path) -> Picture:
    """Read a picture file, of the kind that its bytes say; grey pictures are repeated to three channels.

    Raises:
        InputError: missing, empty, damaged or truncated, or of a kind that is not read.
    """
    data = read_bytes(path, "no such picture; copy it there or drop it from the list that names it")
    kind = picture_kind(data, path.name)
    if kind is None:
        raise _not_read(path, data)
    with _quiet(), decoding(path, name_kind(kind), "copy it again or leave it out"):
        read = DECODERS[kind](path, data)
    profile, floating = read_profile(read.profile), read.pixels.dtype.kind == "f"
    coding = Coding(kind, read.bits, floating, profile.exponent, profile.primaries, profile.rough)
    return Picture(read.pixels, read.alpha, coding, read.orientation, read.layer, read.lens, read.exposure)


def is_misnamed(name: str, kind: str) -> bool:
    """Tell whether a file's suffix stands for another kind than `kind`."""
    return SUFFIXES.get(Path(name).suffix.lower()) not in (None, kind)


def _not_read(path: Path, data: bytes) -> InputError:
    """Build the error for bytes that are not a picture of a kind that is read."""
    remedy = "copy it again or leave it out"
    if not data:
        return InputError(f"{path}: damaged, the file is empty; {remedy}")
    foreign = foreign_kind(data)
    if foreign is not None:
        return InputError(f"{path}: is {foreign}, which is not read; convert it to 16-bit TIFF or PNG, or leave it out")
    suffix = path.suffix.lower()
    if suffix in SUFFIXES:
        return InputError(f"{path}: damaged or not {name_kind(SUFFIXES[suffix])}; {remedy}")
    return InputError(f"{path}: is not a picture of a kind that is read ({NAMED}); convert it to 16-bit TIFF or PNG")


def orient_pixels(pixels: np.ndarray, orientation: int) -> np.ndarray:
    """Return (H, W, ...) pixels turned as an EXIF orientation tag asks."""
    if orientation >= 5:
        pixels = np.swapaxes(pixels, 0, 1)
    # After the transposition, tags 5 to 8 are none, mirrored left-right, turned by 180 degrees, mirrored top-bottom.
    flips = {2: (1,), 3: (0, 1), 4: (0,), 6: (1,), 7: (0, 1), 8: (0,)}.get(orientation, ())
    return np.flip(pixels, flips) if flips else pixels


def turn_pixels(picture: Picture, orientation: int, shape: tuple[int, int], scale: float = 1.0) -> np.ndarray:
    """Return a picture's pixels, whose sides times `scale` are to be `shape` (H, W), turned as the tag of all asks.

    One that has other sides then, as if it had been turned before it was saved, is turned by its own tag.
    """
    pixels = orient_pixels(picture.pixels, orientation)
    fits = smaller_shape(pixels.shape[:2], scale) == shape
    return pixels if fits else orient_pixels(picture.pixels, picture.orientation)


@contextmanager
def _quiet() -> Iterator[None]:
    """Keep the decoders' own complaints off standard error; what matters of them is raised."""
    before = cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    loggers = [logging.getLogger(name) for name in ("tifffile", "PIL")]
    levels = [logger.level for logger in loggers]
    for logger in loggers:
        logger.setLevel(logging.CRITICAL + 1)
    try:
        yield
    finally:
        cv2.utils.logging.setLogLevel(before)
        for logger, level in zip(loggers, levels, strict=True):
            logger.setLevel(level)
