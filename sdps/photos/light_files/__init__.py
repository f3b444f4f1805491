"""Files that say where the lights were, in the forms people have them, and our own lights.json.

Directions here: x right, y up, z to the camera, unit, from the surface to the light.
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from render.shared.errors import InputError, list_names
from render.shared.files import write_json
from sdps.photos.light_files.light_columns import split_columns, upright
from sdps.photos.light_files.light_frame import frame_matrix
from sdps.photos.light_files.light_json import FRAME
from sdps.photos.light_files.light_names import in_order, join_split_names, take_numbers
from sdps.photos.light_files.light_positions import ENDLESS, NEAR
from sdps.photos.light_files.light_reading import read_table
from sdps.photos.light_files.light_table import INTENSITIES, LIGHTS, Near, Table

SUFFIXES = (".txt", ".lp", ".csv", ".tsv", ".dat", ".npy", ".npz", ".mat", ".json", ".relight", ".dome", ".yaml",
            ".yml", ".tup")  # fmt: skip
"""Of files in a folder of photographs that may be lights; a file that is named may have any."""

_USUAL = ("lights.json", "light_directions.txt")
_LENGTH = 0.01
_MOST_BEHIND = 0.8
_MOST_NAMED = 20


class FaultHandler(Protocol):
    """What is called for a fault that leaves something to compute: `sdps.photos.faults.Faults`."""

    def stop(self, text: str) -> None: ...


@dataclass(frozen=True, eq=False)
class Lights:
    """What a lights file tells, in the order of the pictures.

    Attributes:
        directions: (L, 3) float32.
        intensities: (L,) or (L, 3) float32; None where the file has none.
        notes: Plain sentences about what was done.
        own_frame: The file states its axes, so that no flag may turn them.
        distances: (L,) float64, of the lamps from the object's middle, in `unit`; None of a file of directions.
        unit: mm, cm, m, pixels, or objects: sizes of the object.
        image_width: Millimetres that the pictures' whole width shows; 0 where the file does not say.
    """

    directions: np.ndarray
    intensities: np.ndarray | None
    notes: tuple[str, ...]
    own_frame: bool = False
    distances: np.ndarray | None = None
    unit: str = ""
    image_width: float = 0.0


def read_lights(
    path: str | Path, files: Sequence[str], frame: str = "y-up", faults: FaultHandler | None = None
) -> Lights:
    """Read one light per picture.

    Args:
        path: Text with rows `x y z`, `x y z i`, `x y z r g b`, each with the picture's name or number before it or in
            the pictures' order, or the same transposed; angles in degrees under a heading `azimuth elevation` or
            `slant tilt`; .npy, .npz, .mat; HALCON's slants.tup beside tilts.tup; lights.json, or JSON of Meshroom or
            RelightLab (docs/guides/capture.md).
        files: Names of the pictures, (L,).
        frame: Axes of the file: y-up, y-down, x-left, z-away, xy-swapped, several joined by commas. With Meshroom's
            JSON, how it differs from Meshroom's axes.
        faults: What becomes of lights that are not above the horizon, or may not belong to their pictures; None
            refuses them.

    Raises:
        InputError: another number of rows, text for numbers, a vector that is zero or not above the horizon, an
            intensity that is not positive, an unknown frame.
    """
    path = Path(path)
    turn = frame_matrix(frame)
    table, own = read_table(path, files, LIGHTS)
    if own and (turn != np.eye(3)).any():
        raise InputError(f"{path}: lights.json states its own frame; leave the frame flag {frame!r} out")
    axes = turn * table.signs  # the file's own axes first
    if table.doubt:
        _stop(faults, table.doubt)
    vectors, strengths, said = _order_rows(path, table, files, axes.sum(axis=1).tolist())
    near = table.near
    vectors = (vectors if near is None else vectors - near.object) @ axes.T
    lengths = np.linalg.norm(vectors, axis=1)
    _refuse_zero(path, lengths, files, near)
    directions = vectors / lengths[:, None]
    _refuse_behind(path, directions, files, frame, faults)
    turned = f", turned by {frame}" if (turn != np.eye(3)).any() else ""
    how = f", axes {frame}" if table.signs == (1, 1, 1) else turned
    notes = [f"lights are those of {path.name}{how}", *said, *_describe(lengths, near)]
    found = Lights(
        directions.astype(np.float32), _intensities(path, strengths, files), tuple(notes), own,
        image_width=table.image_width,
    )  # fmt: skip
    if near is None:
        return found
    return replace(found, distances=np.where(lengths < ENDLESS / 2, lengths, np.inf), unit=near.unit)


def read_intensities(path: str | Path, files: Sequence[str]) -> np.ndarray:
    """Read one intensity per picture, (L,) float32 of rows `i` or (L, 3) of rows `r g b`, with or without names.

    Raises:
        InputError: another number of rows, text for numbers, or a value that is not positive.
    """
    path = Path(path)
    table, _ = read_table(path, files, INTENSITIES)
    table = take_numbers(path, upright(path, table, len(files), INTENSITIES, (1, 1, 1)), files, INTENSITIES)
    table = join_split_names(table, INTENSITIES.widths)
    values, _ = in_order(path, table, files)
    _, strengths, _ = split_columns(path, table, values, INTENSITIES)
    found = _intensities(path, strengths, files)
    assert found is not None  # it is None for no columns alone
    return found


def find_lights(folder: Path) -> Path | None:
    """Return the file of a folder that holds its lights: lights.json, light_directions.txt, or the one that is named
    like lights or is an .lp; None where there is none.

    Raises:
        InputError: several.
    """
    usual = [folder / name for name in _USUAL if (folder / name).is_file()]
    if usual or not folder.is_dir():
        return usual[0] if usual else None
    found = [path for path in sorted(folder.iterdir()) if _may_be_lights(path)]
    if len(found) > 1:
        raise InputError(f"{folder}: several files of lights ({list_names([path.name for path in found])}); name one")
    return found[0] if found else None


def _may_be_lights(path: Path) -> bool:
    name = path.name.lower()
    if path.suffix.lower() not in SUFFIXES or not path.is_file() or name.startswith("."):
        return False
    slants = name.endswith(".tup") and "slant" in name  # its tilts are read with it
    return slants or name.endswith((".lp", ".relight", ".dome")) or bool(re.match(r"light(?!s?_?intens)", name))


def write_lights(
    path: str | Path,
    names: Sequence[str],
    directions: np.ndarray,
    intensities: np.ndarray | None = None,
    nearness: np.ndarray | None = None,
) -> None:
    """Write lights.json: {"frame", "images": [{"file", "direction": [x, y, z], "intensity": i or [r, g, b]}]}.

    With near lamps it is of the kind `near`, in the unit `objects`, and each of these has a "position" as well, from
    the object's middle.

    Args:
        path: Destination, written atomically.
        names: (L,) file names of the pictures.
        directions: (L, 3) unit, from the surface to the light; x right, y up, z to the camera.
        intensities: (L,) or (L, 3), up to one common scale; None for 1.
        nearness: (L,) the object's radius over the distance of each lamp, 0 of distant ones; None: not known.
    """
    directions = np.asarray(directions, np.float64)
    values = np.ones(len(names)) if intensities is None else np.asarray(intensities)
    rows: list[dict[str, Any]] = [
        {"file": str(name), "direction": np.round(direction, 6).tolist(), "intensity": np.round(value, 6).tolist()}
        for name, direction, value in zip(names, directions, values, strict=True)
    ]
    content: dict[str, Any] = {"frame": FRAME}
    if nearness is not None and np.any(nearness):
        content |= {"kind": NEAR, "unit": "objects"}
        for row, direction, near in zip(rows, directions, np.asarray(nearness, np.float64), strict=True):
            if near > 0.0:
                row["position"] = np.round(direction / (2.0 * near), 6).tolist()
    write_json(path, content | {"images": rows})


def _order_rows(
    path: Path, table: Table, files: Sequence[str], signs: Sequence[int]
) -> tuple[np.ndarray, np.ndarray, tuple[str, ...]]:
    """Return vectors (L, 3) as the file has them, intensities (L, 0), (L, 1) or (L, 3) and notes, a row per picture."""
    table = take_numbers(path, upright(path, table, len(files), LIGHTS, signs), files, LIGHTS)
    table = join_split_names(table, LIGHTS.widths)
    if table.strengths is not None and table.values.shape[1] == 3:
        table = replace(table, values=np.hstack([table.values, table.strengths]))
    values, said = in_order(path, table, files)
    if table.near is not None and table.columns and "x" not in table.columns:
        raise InputError(f"{path}: near lamps need positions x y z; angles do not say how far they are")
    vectors, strengths, notes = split_columns(path, table, values, LIGHTS)
    return vectors, strengths, (*notes, *said)


def _refuse_zero(path: Path, lengths: np.ndarray, files: Sequence[str], near: Near | None) -> None:
    """Refuse vectors of length 0."""
    zero = [file for file, length in zip(files, lengths, strict=True) if length < 1e-9]
    if zero and near is not None:
        raise InputError(f"{path}: the lamp of {list_names(zero)} stands in the object's middle; correct its position")
    if zero:
        subject = "the light of" if len(zero) == 1 else "the lights of"
        raise InputError(
            f"{path}: {subject} {list_names(zero)} {'is' if len(zero) == 1 else 'are'} 0 0 0; give the direction, or "
            "leave the picture out"
        )


def _describe(lengths: np.ndarray, near: Near | None) -> list[str]:
    """Say how long vectors (L,) are, where that matters."""
    if near is None:
        if np.abs(lengths - 1).max() <= _LENGTH:
            return []
        return [f"light vectors had lengths from {lengths.min():.4g} to {lengths.max():.4g}; they were normalised"]
    finite = lengths[lengths < ENDLESS / 2]
    if not len(finite):
        return ["its lamps are distant"]
    low, high = f"{finite.min():.4g}", f"{finite.max():.4g}"
    unit = "object sizes" if near.unit == "objects" else near.unit
    return [f"its lamps stand {low if low == high else f'{low} to {high}'} {unit} from the object's middle"]


def _intensities(path: Path, values: np.ndarray, files: Sequence[str]) -> np.ndarray | None:
    """Return (L,) or (L, 3) float32, or None for no column; refuse what is not positive."""
    if not values.shape[1]:
        return None
    dark = [file for file, row in zip(files, values, strict=True) if not (row > 0).all()]
    if dark:
        subject = "the intensity of" if len(dark) == 1 else "the intensities of"
        raise InputError(
            f"{path}: {subject} {list_names(dark)} {'is' if len(dark) == 1 else 'are'} not positive; correct "
            f"{'it' if len(dark) == 1 else 'them'} or leave the {'picture' if len(dark) == 1 else 'pictures'} out"
        )
    return values.squeeze(1).astype(np.float32) if values.shape[1] == 1 else values.astype(np.float32)


def _stop(faults: FaultHandler | None, text: str) -> None:
    if faults is None:
        raise InputError(text)
    faults.stop(text)


def _refuse_behind(
    path: Path, directions: np.ndarray, files: Sequence[str], frame: str, faults: FaultHandler | None
) -> None:
    """Refuse lights at or below the horizon, name them, and say the likeliest reason."""
    behind = np.flatnonzero(directions[:, 2] <= 0).tolist()
    if not behind:
        return
    if len(behind) == 1:
        said = f"the light of {files[behind[0]]} has z = {directions[behind[0], 2]:.3g}, behind the object (1 of "
        said += f"{len(directions)})"
    else:
        names = list_names([files[number] for number in behind], _MOST_NAMED)
        said = f"{len(behind)} of {len(directions)} lights have z <= 0, behind the object ({names})"
    flags = [flag.strip() for flag in frame.split(",") if flag.strip().lower() not in ("", "y-up")]
    turned = [flag for flag in flags if flag.lower() != "z-away"]
    turned = turned if len(turned) < len(flags) else [*turned, "z-away"]
    if len(behind) >= _MOST_BEHIND * len(directions):
        advice = f"so z points the other way in this file: use --frame {','.join(turned) or 'y-up'}"
    elif len(directions) > 3 and (directions[:, 1] > 0).all():
        advice = "y is positive in all of them: if y points to the camera in this file, exchange y and z"
    else:
        pictures = "this picture" if len(behind) == 1 else "these pictures"
        flags_out = f"--images '!{files[behind[0]]}'" + (" and so on" if len(behind) > 1 else "")
        advice = f"correct the file, or leave {pictures} out ({flags_out})"
    _stop(faults, f"{path}: {said}; {advice}")
