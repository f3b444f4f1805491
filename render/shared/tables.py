"""Text files of other layouts: lists of names, tables of numbers, and the order their loaders read them in."""

import re
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from render.shared.errors import InputError, list_names
from render.shared.files import read_text

UNIT_TOLERANCE = 0.01
"""Greatest deviation from 1 of the length of a light direction; files with two decimals pass."""


def natural_key(text: str) -> list[tuple[int, int, str]]:
    """Return a sorting key by which `9.png` comes before `10.png`; numbers may have any length."""
    parts = re.split(r"([0-9]+)", text)
    digits = [part.lstrip("0") if part.isascii() and part.isdigit() else None for part in parts]
    return [(1, 0, part) if number is None else (0, len(number), number)
            for part, number in zip(parts, digits, strict=True) if part]  # fmt: skip


def format_rows(rows: np.ndarray, decimals: int = 8) -> list[str]:
    """Format a table, numbers separated by one space, without negative zeros."""
    rounded = np.round(np.asarray(rows, np.float64), decimals) + 0.0
    return [" ".join(f"{value:.{decimals}f}" for value in row) for row in rounded]


def lines_text(lines: Sequence[str]) -> str:
    """Join lines, each ended by a newline."""
    return "".join(f"{line}\n" for line in lines)


def number_lines(text: str) -> list[tuple[int, str]]:
    """Return the lines of a text with their numbers from 1, as an editor counts them, blank ones included.

    `str.splitlines` breaks lines at characters where no editor does.
    """
    return list(enumerate(re.split(r"\r\n|\n|\r", text), start=1))


def read_names(path: str | Path) -> list[str]:
    """Read one name per line, in the file's order.

    Raises:
        InputError: missing or empty file, a '#' (NumPy, which several loaders parse with, takes it for a comment),
            or a name twice.
    """
    names = [line.strip() for _, line in number_lines(read_text(path)) if line.strip()]
    if not names:
        raise InputError(f"{path}: no name in it; write one per line")
    for name in names:
        if "#" in name:
            raise InputError(f"{path}: {name!r} has a '#', which loaders take for a comment; rename it")
    if len(set(names)) < len(names):
        twice = [name for name, count in Counter(names).items() if count > 1]
        be = "is" if len(twice) == 1 else "are"
        raise InputError(f"{path}: {list_names(list(map(repr, twice)))} {be} listed twice; remove one of the lines")
    return names


def read_numbers(path: str | Path, columns: int, rows: int | None = None, what: str = "row") -> np.ndarray:
    """Read a table of finite numbers, (rows, columns) float64.

    Raises:
        InputError: missing file, another number of rows or columns, or NaN or infinity.
    """
    table = []
    for number, fields in ((number, line.split()) for number, line in number_lines(read_text(path))):
        if not fields:
            continue
        if len(fields) != columns:
            hint = "; repeat the value for R, G and B" if (len(fields), columns) == (1, 3) else ""
            raise InputError(f"{path}: line {number} has {len(fields)} column(s) where {columns} are needed{hint}")
        table.append(_floats(fields, f"{path}: line {number}"))
    if rows is not None and len(table) != rows:
        raise InputError(f"{path}: {len(table)} rows for {rows} {what}s; give one row per {what}")
    return np.asarray(table, np.float64).reshape(-1, columns)


def line_of_row(path: str | Path, row: int) -> int:
    """Return the number of the line that row `row`, from 0, of a table stands in, for messages; blank ones count.

    Raises:
        InputError: missing file.
    """
    return [number for number, line in number_lines(read_text(path)) if line.strip()][row]


def read_light_list(path: str | Path) -> tuple[list[str], np.ndarray]:
    """Read the list of a PS-FCN sample, `<image> lx ly lz` per line, in natural order as its loaders do.

    Returns:
        Names of the image files, and directions (L, 3) float64 as printed.

    Raises:
        InputError: what the loaders would choke on or misread: a '#', a field separator that is not one single space,
            rows of different length, fewer than two rows, a name twice, or a direction that is not a unit vector.
    """
    rows = [line.rstrip("\r") for line in read_text(path).split("\n")]
    rows = [row for row in rows if row]
    if len(rows) < 2:
        raise InputError(f"{path}: {len(rows)} light(s); the loaders need at least two lines '<image> lx ly lz'")
    names, directions, widths = [], [], set()
    for row in sorted(rows, key=natural_key):
        fields = row.split(" ")
        widths.add(len(fields))
        if "#" in row:
            raise InputError(f"{path}: {row!r} has a '#', which loaders take for a comment; rename the image")
        if len(fields) < 4 or "" in fields or "\t" in row:
            raise InputError(f"{path}: {row!r} is not '<image> lx ly lz' with single spaces; write it so")
        names.append(fields[0])
        directions.append(_floats(fields[1:4], f"{path}: {fields[0]}"))
    if len(widths) > 1:
        raise InputError(f"{path}: lines have from {min(widths)} to {max(widths)} fields; give all the same number")
    if len(set(names)) < len(names):
        twice = [name for name, count in Counter(names).items() if count > 1]
        raise InputError(f"{path}: an image is listed twice ({list_names(twice)}); give each light an image of its own")
    return names, check_directions(np.asarray(directions), path, names)


def check_directions(directions: np.ndarray, path: str | Path, names: Sequence[str] = ()) -> np.ndarray:
    """Return `directions` (L, 3) if they are unit vectors of the upper hemisphere.

    Args:
        directions: What was read.
        path: The file, for messages.
        names: (L,) names of the images, where the file has them.

    Raises:
        InputError: some of another length, or below the horizon; all are named.
    """
    lengths = np.linalg.norm(directions, axis=1)
    wrong = np.flatnonzero(np.abs(lengths - 1.0) > UNIT_TOLERANCE).tolist()
    if wrong:
        raise InputError(
            f"{path}: light {wrong[0] + 1} has length {lengths[wrong[0]]:.4f}; give unit vectors towards the light"
            f"{_all(names, wrong)}"
        )
    behind = np.flatnonzero(directions[:, 2] < 0).tolist()
    if behind:
        raise InputError(
            f"{path}: light {behind[0] + 1} is behind the object (z = {directions[behind[0], 2]:g}); give vectors "
            f"towards the light, z to the camera{_all(names, behind)}"
        )
    return directions


def _all(names: Sequence[str], places: Sequence[int]) -> str:
    """Name all lights at these places."""
    if names:
        return f" ({list_names([names[place] for place in places])})"
    return f" (lights {list_names([str(place + 1) for place in places])})" if len(places) > 1 else ""


def _floats(fields: Sequence[str], where: str) -> list[float]:
    """Convert fields to finite numbers."""
    try:
        values = [float(field) for field in fields]
    except ValueError as error:
        raise InputError(f"{where}: {' '.join(fields)!r} are not numbers; write them with a decimal point") from error
    if not np.isfinite(values).all():
        raise InputError(f"{where}: {' '.join(fields)!r} are not finite; repair the file")
    return values
