"""Light files that are text: rows of numbers in all the ways people write them.

A row is a picture's name, if any, and numbers at its end; or the numbers and then the name. Separators, brackets,
decimal commas, comments, a heading and a first line with the number of lights are found out from the file.
"""

import csv
import re
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from render.shared.errors import InputError, list_names
from render.shared.tables import number_lines
from sdps.photos.light_files.light_columns import Heading, read_heading
from sdps.photos.light_files.light_table import Table, Want

_DIGITS = r"[-+]?(?:[0-9]+(?:{point}[0-9]*)?|{point}[0-9]+)(?:[eEdD][-+]?[0-9]+)?|[-+]?(?:nan|inf(?:inity)?)"
_COMMENT = re.compile(r"(?:^|(?<=[\s,;]))(?:#|%|//(?![^\s/]+[/\\]))")
_LOOSE_COMMENT = re.compile(r"#|%|//")
_TYPE = re.compile(r",?\s*dtype=\w+\)*\s*$")
_OPENING, _CLOSING = "([{", ")]}"
_TITLE = {"light", "lights", "direction", "directions", "vector", "vectors", "source", "sources", "lightsource",
          "lightsources", "position", "positions", "data", "matrix", "end"}  # fmt: skip


@dataclass(frozen=True)
class _Style:
    """How numbers are written: with points, or with commas."""

    field: re.Pattern[str]
    number: re.Pattern[str]


_POINTS = _Style(re.compile(r"[^\s;,|]+"), re.compile(_DIGITS.format(point=r"\."), re.IGNORECASE))
_COMMAS = _Style(re.compile(r"(?:[^\s;,|]|,(?![\s;|]|$))+"), re.compile(_DIGITS.format(point="[.,]"), re.IGNORECASE))


@dataclass(frozen=True)
class _Row:
    """A line, or a part of one."""

    line: int
    text: str
    name: str = ""
    values: tuple[float, ...] = ()
    comma: bool = False
    mapped: bool = False


def read_text_table(path: Path, text: str, count: int, want: Want) -> Table:
    """Read rows of numbers.

    Args:
        path: The file, for messages.
        text: What is in it.
        count: Number of pictures.
        want: What a row should be.

    Raises:
        InputError: a line that is not such a row, by its number in the file.
    """
    heading, lines = _content(path, text, want)
    points, commas = (
        _without_count(_without_assignment([row for line in lines for row in _rows(*line, style, heading)]), count)
        for style in (_POINTS, _COMMAS)
    )
    sound = [_sound(found[0], count, want, heading) for found in (points, commas)]
    rows, notes = commas if any(row.comma for row in commas[0]) and sound[1] >= sound[0] else points
    _check(path, rows, count, want, heading)
    mapped = heading is not None and (rows[0].mapped or len(rows[0].values) >= len(heading.numbers))
    if heading is not None and rows[0].mapped and heading.unused:
        notes.append(f"columns that were not used: {list_names(heading.unused)}")
    return Table(
        np.array([row.values for row in rows], np.float64),
        tuple(row.name for row in rows) if rows[0].name else None,
        tuple(row.line for row in rows),
        heading.numbers if heading is not None and mapped else (),
        heading is not None and heading.radians,
        notes=tuple(notes),
    )


