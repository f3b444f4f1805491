"""The camera behind photographs: what the user says of it, else what the files' EXIF data say.

Millimetres are 35 mm equivalents, as EXIF's FocalLengthIn35mmFilm: the picture's diagonal counts for the 43.27 mm of
24 x 36 mm film, whatever its sides' ratio and whichever way it was turned. Pixels, of focal lengths, principal points
and sizes alike, are those of the files as they are turned, before they are reduced.
"""

import re
import warnings
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from render.shared.errors import InputError, unknown
from sdps.core.geometry import ORTHOGRAPHIC, Camera

EXIF = 0x8769
"""Tag of TIFF's and JPEG's first directory that leads to the one with the tags below."""
FILM = float(np.hypot(24.0, 36.0))
"""Diagonal in millimetres."""
NOT_KNOWN = "not known: taken for orthographic"
AUTO = "auto"
_FLAT = "orthographic"
_EQUIVALENT, _WIDTH, _HEIGHT = 41989, 40962, 40963  # FocalLengthIn35mmFilm, PixelXDimension, PixelYDimension
_NAMES = {"FocalLengthIn35mmFilm": _EQUIVALENT, "PixelXDimension": _WIDTH, "PixelYDimension": _HEIGHT}  # of tifffile
_UNITS = ("mm", "px")
_FARTHEST = 1e7  # pixels of a principal point from the picture: beyond, products overflow
_LONGEST = 1e5  # the same; what is seen differs from a parallel view by less than a hundredth of a pixel
_SHORTEST = 0.2  # focal length over the longer side, 7 mm equivalent: no lens without distortion sees wider
_ALIKE = 0.01  # relative difference of side ratios of one picture at two sizes


@dataclass(frozen=True)
class Lens:
    """What a file's EXIF data say.

    Attributes:
        equivalent: 35 mm equivalent focal length in millimetres; 0: not known.
        frame: Longer and shorter side in pixels that the camera wrote; (0, 0): not known.
    """

    equivalent: float = 0.0
    frame: tuple[int, int] = (0, 0)


NO_LENS = Lens()


def read_lens(tags: Callable[[], Mapping[Any, Any]]) -> Lens:
    """Return what the EXIF directory that `tags` reads says, by number or tifffile's names; nothing if damaged."""
    try:
        with warnings.catch_warnings(action="ignore"):
            found = {_NAMES.get(tag, tag): value for tag, value in tags().items()}
            equivalent, *sides = (float(np.max(found.get(tag, 0))) for tag in (_EQUIVALENT, _WIDTH, _HEIGHT))
    except Exception:
        return NO_LENS
    whole = all(np.isfinite(side) and side >= 1 for side in sides)
    frame = (int(max(sides)), int(min(sides))) if whole else (0, 0)
    return Lens(equivalent if np.isfinite(equivalent) and equivalent > 0 else 0.0, frame)


@dataclass(frozen=True)
class SeenBy:
    """The camera that saw the pictures, as they are read.

    Attributes:
        camera: It, in pixels of the reduced pictures.
        origin: Where its focal length is from, in words.
        pixel_size: Millimetres per pixel of the reduced pictures, at the object's mean depth; None: not known.
        notes: What was decided, in plain sentences.
    """

    camera: Camera = ORTHOGRAPHIC
    origin: str = NOT_KNOWN
    pixel_size: float | None = None
    notes: tuple[str, ...] = ()


