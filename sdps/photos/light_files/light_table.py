"""What the readers of light files hand on: numbers in rows, and what the file says about them."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Want:
    """What a file should hold.

    Attributes:
        widths: Numbers of a row, without a number of the picture before them.
        text: The same in words.
        lights: Directions, with or without intensities; else intensities alone.
    """

    widths: tuple[int, ...]
    text: str
    lights: bool


LIGHTS = Want((3, 4, 6), "x y z, x y z i or x y z r g b", True)
INTENSITIES = Want((1, 3), "i or r g b", False)


@dataclass(frozen=True)
class Near:
    """What a file says of its positions.

    Attributes:
        unit: mm, cm, m, pixels, or objects: sizes of the object.
        object: Where the object's middle lies, in the file's coordinates.
    """

    unit: str
    object: tuple[float, float, float] = (0.0, 0.0, 0.0)


@dataclass(frozen=True, eq=False)
class Table:
    """Rows as they are in a file.

    Attributes:
        values: (N, W) float64, finite.
        names: (N,) what the file calls the rows; None where it has no names.
        lines: (N,) numbers of the lines in the file, for messages; () where the file has no lines.
        columns: (W,) what the file says the numbers are: x, y, z, i, r, g, b, azimuth, elevation, slant or tilt; ()
            where it does not say.
        radians: Angles are in radians, not in degrees.
        signs: Signs that turn the file's own axes into ours.
        strengths: (N, 1) or (N, 3) intensities that stand apart from the rows; None where there are none.
        doubt: Why the rows may not belong to the pictures; empty where nothing speaks against it.
        notes: Plain sentences about what was done.
        near: The rows are positions of lamps, not directions; None of directions.
        image_width: Millimetres that the pictures' whole width shows; 0 where the file does not say.
    """

    values: np.ndarray
    names: tuple[str, ...] | None = None
    lines: tuple[int, ...] = ()
    columns: tuple[str, ...] = ()
    radians: bool = False
    signs: tuple[int, int, int] = (1, 1, 1)
    strengths: np.ndarray | None = None
    doubt: str = ""
    notes: tuple[str, ...] = ()
    near: Near | None = None
    image_width: float = 0.0


def are_unit(vectors: np.ndarray) -> bool:
    """Tell whether all rows of (N, 3) are unit vectors, as files with two decimals have them."""
    return bool(np.abs(np.linalg.norm(vectors, axis=1) - 1).max() < 0.02)


def are_level(vectors: np.ndarray) -> bool:
    """Tell whether the rows of (N, 3) have about one length and point to different sides, as lamps of a dome do."""
    lengths = np.linalg.norm(vectors, axis=1)
    if lengths.min() <= 0 or np.ptp(lengths) > 0.1 * lengths.mean():
        return False
    mean = (vectors / lengths[:, None]).mean(0)
    return bool(np.linalg.norm(mean) < np.cos(np.radians(5.0)))


def counts(values: Sequence[float] | np.ndarray) -> bool:
    """Tell whether numbers are 0 to N - 1 or 1 to N, in any order."""
    found = np.sort(np.asarray(values, np.float64))
    return any(np.array_equal(found, np.arange(first, first + len(found))) for first in (0, 1))