def _content(path: Path, text: str, want: Want) -> tuple[Heading | None, list[tuple[int, str]]]:
    """Take comments, blank lines, titles and the heading out."""
    heading: Heading | None = None
    lines: list[tuple[int, str]] = []
    for number, raw in number_lines(text):
        start = _COMMENT.search(raw)
        line, comment = (raw[: start.start()], raw[start.end() :]) if start else (raw, "")
        line = _TYPE.sub("", line.replace("\N{MINUS SIGN}", "-")).strip()
        if (
            line
            and comment
            and not _row(number, line, _COMMAS).values
            and len(_row(number, raw, _POINTS).values) in want.widths
        ):
            line = raw.strip()  # a name with such a sign in it
        if line.startswith("*") and not _row(number, line, _COMMAS).values:
            continue  # a comment of HALCON's
        words = set(re.findall(r"[^\W\d_]+", line.lower()))
        if heading is None and (not lines or (len(lines) == 1 and lines[0][1].isdecimal())):
            if comment and not line:
                heading = read_heading(path, comment.strip(" #%/:"), want)
                if heading is not None and "" in heading.columns:
                    heading = None  # a sentence
            elif line and not _row(number, line, _POINTS).values:
                heading = read_heading(path, line, want)
                if heading is not None or (words and words <= _TITLE) or line[-1] in _OPENING + ":":
                    continue
        if line.strip("()[]{},; ") and not (lines and words == {"end"}):
            lines.append((number, line))
    return heading, lines


def _rows(number: int, line: str, style: _Style, heading: Heading | None) -> Iterator[_Row]:
    """Yield the row of a line; several where semicolons separate rows, as in MATLAB."""
    mapped = None if heading is None else _read_mapping(number, line, heading)
    parts = [part for part in line.split(";") if part.strip("()[]{}, \t")]
    if mapped is not None:
        yield mapped
    elif len(parts) > 1 and all(len(_row(number, part, style).values) > 2 for part in parts):
        yield from (_row(number, part, style) for part in parts)
    else:
        row = _row(number, line, style)
        loose = _LOOSE_COMMENT.search(line)
        if not row.values and loose:
            row = _row(number, line[: loose.start()], style)
        yield row if row.values else _name_last(number, line, style)


def _row(number: int, line: str, style: _Style) -> _Row:
    """Take the numbers at the end of a line apart from the name before them."""
    values: list[float] = []
    begin, comma = len(line), False
    for field in reversed(list(style.field.finditer(line))):
        text = field.group().rstrip(_CLOSING + "'\"°")
        opened = max(text.rfind(sign) for sign in _OPENING + ":=") + 1
        core = text[opened:].strip("'\"")
        closed = text != field.group().rstrip("'\"°")
        if not core and not text[:opened].strip(_OPENING) and field.group().strip("'\""):
            continue  # a bracket by itself
        if not style.number.fullmatch(core) or (opened and closed and values):
            break
        values.append(_float(core))
        comma |= "," in core
        begin = field.start() + opened
        if opened and text[:opened].strip(_OPENING):
            break
    return _Row(number, line, _clean(line[:begin]), tuple(reversed(values)), comma)


def _name_last(number: int, line: str, style: _Style) -> _Row:
    """Take the numbers at the beginning of a line apart from the name after them."""
    values: list[float] = []
    end, comma = 0, False
    for field in style.field.finditer(line):
        core = field.group().strip("()[]{}'\"")
        if not style.number.fullmatch(core):
            break
        values.append(_float(core))
        comma |= "," in core
        end = field.end()
    name = _clean(line[end:])
    return _Row(number, line, name, tuple(values), comma) if values else _Row(number, line, name)


def _clean(name: str) -> str:
    name = name.strip(" \t,;|'\"").rstrip(" \t,;:=|([{'\"").lstrip("{[")
    return "" if name.strip("-*•([{ ") == "" else name.strip(" \t'\"")


def _float(text: str) -> float:
    return float(text.replace(",", ".").lower().replace("d", "e"))


def _read_mapping(number: int, line: str, heading: Heading) -> _Row | None:
    """Read a row as its heading says; None where it has another number of columns."""
    if heading.separator is None:
        cells = line.split()
    else:
        try:
            cells = next(csv.reader([line], delimiter=heading.separator, skipinitialspace=True), [])
        except csv.Error:
            return None
    if len(cells) != len(heading.columns):
        return None
    values, name, comma = [], "", False
    for kind, cell in zip(heading.columns, cells, strict=True):
        cell = cell.strip(" \t'\"°")
        if kind == "name" or (kind == "number" and "name" not in heading.columns):
            name = cell if kind == "name" else re.sub(r"\.0*$", "", cell)
        elif kind not in ("", "number"):
            style = _POINTS if heading.separator == "," else _COMMAS
            if not style.number.fullmatch(cell):
                return None
            values.append(_float(cell))
            comma |= "," in cell
    return _Row(number, line, name, tuple(values), comma, mapped=True)


