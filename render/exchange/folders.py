"""Folders of an exported tree: whole or absent, and marked as ours."""

from pathlib import Path
from typing import Any

from render.shared.errors import InputError
from render.shared.files import read_json, write_json
from render.shared.temporary import is_empty

RECORD = "export.json"
MARKER = "scene.json"


def claim(root: Path, record: dict[str, Any]) -> None:
    """Start a tree, or make sure that the one there comes from the same scenes and options."""
    path = root / RECORD
    if root.exists() and not root.is_dir():
        raise InputError(f"{root}: is a file; choose another --out")
    if not path.exists():
        if root.is_dir() and not is_empty(root):
            raise InputError(f"{root}: has files but no {RECORD}, so it is not ours to write to; choose another --out")
        write_json(path, record | {"scenes": {}})
        return
    before = read_record(path)
    for field in ("layout", "bits", "exposure", "intensities", "manifest", "mixed"):
        if before.get(field) != record.get(field):
            raise InputError(
                f"{path}: {field} was {before.get(field)!r}, now it is {record.get(field)!r}; choose another --out"
            )


def read_record(path: Path) -> dict[str, Any]:
    """Read `export.json` or `scene.json`.

    Raises:
        InputError: not a JSON object.
    """
    value = read_json(path, "delete the folder and export it again")
    if not isinstance(value, dict):
        raise InputError(f"{path}: is not a record of an export; delete the folder and export it again")
    return value
