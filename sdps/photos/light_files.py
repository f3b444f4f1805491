"""Files that say where the lights were: tables of numbers in several habits, and our own lights.json.

Directions here: x right, y up, z to the camera, unit, from the surface to the light.
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from render.shared.errors import InputError, unknown
from render.shared.files import parse_json, read_text, write_json
from sdps.photos.doubts import Doubts

FRAME = "x right, y up, z to the camera"
"""What lights.json states; no other is read."""

FLAGS = {"y-up": (1, 1, 1), "y-down": (1, -1, 1), "x-left": (-1, 1, 1), "z-away": (1, 1, -1)}
"""Axes of a lights file that point another way than ours, and the signs that turn them."""

_HEADINGS = {"x", "y", "z", "lx", "ly", "lz", "i", "r", "g", "b", "intensity", "name", "file", "filename", "image"}
_LENGTH = 0.01


@dataclass(frozen=True, eq=False)
class Lights:
    """What a lights file tells, in the order of the pictures.

    Attributes:
        directions: (L, 3) float32.
        intensities: (L,) or (L, 3) float32; None where the file has none.
        notes: Plain sentences about what was done.
    """

    directions: np.ndarray
    intensities: np.ndarray | None
    notes: tuple[str, ...]


def read_lights(path: str | Path, files: Sequence[str], frame: str = "y-up", doubts: Doubts | None = None) -> Lights:
    """Read one light per picture.

    Args:
        path: Text with rows `x y z`, `x y z i`, `x y z r g b`, each with the picture's name before it or in the
            pictures' order; blanks, tabs, commas or semicolons between. Or lights.json.
        files: Names of the pictures, (L,).
        frame: Axes of the text: y-up, y-down, x-left, z-away, several joined by commas.
        doubts: What becomes of lights that are not above the horizon; None refuses them.

    Raises:
        InputError: another number of rows, text for numbers, a vector that is zero or not above the horizon, an
            intensity that is not positive, an unknown frame.
    """
    path = Path(path)
    signs = parse_frame(frame)
    if path.suffix.lower() == ".json":
        names: list[str] | None
        names, table = _read_json(path)
        if signs != (1, 1, 1):
            raise InputError(f"{path}: lights.json states its own frame; leave the frame flag {frame!r} out")
    else:
        names, table = _read_table(path, (3, 4, 6), "x y z, x y z i or x y z r g b")
    table = _in_order(path, names, table, files)
    vectors = table[:, :3] * signs
    lengths = np.linalg.norm(vectors, axis=1)
    if (lengths < 1e-9).any():
        raise InputError(f"{path}: the light of {files[int(np.argmin(lengths))]} is 0 0 0; give its direction")
    directions = vectors / lengths[:, None]
    _refuse_behind(path, directions, files, doubts or Doubts())
    notes = [f"lights are those of {path.name}, axes {frame}"]
    if np.abs(lengths - 1).max() > _LENGTH:
        notes.append(f"light vectors had lengths from {lengths.min():.3g} to {lengths.max():.3g}; they were normalised")
    return Lights(directions.astype(np.float32), _intensities(path, table[:, 3:], files), tuple(notes))


def read_intensities(path: str | Path, files: Sequence[str]) -> np.ndarray:
    """Read one intensity per picture, (L,) float32 of rows `i` or (L, 3) of rows `r g b`, with or without names.

    Raises:
        InputError: another number of rows, text for numbers, or a value that is not positive.
    """
    path = Path(path)
    names, table = _read_table(path, (1, 3), "i or r g b")
    found = _intensities(path, _in_order(path, names, table, files), files)
    assert found is not None  # it is None for no columns alone
    return found


def write_lights(
    path: str | Path, names: Sequence[str], directions: np.ndarray, intensities: np.ndarray | None = None
) -> None:
    """Write lights.json: {"frame", "images": [{"file", "direction": [x, y, z], "intensity": i or [r, g, b]}]}.

    Args:
        path: Destination, written atomically.
        names: (L,) file names of the pictures.
        directions: (L, 3) unit, from the surface to the light; x right, y up, z to the camera.
        intensities: (L,) or (L, 3), up to one common scale; None for 1.
    """
    values = np.ones(len(names)) if intensities is None else np.asarray(intensities)
    rows = [
        {"file": str(name), "direction": np.round(direction, 6).tolist(), "intensity": np.round(value, 6).tolist()}
        for name, direction, value in zip(names, np.asarray(directions, np.float64), values, strict=True)
    ]
    write_json(path, {"frame": FRAME, "images": rows})


def parse_frame(frame: str) -> tuple[int, int, int]:
    """Return the signs of x, y and z that turn vectors of a frame into ours.

    Raises:
        InputError: an unknown flag, or y-up with y-down.
    """
    flags = [flag.strip().lower() for flag in str(frame).split(",") if flag.strip()]
    for flag in flags:
        if flag not in FLAGS:
            raise unknown("frame", flag, FLAGS)
    if {"y-up", "y-down"} <= set(flags):
        raise InputError(f"frame {frame!r} says both y-up and y-down; keep one")
    x, y, z = np.prod([FLAGS[flag] for flag in {*flags}] or [(1, 1, 1)], axis=0).tolist()
    return x, y, z


def _read_json(path: Path) -> tuple[list[str], np.ndarray]:
    """Read lights.json as names and rows (N, 4) or (N, 6)."""
    try:
        content = parse_json(read_text(path))
        frame = content["frame"]
        names = [str(image["file"]) for image in content["images"]]
        rows = [
            [*image["direction"], *np.atleast_1d(image.get("intensity", 1.0)).tolist()] for image in content["images"]
        ]
        table = np.array(rows, np.float64)
    except (ValueError, TypeError, KeyError, AttributeError) as error:
        raise InputError(
            f'{path}: not a lights.json ({error}); want {{"frame": "{FRAME}", "images": [{{"file": "a.png", '
            '"direction": [0, 0, 1], "intensity": 1}]}'
        ) from error
    if frame != FRAME:
        raise InputError(f"{path}: its frame is {frame!r}; only {FRAME!r} is read, convert the directions")
    if table.ndim != 2 or table.shape[1] not in (4, 6) or not np.isfinite(table).all():
        raise InputError(f"{path}: want direction [x, y, z] and intensity i or [r, g, b], finite, for every image")
    return names, table


def _read_table(path: Path, widths: tuple[int, ...], want: str) -> tuple[list[str] | None, np.ndarray]:
    """Read rows of numbers, each with a name before it or none with; (N, width) float64."""
    rows: list[tuple[int, str, list[float]]] = []
    for number, line in enumerate(read_text(path).splitlines(), start=1):
        fields = _fields(line)
        if fields and not (not rows and {field.lower() for field in fields} <= _HEADINGS):
            rows.append((number, *_split(fields)))
    if len(rows) > 1 and rows[0][2] == [float(len(rows) - 1)] != rows[1][2] and len(rows[1][2]) > 1:
        del rows[0]  # a first line with the number of lights
    for number, name, values in rows:
        if len(values) not in widths or not np.isfinite(values).all():
            raise InputError(f"{path}: line {number} is not {want}, finite, with or without a name before; correct it")
        if len(values) != len(rows[0][2]) or bool(name) != bool(rows[0][1]):
            raise InputError(f"{path}: line {number} has another layout than the first; write all lines alike")
    if not rows:
        raise InputError(f"{path}: no row in it; write one light per line, {want}")
    names = [name for _, name, _ in rows]
    return (names if names[0] else None), np.array([values for *_, values in rows])


def _fields(line: str) -> list[str]:
    """Split a line at blanks, or at commas or semicolons if it has any; what follows a '#' is a comment."""
    line = line.split("#")[0].strip().lstrip("\ufeff")
    for separator in ";,":
        if separator in line:
            return [part.strip().strip('"') for part in line.split(separator)]
    return re.split(r"\s+", line) if line else []


def _split(fields: list[str]) -> tuple[str, list[float]]:
    """Take the numbers at the end of a row apart from the name before them."""
    values: list[float] = []
    while fields and len(values) < 6:
        try:
            values.insert(0, float(fields[-1]))
        except ValueError:
            break
        fields = fields[:-1]
    return " ".join(fields), values


def _in_order(path: Path, names: list[str] | None, table: np.ndarray, files: Sequence[str]) -> np.ndarray:
    """Bring rows into the order of the pictures."""
    if names is None:
        if len(table) != len(files):
            raise InputError(
                f"{path}: {len(table)} rows for {len(files)} pictures ({files[0]} to {files[-1]}); give one row each, "
                "in this order, or write the picture's name before each row"
            )
        return table
    if len(set(names)) < len(names):
        twice = next(name for name in names if names.count(name) > 1)
        raise InputError(f"{path}: {twice} is there twice; keep one row for each picture")
    places = {Path(name).stem: place for place, name in enumerate(names)}
    places |= {name: place for place, name in enumerate(names)}
    found = [places.get(file, places.get(Path(file).name, places.get(Path(file).stem))) for file in files]
    missing = [file for file, place in zip(files, found, strict=True) if place is None]
    if missing:
        raise InputError(f"{path}: no row for {missing[0]} ({len(missing)} pictures lack one); add it")
    return table[[place for place in found if place is not None]]


def _intensities(path: Path, values: np.ndarray, files: Sequence[str]) -> np.ndarray | None:
    """Return (L,) or (L, 3) float32, or None for no column; refuse what is not positive."""
    if not values.shape[1]:
        return None
    if not (values > 0).all():
        name = files[int(np.argmin(values.min(1)))]
        raise InputError(f"{path}: the intensity of {name} is not positive; correct it or leave the picture out")
    return values.squeeze(1).astype(np.float32) if values.shape[1] == 1 else values.astype(np.float32)


def _refuse_behind(path: Path, directions: np.ndarray, files: Sequence[str], doubts: Doubts) -> None:
    """Refuse lights at or below the horizon, and say which flag helps."""
    behind = np.flatnonzero(directions[:, 2] <= 0)
    if not len(behind):
        return
    first = f"{path}: the light of {files[behind[0]]} has z = {directions[behind[0], 2]:.3g}, behind the object"
    if len(behind) == len(directions):
        doubts.stop(f"{first}, as all others; if z points away from the camera there, add z-away to the frame flag")
    else:
        doubts.stop(
            f"{first} ({len(behind)} of {len(directions)}); leave these pictures out, or add z-away to the frame flag "
            "if z points away from the camera"
        )
