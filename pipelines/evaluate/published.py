"""The paper's figures on synthetic scenes, to stand beside ours (assets/published/merltest.yaml)."""

from importlib import resources
from typing import Any

from render.shared.config import read_yaml

_FILE = read_yaml(str(resources.files("assets") / "published" / "merltest.yaml"))
SHAPES: list[str] = _FILE["shapes"]
LIGHTING: dict[str, list[Any]] = _FILE["lighting"]
NORMALS: dict[str, list[Any]] = _FILE["normals"]
POSTER: dict[str, dict[str, list[list[float]]]] = _FILE["poster"]
"""By metric and row of the paper: for each kind of reflectance the figures under each light set."""


def figures(table: dict[str, list[Any]], row: str, shape: str, count: int = 1) -> tuple[float | None, ...]:
    """Return the paper's `count` figures of a row and shape, None where it has none."""
    if row not in table or shape not in SHAPES:
        return (None,) * count
    found = table[row][1 + SHAPES.index(shape)]
    return tuple(found) if isinstance(found, list) else (found,)