def _without_assignment(rows: list[_Row]) -> list[_Row]:
    """Take the name of a variable away: `L = [0.1 0.2 0.9`, and rows without a name after it."""
    if len(rows) < 2 or any(row.name for row in rows[1:]) or not set(rows[0].text) & set(_OPENING):
        return rows
    return [replace(rows[0], name=""), *rows[1:]]


def _without_count(rows: list[_Row], count: int) -> tuple[list[_Row], list[str]]:
    """Take a first line with the number of lights away; note where it says another number than there are."""
    if len(rows) < 2 or rows[0].name or len(rows[0].values) != 1 or rows[0].values[0] != round(rows[0].values[0], 0):
        return rows, []
    said, others = rows[0].values[0], rows[1:]
    if min(len(row.values) for row in others) > 1 or all(row.name for row in others):
        fits = said in (len(others), len(others[0].values))
        return others, [] if fits else [f"its first line says {said:g} lights, but {len(others)} rows follow"]
    return (others if said == count == len(others) else rows), []


def _is_allowed(want: Want, heading: Heading | None) -> set[int]:
    """Return how many numbers a row may have, a number of the picture included."""
    known = len(heading.numbers) if heading is not None else 0
    widths = {known, known + 1, known + 3} if known else set(want.widths)
    return widths | {width + 1 for width in widths}


def _fits(layout: tuple[int, bool], rows: int, count: int, want: Want, heading: Heading | None) -> bool:
    """Tell whether so many rows of a layout (numbers, with a name) can be lights, or one row for each axis."""
    width, named = layout
    turned = rows in want.widths and (width == count or (named and width > 1))
    return width in _is_allowed(want, heading) or turned or (named and rows == 2 and width > 1)


def _layout(row: _Row) -> tuple[int, bool]:
    return len(row.values), bool(row.name)


def _usual(rows: list[_Row]) -> tuple[int, bool]:
    """Return the layout of most rows, or of the first."""
    layouts = Counter(map(_layout, rows))
    return max(layouts, key=lambda layout: (layouts[layout], layout == _layout(rows[0])))


def _sound(rows: list[_Row], count: int, want: Want, heading: Heading | None) -> int:
    """Return how many rows are of one layout that can be."""
    usual = _usual(rows) if rows else (0, False)
    alike = sum(_layout(row) == usual for row in rows)
    return alike if _fits(usual, alike, count, want, heading) else 0


def _check(path: Path, rows: list[_Row], count: int, want: Want, heading: Heading | None) -> None:
    """Refuse rows that are not alike, by the number of their line."""
    if not rows:
        raise InputError(f"{path}: no row in it; write one light per line, {want.text}")
    usual = _usual(rows)
    possible = _sound(rows, count, want, heading) > 0
    for row in rows:
        odd = _layout(row) != usual
        bad = not row.values or not np.isfinite(row.values).all()
        if bad or not possible or (odd and len(row.values) not in want.widths):
            angles = want.lights and len(row.values) == 2 and heading is None
            hint = "; of angles in degrees, write 'azimuth elevation' or 'slant tilt' as first line" if angles else ""
            raise InputError(
                f"{path}: line {row.line} is not {want.text}, finite, with or without a name before: "
                f"{row.text.strip()[:80]!r}; correct it{hint}"
            )
        if odd:
            than = "the first" if _layout(rows[0]) == usual else "the others"
            raise InputError(f"{path}: line {row.line} has another layout than {than}; write all lines alike")
