"""Published figures that our tables repeat: the paper's on synthetic scenes, everybody's on real benchmarks."""

from dataclasses import dataclass
from functools import cache
from importlib import resources
from typing import Any

from render.shared.config import read_yaml

_FOLDER = resources.files("assets") / "published"
_FILE = read_yaml(str(_FOLDER / "merltest.yaml"))
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


@dataclass(frozen=True)
class PublishedRow:
    """A row of a published table.

    Attributes:
        method: The method.
        source: Where the figures were printed.
        average: The printed average; None where none was.
        figures: By object; empty where only the average is known.
    """

    method: str
    source: str
    average: float | None
    figures: dict[str, float]


@cache
def read_published_rows(benchmark: str, quantity: str) -> tuple[PublishedRow, ...]:
    """Return the rows of a benchmark (`diligent`, ...) for `directions`, `intensities` or `normals`."""
    table = read_yaml(str(_FOLDER / "real_benchmarks.yaml"))[benchmark]
    return tuple(
        PublishedRow(method, source, average, dict(zip(table["objects"], figures, strict=True)) if figures else {})
        for method, source, average, *figures in table.get(quantity, ())
    )
