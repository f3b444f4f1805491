"""Light files that are JSON: our own lights.json, Meshroom's, RelightLab's, plain lists, and positions; or YAML."""

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from render.shared.config import parse_yaml
from render.shared.errors import InputError
from render.shared.files import parse_json, read_text
from sdps.photos.light_files.light_names import base_name, numbers_of
from sdps.photos.light_files.light_positions import own_position, read_dome, read_near, read_positions
from sdps.photos.light_files.light_table import Table, counts

FRAME = "x right, y up, z to the camera"
"""What lights.json states; no other is read."""

YAML = (".yaml", ".yml")
"""Suffixes of files in YAML."""

_MESHROOM = "x right, y down, z away"
_COLUMNS = {3: ("x", "y", "z"), 4: ("x", "y", "z", "i"), 6: ("x", "y", "z", "r", "g", "b")}
_WANT = (
    f'{{"frame": "{FRAME}", "images": [{{"file": "a.png", "direction": [0, 0, 1], "intensity": 1}}]}}, or lights of '
    "Meshroom or RelightLab"
)


def read_json_table(path: Path, text: str, files: Sequence[str]) -> tuple[Table, bool]:
    """Read lights of any known layout.

    Args:
        path: The file.
        text: What is in it.
        files: Names of the pictures, (L,).

    Returns:
        The rows; and whether the file states our frame, so that no flag may change it.

    Raises:
        InputError: another layout, or values that are not lights.
    """
    try:
        content = parse_yaml(text, str(path)) if path.suffix.lower() in YAML else parse_json(text)
        own = isinstance(content, dict) and "images" in content and ("frame" in content or not _is_relight(content))
        table = _own(path, content) if own else _foreign(path, content, files)
    except (ValueError, TypeError, KeyError, AttributeError, OverflowError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(f"{path}: not a lights.json ({error}); want {_WANT}") from error
    if table.values.ndim != 2 or table.values.shape[1] not in _COLUMNS or not np.isfinite(table.values).all():
        raise InputError(f"{path}: want direction [x, y, z] and intensity i or [r, g, b], finite, for every image")
    return replace(table, columns=_COLUMNS[table.values.shape[1]]), own


def _own(path: Path, content: Any) -> Table:
    frame = content["frame"]
    names = tuple(str(image["file"]) for image in content["images"])
    near = read_near(path, content) if "kind" in content else None
    places = [image["direction"] if near is None else own_position(image) for image in content["images"]]
    strengths = [np.atleast_1d(image.get("intensity", 1.0)).tolist() for image in content["images"]]
    rows = [[*place, *strength] for place, strength in zip(places, strengths, strict=True)]
    if frame != FRAME:
        raise InputError(f"{path}: its frame is {frame!r}; only {FRAME!r} is read, convert the directions")
    return Table(np.array(rows, np.float64), names, near=near)


def _foreign(path: Path, content: Any, files: Sequence[str]) -> Table:
    """Read what other programs write."""
    if isinstance(content, dict) and ("kind" in content or "positions" in content):
        return read_positions(path, content)
    if isinstance(content, dict) and isinstance(content.get("lights"), dict | list):
        return _meshroom(path, content["lights"], files)
    if isinstance(content, dict) and "images" in content:
        return _relight(path, content)
    if isinstance(content, dict) and any(key in content for key in ("directions", "positions3d", "positionsSphere")):
        return read_dome(path, content)
    if isinstance(content, dict) and content:
        return Table(np.array([_vector(value, (3, 4, 6)) for value in content.values()]), tuple(map(str, content)))
    if isinstance(content, list) and content and all(isinstance(row, list) for row in content):
        return Table(np.array([_vector(row, (3, 4, 6)) for row in content]))
    raise ValueError("of no known layout")


def _vector(value: Any, sizes: tuple[int, ...] = (3,)) -> list[float]:
    """Return numbers of a list, of their texts, or of {"x", "y", "z"}.

    Raises:
        ValueError: something else, or another number of them.
    """
    if isinstance(value, dict):
        value = [value[key] for key in ("x", "y", "z")]
    if not isinstance(value, list) or len(value) not in sizes or any(isinstance(one, bool) for one in value):
        raise ValueError(f"{str(value)[:60]} where {' or '.join(map(str, sizes))} numbers are wanted")
    return [float(one) for one in value]


def _meshroom(path: Path, lights: Any, files: Sequence[str]) -> Table:
    """Read {"lights": [{"viewId" or "lightId", "type", "direction": [3 or 9], "intensity": [3]}]}.

    Of spherical harmonics the first three numbers are the direction. The older layout has the names for keys.
    """
    items = list(lights.values() if isinstance(lights, dict) else lights)
    near = [item for item in items if "direction" not in item and "position" in item]
    if near:
        raise InputError(
            f"{path}: {len(near)} of its lights are near ones, with a position; write a file with "
            "kind: near, unit and positions (docs/guides/capture.md)"
        )
    rows = [_vector(item["direction"], (3, 9))[:3] for item in items]
    strengths = [_vector(item.get("intensity", [1.0, 1.0, 1.0])) for item in items]
    measured = strengths != [[1.0, 1.0, 1.0]] * len(items)
    notes = [f"axes are Meshroom's ({_MESHROOM}) and were turned"]
    if any(len(item["direction"]) > 3 for item in items):
        notes.append("of spherical harmonics, the directional part was taken")
    if not measured:
        notes.append("its intensities are all 1, as Meshroom writes where it measured none, and were left out")
    keys = list(lights) if isinstance(lights, dict) else [item.get("viewId", item.get("lightId", "")) for item in items]
    names, doubt = _of_views(path, [str(key) for key in keys], files)
    values = np.array([[*row, *(strength if measured else [])] for row, strength in zip(rows, strengths, strict=True)])
    return Table(values, names, signs=(1, -1, -1), doubt=doubt, notes=tuple(notes))


def _of_views(path: Path, keys: list[str], files: Sequence[str]) -> tuple[tuple[str, ...] | None, str]:
    """Return what pictures the ids of views name, and why their order may be wrong.

    Meshroom numbers its views by a hash and writes them by number, which says nothing about the pictures' order. Its
    cameraInit.sfm names them.
    """
    if "" in keys or len(set(keys)) < len(keys):
        return None, ""
    if not all(map(str.isdecimal, keys)):
        return tuple(keys), ""
    numbers = [int(key[-18:]) for key in keys]
    pictures = numbers_of(files)
    if counts(numbers) or (pictures is not None and set(pictures) <= set(numbers)):
        return tuple(keys), ""
    for scene in sorted(path.parent.glob("*.sfm"))[:20]:
        try:
            content = parse_json(read_text(scene))
            views = {str(view["viewId"]): str(view["path"]) for view in content["views"]}
        except (ValueError, TypeError, KeyError):
            continue
        if set(keys) <= set(views):
            return tuple(views[key] for key in keys), ""
    sequence = all(after - before == 1 for before, after in pairwise(numbers))
    if sequence or numbers != sorted(numbers) or len(numbers) != len(files):
        return None, ""
    return None, (
        f"{path}: its view ids ({keys[0]}, {keys[1]}, ...) are Meshroom's own and say nothing about the pictures' "
        "order; put its cameraInit.sfm, which names them, next to the file"
    )


def _is_relight(content: dict[str, Any]) -> bool:
    images = content["images"]
    return isinstance(images, list) and bool(images) and isinstance(images[0], dict) and "filename" in images[0]


def _relight(path: Path, content: dict[str, Any]) -> Table:
    """Read RelightLab's project: the lamps of its dome where they are near, its images' directions, or its dome's."""
    images, dome = content["images"], content.get("dome")
    kept = [image for image in images if not image.get("skip")]
    names = tuple(base_name(str(image["filename"])) for image in kept)
    scale = content.get("pixelSize") or content.get("scale") or 0.0  # millimetres per pixel
    width = float(scale) * float(content.get("width") or 0.0)
    of_dome = None
    if isinstance(dome, dict) and any(dome.get(key) for key in ("directions", "positions3d", "positionsSphere")):
        of_dome = read_dome(path, dome, width)
    if of_dome is not None and len(of_dome.values) == len(images) > len(kept):
        chosen = [number for number, image in enumerate(images) if not image.get("skip")]
        strengths = None if of_dome.strengths is None else of_dome.strengths[chosen]
        of_dome = replace(of_dome, values=of_dome.values[chosen], strengths=strengths)
    rows = np.array([_vector(image.get("direction", [0.0, 0.0, 0.0])) for image in kept])
    fits = of_dome is not None and len(of_dome.values) == len(kept)
    if of_dome is not None and fits and (of_dome.near is not None or not rows.any()):
        return replace(of_dome, names=names)
    if not rows.any():
        raise InputError(f"{path}: its images have no light directions; find the lights in RelightLab first")
    return Table(rows, names, strengths=of_dome.strengths if of_dome and fits else None, image_width=width)
