"""How near lamps stand to an object, from positions or from what the user says of their distance."""

import re
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from render.shared.errors import InputError, list_names, unknown
from sdps.photos.light_files.light_positions import read_unit

FLAG = "--light-distance"
AUTO, FAR, EACH = "auto", "far", "each"

_WORDS = (AUTO, FAR, EACH)
_MILLIMETRES = {"mm": 1.0, "cm": 10.0, "m": 1000.0}
_NUMBER = re.compile(r"([-+]?(?:\d+\.?\d*|\.\d+)(?:e[-+]?\d+)?|inf)\s*([^\W\d_]*)", re.IGNORECASE)


@dataclass(frozen=True)
class LightDistance:
    """What the user says of how far the lamps are.

    Attributes:
        distance: Of all lamps from the object's middle; inf: distant; None: not known.
        unit: Its unit, as of positions (`light_positions.UNITS`).
        each: Where it is not known, each lamp may have its own.
    """

    distance: float | None = None
    unit: str = "objects"
    each: bool = False


@dataclass(frozen=True)
class Yardstick:
    """What turns distances into radii of the object.

    Attributes:
        radius: Of the object, half the longer side of its outline's box, in pixels as they are read.
        pixel_size: Millimetres per such pixel; None: not known.
        scale: Such pixels per pixel of the files.
    """

    radius: float
    pixel_size: float | None = None
    scale: float = 1.0

    def radii(self, distances: np.ndarray, unit: str, where: str) -> np.ndarray:
        """Return distances (L,) in radii of the object.

        Raises:
            InputError: millimetres, centimetres or metres where the size of a pixel is not known; the line begins with
                `where`.
        """
        if unit == "objects":
            return 2.0 * distances
        if unit == "pixels":
            return distances * self.scale / self.radius
        if self.pixel_size is None:
            raise InputError(
                f"{where}: distances in {unit} need the size of a pixel; give --pixel-size (millimetres per pixel at "
                "the object), or distances in pixels or object sizes"
            )
        return distances * _MILLIMETRES[unit] / (self.pixel_size * self.radius)


def read_distance(value: str | float | None) -> LightDistance:
    """Read `far`, `auto`, `each`, a number of object sizes, or a number with a unit such as 400mm.

    Raises:
        InputError: another word, a unit that is not known, or a distance that is not above 0.
    """
    text = AUTO if value is None else str(value).strip().lower()
    if text in _WORDS:
        return LightDistance(np.inf if text == FAR else None, each=text == EACH)
    found = _NUMBER.fullmatch(text)
    if found is None:
        remedy = "or give a number of object sizes, or one with a unit, as in 400mm"
        raise InputError(f"{FLAG}: {unknown('distance', text, _WORDS, remedy)}")
    distance = float(found[1])
    if not distance > 0.0:
        raise InputError(f"{FLAG} {text}: must be above 0; write {FAR} for distant lamps")
    return LightDistance(distance, read_unit(FLAG, found[2]) if found[2] else "objects")


def find_nearness(
    wanted: LightDistance,
    files: Sequence[str],
    by: Yardstick,
    distances: np.ndarray | None = None,
    unit: str = "",
    name: str = "",
) -> np.ndarray | None:
    """Return the object's radius over the distance of each lamp, (L,) float32, 0 of distant ones; None: not known.

    Args:
        wanted: What the user says.
        files: Names of the pictures, (L,).
        by: What turns distances into radii.
        distances: (L,) of a lights file with positions, in `unit`; None of one with directions.
        unit: Their unit.
        name: Name of the file.

    Raises:
        InputError: a lamp inside the object, two answers to how far the lamps are, or no size of a pixel for lengths.
    """
    said = wanted.distance
    if said == np.inf:
        return np.zeros(len(files), np.float32)
    if distances is None:
        if said is None:
            return None
        radii = by.radii(np.full(len(files), said), wanted.unit, FLAG)
        if radii[0] <= 1.0:
            raise InputError(
                f"{FLAG} {said:g} {wanted.unit}: the lamps would stand inside the object, which reaches "
                f"{said / radii[0]:.4g} {wanted.unit} from its middle; correct the distance or its unit"
            )
        return (1.0 / radii).astype(np.float32)
    if said is not None:
        raise InputError(f"{name} says where each lamp stood; leave {FLAG} out, or write {FLAG} {FAR}")
    radii = by.radii(distances, unit, name)
    inside = np.flatnonzero(radii <= 1.0).tolist()
    if inside:
        one = len(inside) == 1
        raise InputError(
            f"{name}: the {'lamp' if one else 'lamps'} of {list_names([files[number] for number in inside])} "
            f"{'stands' if one else 'stand'} inside the object, {distances[inside].min():.4g} {unit} from its middle; "
            "correct the position, the unit, or where the object is"
        )
    return (1.0 / radii).astype(np.float32)
