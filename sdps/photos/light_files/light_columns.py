"""What the numbers of a light file are: rows or columns of x y z, angles, intensities."""

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from render.shared.errors import InputError
from sdps.photos.light_files.light_table import LIGHTS, Table, Want, are_level, are_unit, counts

AROUND, UP, DOWN = ("azimuth", "tilt"), ("elevation",), ("slant",)
"""Angles in the picture's plane; above it; from the camera's axis."""

_WORDS = {
    "name": "name file filename image picture photo photograph path view img imagename",
    "number": "# no nr num number index idx id n k light lamp led",
    "i": "i intensity intensitie strength brightness power gain", "r": "r red", "g": "g green", "b": "b blue",
    "azimuth": "azimuth azi az", "elevation": "elevation elev el altitude alt", "slant": "slant zenith", "tilt": "tilt",
    "ambiguous": "theta phi θ φ ϕ inclination polar angle pan lon lat longitude latitude",
}  # fmt: skip
_KINDS = {word: kind for kind, words in _WORDS.items() for word in words.split()}
_AXIS = re.compile(r"(?:[lndvps]|dir|direction|light|lightdir|lightdirection|pos|position|vec|vector|source)?([xyz])")
_CAPTION = re.compile(r"\blight(ing|s)?[ _](directions?|vectors?|sources?|positions?)\b:?(?=\s)", re.IGNORECASE)
_FILLERS = {"deg", "degree", "degrees", "degs", "in", "and", "columns", "column", "rad", "radians", "°", "mm", "cm", ""}
_PAIRS = [{around, other} for around in AROUND for other in (*UP, *DOWN)]


@dataclass(frozen=True)
class Heading:
    """A line that says what the columns are.

    Attributes:
        columns: Kinds: as `Table.columns`, `name`, `number`, or `` for what is not used.
        separator: What separates the columns; None for blanks.
        radians: Angles are in radians.
        unused: Words of the columns that are not used.
    """

    columns: tuple[str, ...]
    separator: str | None
    radians: bool
    unused: tuple[str, ...] = ()

    @property
    def numbers(self) -> tuple[str, ...]:
        """Kinds of the numbers, without the names."""
        return tuple(kind for kind in self.columns if kind not in ("", "name", "number"))


def kind_of(word: str) -> str:
    """Return what a word of a heading names; an empty text for a word that is not known."""
    plain = re.sub(r"[(\[{].*?[)\]}]", "", word.lower())
    plain = re.sub(r"(?<=[\W_])(deg(rees?)?|rad(ians?)?|mm|cm)$", "", plain)
    plain = re.sub(r"[^a-z#θφϕ]", "", plain)
    axis = _AXIS.fullmatch(plain)
    if axis:
        return axis.group(1)
    return _KINDS.get(plain) or (_KINDS.get(plain[:-1], "") if plain.endswith("s") else "")


def read_heading(path: Path, line: str, want: Want) -> Heading | None:
    """Read a line as a heading; None where it is none.

    Raises:
        InputError: angles that mean different things to different people.
    """
    line = _CAPTION.sub("", line)
    separator = next((sign for sign in ";\t," if sign in line), None)
    words = [word.strip(" \"'") for word in line.strip("[](){} \t").split(separator)]
    if separator is None:
        words = [word for word in words if word.lower().strip("()[]:,.") not in _FILLERS]
    if len(words) > 40:
        return None
    kinds = [kind_of(word) for word in words]
    if separator is not None and words and not words[0]:
        kinds[0] = "number"  # the index that pandas writes
    if words and words[0].lower() == "i" and want.lights:
        kinds[0] = "number"  # an intensity stands after the direction
    named = {kind for kind in kinds if kind}
    enough = {"x", "y", "z"} <= named or any(pair <= named for pair in _PAIRS)
    if not want.lights:
        enough = "i" in named or {"r", "g", "b"} <= named
    elif kinds.count("ambiguous") > 1 and "" not in kinds and not enough:
        raise InputError(
            f"{path}: its heading {line.strip()[:80]!r} does not say which angle is which; call the columns 'azimuth "
            "elevation' (from x towards y in the picture; above the picture's plane) or 'slant tilt' (from the "
            "camera's axis; as azimuth), in degrees"
        )
    numbers = [kind for kind in kinds if kind not in ("", "name", "number")]
    if not enough or len(set(numbers)) < len(numbers) or (separator is None and "" in kinds):
        return None
    wanted = {"x", "y", "z", *AROUND, *UP, *DOWN} if want.lights else set()
    kept = tuple(kind if kind in {"name", "number", "i", "r", "g", "b", *wanted} else "" for kind in kinds)
    radians = bool(re.search(r"(?<![a-z])rad(ian)?s?(?![a-z])", line.lower()))
    unused = tuple(word for word, kind in zip(words, kept, strict=True) if not kind)
    return Heading(kept, separator, radians, unused)


