"""Which row of a light file belongs to which picture: by name, by number, or in order."""

import re
import unicodedata
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import replace
from difflib import get_close_matches
from pathlib import Path

import numpy as np

from render.shared.errors import InputError, list_names
from render.shared.tables import natural_key
from sdps.photos.light_files.light_table import LIGHTS, Table, Want, are_level, are_unit, counts

_SUFFIX = re.compile(r"\.[A-Za-z][A-Za-z0-9]{1,4}$")


def base_name(name: str) -> str:
    """Return what follows the last / or \\ of a path, of whichever system."""
    return re.split(r"[/\\]", name.strip())[-1]


def stem(name: str) -> str:
    """Return the last part of a path without the suffix of a picture; `p.0` has none."""
    return _SUFFIX.sub("", base_name(name))


def _last_two(name: str) -> str:
    """Return a name with the folder that it lies in, as far as it says so; pictures of several poses share names."""
    return "/".join(re.split(r"[/\\]", name.strip())[-2:])


def _plain(name: str) -> str:
    """Return a name as systems that take no notice of case compare it; macOS takes letters and accents apart."""
    return unicodedata.normalize("NFC", name).casefold()


_KEYS: tuple[tuple[Callable[[str], str], Callable[[str], str]], ...] = (
    (str, str), (_last_two, _last_two), (base_name, base_name), (base_name, stem), (stem, stem),
    (lambda name: _plain(base_name(name)), lambda name: _plain(base_name(name))),
    (lambda name: _plain(stem(name)), lambda name: _plain(stem(name))),
)  # fmt: skip
"""Keys of rows and of pictures that are compared, the strictest first."""


def numbers_of(names: Sequence[str]) -> list[int] | None:
    """Return the last number in each name's stem; None where one has none or two have the same."""
    found = [re.findall(r"[0-9]{1,18}", stem(name)) for name in names]
    numbers = [int(digits[-1]) for digits in found if digits]
    return numbers if len(numbers) == len(set(numbers)) == len(names) else None


def take_numbers(path: Path, table: Table, files: Sequence[str], want: Want) -> Table:
    """Take a first column that numbers the pictures for their names.

    Raises:
        InputError: the column may as well be x.
    """
    width = table.values.shape[1]
    expected = (len(table.columns),) if table.columns else want.widths
    if table.names is not None or width - 1 not in expected:
        return table
    first = table.values[:, 0]
    pictures = numbers_of(files)
    whole = bool((first == np.round(first)).all() and len(set(first)) == len(first) and (first >= 0).all())
    if not whole or not (counts(first) or (pictures is not None and set(pictures) <= set(first.tolist()))):
        return table
    if width in want.widths and want is LIGHTS and not table.columns and not _rest_is_light(path, table):
        return table
    return replace(
        table, names=tuple(str(int(number)) for number in first), values=table.values[:, 1:],
        notes=(*table.notes, "the first column was taken as the pictures' numbers"),
    )  # fmt: skip


def _rest_is_light(path: Path, table: Table) -> bool:
    """Tell `number x y z` from `x y z i` by the lengths of the vectors."""
    before, after = table.values[:, :3], table.values[:, 1:4]
    for test in (are_unit, are_level):
        if test(before) != test(after):
            return test(after)
    if np.ptp(after / np.linalg.norm(after, axis=1, keepdims=True).clip(1e-9), axis=0).max() < 1e-3:
        return False  # then all lights were the same
    if np.ptp(after[:, 0]) > 5 * np.ptp(before[:, 0]):
        return True  # lamps whose x goes up by 1 are not that far from each other
    raise InputError(
        f"{path}: its rows may be 'number x y z' or 'x y z i'; write the pictures' names before them, or one of these "
        "two as first line"
    )


def join_split_names(table: Table, widths: Sequence[int]) -> Table:
    """Give names that end in a number, such as `pic 1`, their number back."""
    if table.names is None or table.columns or len(set(table.names)) == len(table.names):
        return table
    if table.values.shape[1] - 1 not in widths or not (table.values[:, 0] == np.round(table.values[:, 0])).all():
        return table
    names = tuple(f"{name} {int(value)}" for name, value in zip(table.names, table.values[:, 0], strict=True))
    return replace(table, names=names, values=table.values[:, 1:]) if len(set(names)) == len(names) else table