@dataclass(frozen=True)
class Wanted:
    """What the user says of the camera.

    Attributes:
        focal: Number of the focal length; inf: orthographic; None: as EXIF data say.
        unit: `mm` or `px`.
        principal: Column and row of the principal point; None: the middle.
        pixel_size: Millimetres per pixel; None: not known.
    """

    focal: float | None = None
    unit: str = "px"
    principal: tuple[float, float] | None = None
    pixel_size: float | None = None

    def find(self, lenses: Iterable[Lens], full: tuple[int, int], shape: tuple[int, int]) -> SeenBy:
        """Return the camera of pictures with sides `full` (H, W), read with sides `shape`, of their files' lenses.

        Raises:
            InputError: a focal length so short that it must have another unit.
        """
        lenses, factor = set(lenses), max(shape) / max(full)
        lens = lenses.pop() if len(lenses) == 1 else None
        focal, origin, notes = self._focal(lens, lenses, full)
        if focal < _SHORTEST * max(full):
            raise InputError(
                f"--focal: {focal:.4g} pixels are too few for a picture of {full[1]}x{full[0]}, which would see more "
                "than 130 degrees; a number alone counts pixels, write 28mm for a 35 mm equivalent"
            )
        if _LONGEST * max(full) < focal < np.inf:
            raise InputError(
                f"--focal: {focal:.4g} pixels are too many for a picture of {full[1]}x{full[0]}; for a camera that is "
                "so far away write orthographic"
            )
        if not np.isfinite(focal):
            unused = ["--principal does nothing without a focal length; give --focal"] if self.principal else []
            notes, camera = [*notes, *unused], ORTHOGRAPHIC
        else:
            camera = Camera(focal, self.principal).scale(factor)
        size = None if self.pixel_size is None else self.pixel_size / factor
        return SeenBy(camera, origin, size, tuple(notes))

    def _focal(self, lens: Lens | None, rest: set[Lens], full: tuple[int, int]) -> tuple[float, str, list[str]]:
        """Return the focal length in pixels, where it is from, and notes; `rest`: lenses, where they differ."""
        if self.focal is not None and (self.unit == "px" or not np.isfinite(self.focal)):
            return self.focal, "--focal", []
        if self.focal is None and lens is None and any(one.equivalent for one in rest):
            return np.inf, NOT_KNOWN, ["the pictures' EXIF data differ in the focal length, so it is not used; give "
                                       "--focal 28mm or the like"]  # fmt: skip
        lens = lens or NO_LENS
        equivalent = self.focal or lens.equivalent
        if not equivalent or (self.focal is None and equivalent < _SHORTEST * 36.0):
            return np.inf, NOT_KNOWN, []
        origin = "--focal" if self.focal else f"EXIF: {equivalent:g} mm (35 mm equivalent)"
        diagonal, cut = _original(lens, full)
        focal = equivalent / FILM * diagonal
        off = "" if self.focal else "; --focal orthographic leaves it out"
        return focal, origin, [f"focal length: {equivalent:g} mm (35 mm equivalent) are {focal:.0f} pixels{off}", *cut]


def _original(lens: Lens, full: tuple[int, int]) -> tuple[float, list[str]]:
    """Return the diagonal in pixels of what the camera took, where (H, W) may be a part of it, and a note if it is."""
    sides = max(full), min(full)
    if not all(lens.frame) or lens.frame == sides:
        return float(np.hypot(*sides)), []
    ratio = lens.frame[0] / lens.frame[1] / (sides[0] / sides[1])
    whole = f"EXIF data say {lens.frame[0]}x{lens.frame[1]} pixels, the pictures have {sides[0]}x{sides[1]}"
    if abs(ratio - 1.0) < _ALIKE or sides[0] > lens.frame[0] or sides[1] > lens.frame[1]:
        return float(np.hypot(*sides)), [f"{whole}: taken for the whole view at another size"]
    return float(np.hypot(*lens.frame)), [
        f"{whole}: taken for a part that was cut out; --principal COLUMN,ROW says where the middle of the whole lies"
    ]


def read_wanted(
    focal: str | float | None = None, principal: str | Iterable[float] | None = None, pixel_size: float | None = None
) -> Wanted:
    """Return what the flags --focal, --principal and --pixel-size say.

    Raises:
        InputError: a focal length or a size that is not above 0, a unit that is not known, or a principal point that
            is not two numbers.
    """
    number, unit = _read_focal(focal)
    if pixel_size is not None and not 1e-6 < pixel_size < 1e6:
        raise InputError(f"--pixel-size {pixel_size:g}: must be above 0 and under a million, in millimetres per pixel")
    return Wanted(number, unit, None if principal is None else _read_principal(principal), pixel_size)


def _read_focal(focal: str | float | None) -> tuple[float | None, str]:
    """Return number and unit."""
    text = AUTO if focal is None else str(focal).strip().lower()
    if text in (AUTO, ""):
        return None, "px"
    if text == _FLAT:
        return np.inf, "px"
    found = re.fullmatch(r"([-+]?(?:\d+\.?\d*|\.\d+)(?:e[-+]?\d+)?)\s*(.*)", text)
    if found is None:
        raise unknown("--focal", text, (AUTO, _FLAT), "or write a length as 28mm (35 mm equivalent) or 3772px")
    number, unit = float(found[1]), found[2] or "px"
    if unit not in _UNITS:
        raise unknown("unit of --focal", unit, _UNITS, "write 28mm (35 mm equivalent) or 3772px")
    if not 0.0 < number < np.inf:
        raise InputError(f"--focal {text}: must be above 0; leave it out if it is not known")
    return number, unit


def _read_principal(principal: str | Iterable[float]) -> tuple[float, float]:
    """Return column and row."""
    parts = principal.split(",") if isinstance(principal, str) else list(principal)
    try:
        column, row = (float(part) for part in parts)
    except (TypeError, ValueError):
        column = row = np.nan
    if not (np.abs([column, row]) < _FARTHEST).all():
        said = principal if isinstance(principal, str) else ",".join(map(str, parts))
        raise InputError(f"--principal {said}: must be two numbers, COLUMN,ROW in pixels, such as 2016,1512")
    return column, row
