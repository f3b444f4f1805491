"""Lights files that say where near lamps stood: a unit, the object's place, and a position for each picture."""

import re
from pathlib import Path
from typing import Any

import numpy as np

from render.shared.errors import InputError, list_names, unknown
from render.shared.tables import number_lines
from sdps.photos.light_files.light_table import Near, Table

UNITS = ("mm", "cm", "m", "pixels", "objects")
"""Units of positions; `objects` are sizes of the object: the longer side of its outline's box."""
NEAR = "near"
ENDLESS = 1e9
"""Distance, in any unit, at which a distant lamp stands for while a file is read."""

_POSITIONS = ("positionsSphere", "positions3d")
_OTHER_WORDS = {"px": "pixels", "pixel": "pixels", "object": "objects", "millimetres": "mm", "centimetres": "cm",
                "metres": "m"}  # fmt: skip
_FIELDS = ("kind", "unit", "object", "positions", "intensities")
_HEADER = re.compile(
    r"\s*(?:#|%|//)?\s*(?:kind\s*[:=]\s*)?near(?:\s+(?:lights?|lamps?))?\s*(?:$|[,;:]\s*|(?=unit))(.*)",
    re.IGNORECASE,
)
_UNIT = re.compile(r"\bunits?\s*[:=]?\s*([^\W\d_]+)", re.IGNORECASE)
_OBJECT = re.compile(r"\bobject(?:\s+at)?\s*[:=]?\s*[(\[]?\s*([-+.\deE,\s]*)", re.IGNORECASE)


def read_unit(where: str | Path, word: Any) -> str:
    """Return the unit of a word.

    Raises:
        InputError: a unit that is not known; the line begins with `where`.
    """
    text = str(word).strip().lower()
    text = _OTHER_WORDS.get(text, text)
    if text not in UNITS:
        raise InputError(f"{where}: unknown unit {text!r}; it is one of {list_names(UNITS)}")
    return text


def read_near(path: Path, content: dict[str, Any]) -> Near:
    """Read kind, unit and object of a mapping.

    Raises:
        InputError: another kind, no unit or one that is not known, or an object that is not three numbers.
    """
    kind = str(content.get("kind", NEAR))
    if kind != NEAR:
        raise InputError(
            f"{path}: {unknown('kind of lights', kind, (NEAR,))}; leave kind out of a file with directions"
        )
    if "unit" not in content:
        raise InputError(f"{path}: its positions have no unit; write unit: {', '.join(UNITS[:-1])} or {UNITS[-1]}")
    return Near(read_unit(path, content["unit"]), _read_object(path, content.get("object", (0.0, 0.0, 0.0))))


def read_positions(path: Path, content: dict[str, Any]) -> Table:
    """Read {"kind": "near", "unit", "object": [x, y, z], "positions": [[x, y, z], ...] or by name, "intensities"}.

    Raises:
        InputError: a field that is not known, no unit, or something else for the positions and intensities.
    """
    for name in content:
        if name not in _FIELDS:
            raise InputError(f"{path}: {unknown('field', str(name), _FIELDS)}")
    near, positions, strengths = read_near(path, content), content.get("positions"), content.get("intensities")
    if not positions:
        raise InputError(
            f"{path}: no positions in it; write positions: [[x, y, z], ...], or one by each picture's name"
        )
    names = None
    if isinstance(positions, dict):
        names = _read_keys(path, positions)
        if strengths is not None and (not isinstance(strengths, dict) or _read_keys(path, strengths) != names):
            raise InputError(f"{path}: its intensities must have the names of its positions, in the same order")
        positions, strengths = list(positions.values()), strengths and list(strengths.values())
    rows = [_read_numbers(path, value, (3,), "position") for value in positions]
    if strengths is not None:
        if not isinstance(strengths, list) or len(strengths) != len(rows):
            raise InputError(f"{path}: its intensities must be one for each of its {len(rows)} positions")
        rows = [
            [*row, *_read_numbers(path, value, (1, 3), "intensity")] for row, value in zip(rows, strengths, strict=True)
        ]
    if len(set(map(len, rows))) > 1:
        raise InputError(f"{path}: its intensities must all be numbers i, or all be [r, g, b]")
    return Table(np.array(rows, np.float64), names, near=near)


