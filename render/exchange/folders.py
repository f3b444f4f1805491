"""Folders of an exported tree: whole or absent, and marked as ours."""

import json
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from render.errors import InputError
from render.files import read_text, write_json

RECORD = "export.json"
MARKER = "scene.json"


@contextmanager
def atomic_folder(path: Path) -> Iterator[Path]:
    """Yield an empty folder beside `path` and rename it to `path` on success; on failure nothing of it is left.

    Raises:
        InputError: the disk is full or the parent cannot be written.
    """
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        for stale in path.parent.glob(f".{path.name}.*.tmp"):  # of a run that was killed
            shutil.rmtree(stale, ignore_errors=True)
        temporary.mkdir()
        yield temporary
        if path.exists():  # of another version of the scene; a whole one is never written again
            shutil.rmtree(path)
        os.replace(temporary, path)
    except OSError as error:
        raise InputError(
            f"{path}: cannot be written ({error.strerror or error}); free space or choose another --out"
        ) from error
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def claim(root: Path, record: dict[str, Any]) -> None:
    """Start a tree, or make sure that the one there comes from the same scenes and options."""
    path = root / RECORD
    if root.exists() and not root.is_dir():
        raise InputError(f"{root}: is a file; choose another --out")
    if not path.exists():
        if root.is_dir() and any(root.iterdir()):
            raise InputError(f"{root}: has files but no {RECORD}, so it is not ours to write to; choose another --out")
        write_json(path, record | {"scenes": {}})
        return
    before = read_record(path)
    for field in ("layout", "bits", "exposure", "intensities", "manifest"):
        if before.get(field) != record[field]:
            raise InputError(
                f"{path}: {field} was {before.get(field)!r}, now it is {record[field]!r}; choose another --out"
            )


def read_record(path: Path) -> dict[str, Any]:
    """Read `export.json` or `scene.json`.

    Raises:
        InputError: not a JSON object.
    """
    try:
        value = json.loads(read_text(path))
    except json.JSONDecodeError as error:
        raise InputError(f"{path}: is not JSON ({error.msg}); delete the folder and export it again") from error
    if not isinstance(value, dict):
        raise InputError(f"{path}: is not a record of an export; delete the folder and export it again")
    return value