def upright(path: Path, table: Table, count: int, want: Want, signs: Sequence[int]) -> Table:
    """Turn rows of x, of y and of z with one number for each light into one row for each light.

    Args:
        path: The file, for messages.
        table: What was read.
        count: Number of pictures.
        want: What is wanted.
        signs: Signs that turn the file's axes into ours.

    Raises:
        InputError: as many lights as numbers of a light, and nothing tells rows from columns.
    """
    rows, width = table.values.shape
    if table.names is not None:
        kinds = tuple(kind_of(name) for name in table.names)
        wanted = {"x", "y", "z"} <= set(kinds) or any(pair <= set(kinds) for pair in _PAIRS)
        if not (want.lights and wanted and "" not in kinds and len(set(kinds)) == len(kinds)):
            return table
        return _transpose(replace(table, names=None, columns=kinds))
    if table.columns:
        return _transpose(table) if rows == len(table.columns) != width == count else table
    along = rows == count and width in {*want.widths, *(width + 1 for width in want.widths)}
    across = width == count and rows in want.widths
    if across and (not along or (want.lights and _columns_are_lights(path, table.values, signs))):
        return _transpose(table)
    return table


def _transpose(table: Table) -> Table:
    rows, width = table.values.shape
    note = f"{rows} rows of {width} numbers were taken as {width} lights of {rows} numbers each"
    return replace(table, values=table.values.T, lines=(), notes=(*table.notes, note))


def _columns_are_lights(path: Path, values: np.ndarray, signs: Sequence[int]) -> bool:
    """Tell rows from columns of a square table by their length, and by which are in front of the object."""
    if np.array_equal(values, values.T) or (len(values) > 3 and counts(values[:, 0])):
        return False
    rows, columns = values[:, :3], values.T[:, :3]
    tests = (are_unit, lambda vectors: bool((vectors[:, 2] * signs[2] > 0).all()), are_level)
    for test in tests:
        if test(rows) != test(columns):
            return test(columns)
    if not any(test(rows) for test in tests):
        return False  # neither are lights; what is wrong is said of the rows
    size = len(values)
    raise InputError(
        f"{path}: {size} rows of {size} numbers for {size} pictures, and both rows and columns may be lights; write "
        "the pictures' names before the rows"
    )


def split_columns(
    path: Path, table: Table, values: np.ndarray, want: Want
) -> tuple[np.ndarray, np.ndarray, tuple[str, ...]]:
    """Take directions and intensities apart.

    Args:
        path: The file, for messages.
        table: What the columns are.
        values: Its rows in the order of the pictures, (L, W).
        want: What is wanted.

    Returns:
        Vectors (L, 3), as they are in the file, (L, 0) where none are wanted; intensities (L, 0), (L, 1) or (L, 3);
        notes.

    Raises:
        InputError: another number of columns than wanted, or angles that cannot be.
    """
    columns, notes = table.columns, table.notes
    if not columns:
        if values.shape[1] not in want.widths:
            where = f"line {table.lines[0]}" if table.lines else f"a table of {len(values)} x {values.shape[1]}"
            raise InputError(f"{path}: {where} is not {want.text}; correct it")
        return (values[:, :3], values[:, 3:], notes) if want is LIGHTS else (values[:, :0], values, notes)
    at = {kind: place for place, kind in enumerate(columns)}
    strengths = next(
        (values[:, [at[kind] for kind in kinds]] for kinds in (("r", "g", "b"), ("i",)) if set(kinds) <= set(at)),
        values[:, len(columns) :],
    )
    if not want.lights:
        return values[:, :0], strengths, notes
    if {"x", "y", "z"} <= set(at):
        return values[:, [at["x"], at["y"], at["z"]]], strengths, notes
    around = next(kind for kind in AROUND if kind in at)
    other = next(kind for kind in (*UP, *DOWN) if kind in at)
    vectors = from_angles(path, values[:, at[around]], values[:, at[other]], other in DOWN, table.radians)
    unit = "radians" if table.radians else "degrees"
    return vectors, strengths, (*notes, f"its angles were taken as {around} and {other} in {unit}")


def from_angles(path: Path, around: np.ndarray, other: np.ndarray, slant: bool, radians: bool) -> np.ndarray:
    """Return unit vectors (N, 3) of angles.

    Args:
        path: The file, for messages.
        around: (N,) azimuth or tilt: from x towards y, in the picture's plane.
        other: (N,) elevation above the picture's plane, or slant from the camera's axis.
        slant: It is the slant.
        radians: Angles are in radians.

    Raises:
        InputError: angles beyond a turn, or degrees that must be radians.
    """
    turn, right = (2 * np.pi, np.pi / 2) if radians else (360.0, 90.0)
    highest = 2 * right if slant else right
    slack = 1e-3 * right
    if (np.abs(around) > turn + slack).any() or (np.abs(other) > highest + slack).any():
        raise InputError(
            f"{path}: its angles go beyond {turn:.4g} around or {highest:.4g} {'from the axis' if slant else 'up'}; "
            "write degrees, or 'radians' into the heading, and put the columns in the heading's order"
        )
    if not radians and len(around) > 2 and np.abs(around).max() < 6.3 and np.abs(other).max() < 3.2:
        raise InputError(f"{path}: its angles look like radians; write 'radians' into the heading, or degrees")
    around, other = (np.asarray(angle if radians else np.radians(angle)) for angle in (around, other))
    up = np.pi / 2 - other if slant else other
    return np.stack([np.cos(up) * np.cos(around), np.cos(up) * np.sin(around), np.sin(up)], axis=-1)