def in_order(path: Path, table: Table, files: Sequence[str]) -> tuple[np.ndarray, tuple[str, ...]]:
    """Bring rows into the order of the pictures.

    Args:
        path: The file, for messages.
        table: Its rows.
        files: Names of the pictures, (L,).

    Returns:
        The rows (L, W), and notes about the order and about rows that were not used.

    Raises:
        InputError: rows that do not fit the pictures.
    """
    names = table.names
    if names is None:
        if len(table.values) != len(files):
            raise InputError(
                f"{path}: {len(table.values)} rows for {len(files)} pictures ({files[0]} to {files[-1]}); give one "
                "row each, in this order, or write the picture's name before each row"
            )
        return table.values, (f"it names no pictures; its lights were taken in their order, {_span(files)}",)
    twice = [name for name, count in Counter(names).items() if count > 1]
    if twice:
        be = "is" if len(twice) == 1 else "are"
        raise InputError(f"{path}: {list_names(twice)} {be} there twice; keep one row for each picture")
    places, note = _by_number(names, files) if all(map(str.isdecimal, names)) else _by_name(path, names, files)
    missing = [file for file, place in zip(files, places, strict=True) if place is None]
    if missing:
        raise InputError(
            f"{path}: no row for {list_names(missing)} ({len(missing)} of {len(files)} pictures lack one); "
            f"its rows are for {list_names(names, 3)}{_nearest(missing[0], names, places)}; add what is missing or "
            "correct the names"
        )
    used = [place for place in places if place is not None]
    spare = [name for place, name in enumerate(names) if place not in set(used)]
    notes = [note] if note else []
    if spare:
        notes.append(f"rows without a picture were not used: {list_names(spare)}")
    return table.values[used], tuple(notes)


def _nearest(file: str, names: Sequence[str], places: Sequence[int | None]) -> str:
    """Say which unused row has the name most like a picture's."""
    spare = {_plain(stem(name)): name for place, name in enumerate(names) if place not in places}
    found = get_close_matches(_plain(stem(file)), spare, n=1, cutoff=0.5)
    return f", and the nearest to {file} is {spare[found[0]]}" if found else ""


def _by_name(path: Path, names: Sequence[str], files: Sequence[str]) -> tuple[list[int | None], str]:
    """Find rows by name, however it is written; where no name fits, by number or in order."""
    places: list[int | None] = [None] * len(files)
    for of_row, of_file in _KEYS:
        rows: dict[str, list[int]] = {}
        for place, name in enumerate(names):
            rows.setdefault(of_row(name), []).append(place)
        for number, file in enumerate(files):
            found = rows.get(of_file(file), []) if places[number] is None else []
            if len(found) > 1:
                both = list_names([names[place] for place in found])
                raise InputError(f"{path}: {both} all fit {file}; keep one row for each picture")
            places[number] = found[0] if found else places[number]
    used = [place for place in places if place is not None]
    if len(set(used)) < len(used):
        row = Counter(used).most_common(1)[0][0]
        both = list_names([file for file, place in zip(files, places, strict=True) if place == row])
        raise InputError(f"{path}: the row of {names[row]} fits {both}; write the names with their suffixes")
    if used or len(names) != len(files):
        return places, ""
    numbers, pictures = numbers_of(names), numbers_of(files)
    said = f"none of its names ({_span(names)}) is that of a picture, so its rows were taken"
    if numbers is not None and pictures is not None and set(numbers) == set(pictures):
        return [numbers.index(number) for number in pictures], f"{said} by the numbers in the names"
    order = sorted(range(len(names)), key=lambda place: natural_key(names[place]))
    if order == list(range(len(names))) or (numbers is not None and counts(numbers)):
        return list(order), f"{said} in the order of the pictures, {_span(files)}"
    return places, ""


def _by_number(names: Sequence[str], files: Sequence[str]) -> tuple[list[int | None], str]:
    """Find rows whose names are numbers: by the pictures' names, by the numbers in these, or by counting."""
    exact = {name: place for place, name in enumerate(names)}
    found = [exact.get(stem(file)) for file in files]
    if None not in found:
        return list(found), ""
    numbers = {int(name[-18:]): place for place, name in enumerate(names)}
    pictures = numbers_of(files)
    if pictures is not None and set(pictures) <= set(numbers):
        return [numbers[number] for number in pictures], ""
    if len(numbers) == len(files):
        order = [numbers[number] for number in sorted(numbers)]
        return list(order), f"its rows were taken by their numbers, in the order of the pictures, {_span(files)}"
    return list(found), ""


def _span(names: Sequence[str]) -> str:
    """Write a list of names short."""
    return ", ".join(names) if len(names) < 5 else f"{', '.join(names[:3])} to {names[-1]}"