def read_dome(path: Path, dome: dict[str, Any], image_width: float = 0.0) -> Table:
    """Read RelightLab's dome: {"domeDiameter", "imageWidth", "verticalOffset", "lightConfiguration", "directions",
    "positionsSphere", "positions3d", "ledAdjust"}, in millimetres, from the middle of the picture, z to the camera.

    With a diameter and the pictures' width its lamps are near ones; the positions that it holds are used if they are
    about as long as its radius, else its directions. `ledAdjust` is what it multiplies pixels with, so intensities are
    its inverse.

    Args:
        path: The file.
        dome: What is in it.
        image_width: Millimetres that the pictures' width shows, where the dome does not say.

    Raises:
        InputError: no lights in it, or values that are not numbers.
    """
    said = [dome.get(key) or 0.0 for key in ("domeDiameter", "imageWidth", "verticalOffset")]
    diameter, width, offset = (_read_numbers(path, value, (1,), "size")[0] for value in said)
    image_width, radius = width or image_width, diameter / 2
    keys = ("positions3d", "positionsSphere") if dome.get("lightConfiguration") == "lights3d" else ("positionsSphere",)
    lists = {key: _read_rows(path, dome.get(key)) for key in ("directions", "positionsSphere", "positions3d")}
    directions = next((lists[key] for key in ("directions", *_POSITIONS) if len(lists[key])), None)
    if directions is None:
        raise InputError(f"{path}: a dome without directions; find the lights in RelightLab first")
    adjust = dome.get("ledAdjust") or []
    strengths = None
    if len(adjust) == len(directions) and len({str(one) for one in adjust}) > 1:
        factors = np.array([_read_numbers(path, [one[key] for key in "rgb"], (3,), "ledAdjust") for one in adjust])
        strengths = None if (factors <= 0).any() else 1.0 / factors
    if radius <= 0.0 or image_width <= 0.0:
        more = "the width of its pictures (imageWidth)" if radius > 0.0 else "its diameter"
        note = f"{path.name} does not say {more}, so its lamps are taken for distant"
        return Table(directions, strengths=strengths, notes=(note,), image_width=image_width)
    fitting = [lists[key] for key in keys if _are_about(lists[key], radius)]
    lengths = np.linalg.norm(directions, axis=1, keepdims=True)
    rows = fitting[0] if fitting else directions / lengths.clip(1e-9) * radius + [0.0, 0.0, offset]
    note = f"lamps of a dome of {diameter:g} mm, and pictures {image_width:g} mm wide"
    return Table(rows, strengths=strengths, notes=(note,), near=Near("mm"), image_width=image_width)


def _read_rows(path: Path, values: Any) -> np.ndarray:
    """Return a list of {x, y, z} or [x, y, z] as (N, 3); (0, 3) where it is missing or all zeros."""
    rows = np.array([_read_numbers(path, value, (3,), "light") for value in values or []], np.float64).reshape(-1, 3)
    return rows if rows.any() else rows[:0]


def _are_about(rows: np.ndarray, radius: float) -> bool:
    """Tell whether positions are in millimetres; some versions of RelightLab wrote widths of the picture."""
    return len(rows) > 0 and 1 / 3 < float(np.median(np.linalg.norm(rows, axis=1))) / radius < 3


def own_position(image: dict[str, Any]) -> list[float]:
    """Return where a lamp of lights.json stands; very far in its direction, where it has no position."""
    if "position" in image:
        return [float(value) for value in image["position"]]
    return [ENDLESS * float(value) for value in image["direction"]]


def take_header(path: Path, text: str) -> tuple[str, Near | None]:
    """Take a line such as `# near, unit mm, object 0 0 20` out of a text, leaving it blank.

    Only a line before the first row counts, and one that begins with the word.

    Returns:
        The text; and what the line says, None where there is none.

    Raises:
        InputError: such a line without a unit, or with one that is not known.
    """
    lines = number_lines(text)
    for number, line in lines[:40]:
        found = _HEADER.fullmatch(line)
        if found is None:
            if re.match(r"\s*[^#%/\s]", line) and not line.strip().isdecimal():
                return text, None  # a row, or a heading
            continue
        unit, place = _UNIT.search(found[1]), _OBJECT.search(_UNIT.sub("", found[1]))
        if unit is None and place is None and found[1].strip():
            continue  # a sentence
        if unit is None:
            raise InputError(
                f"{path}: line {number} says near lamps without a unit; write '# near, unit mm' ({', '.join(UNITS)})"
            )
        values = None if place is None else place[1].replace(",", " ").split()
        near = Near(read_unit(path, unit[1]), (0.0, 0.0, 0.0) if values is None else _read_object(path, values))
        return "\n".join("" if at == number else row for at, row in lines), near
    return text, None


def _read_object(path: Path, value: Any) -> tuple[float, float, float]:
    x, y, z = _read_numbers(path, list(value) if isinstance(value, tuple) else value, (3,), "object")
    return x, y, z


def _read_numbers(path: Path, value: Any, sizes: tuple[int, ...], what: str) -> list[float]:
    """Return finite numbers of a list, of {x, y, z}, or of one number where one may be.

    Raises:
        InputError: something else.
    """
    if isinstance(value, dict) and set(value) == {"x", "y", "z"}:
        value = [value[key] for key in "xyz"]
    values = value if isinstance(value, list) else [value]
    try:
        numbers = [float(one) for one in values if not isinstance(one, bool)]
    except (TypeError, ValueError, OverflowError):
        numbers = []
    if len(values) not in sizes or len(numbers) != len(values) or not np.isfinite(numbers).all():
        want = {(3,): "three numbers x y z", (1, 3): "a number, or three", (1,): "a number"}[sizes]
        raise InputError(f"{path}: {what} {str(value)[:60]!r} is not {want}, finite; correct it")
    return numbers


def _read_keys(path: Path, by_name: dict[Any, Any]) -> tuple[str, ...]:
    """Return names; YAML reads 010 as the number 8, so that numbers must be in quotes."""
    if not all(isinstance(name, str) for name in by_name):
        raise InputError(f"{path}: names of pictures that are numbers must be in quotes")
    return tuple(by_name)
