"""What the figures share: their form, and which methods they can show."""

from dataclasses import dataclass, field
from typing import Any

from matplotlib.figure import Figure

from pipelines.evaluate.report.sections import Table
from render.shared.errors import InputError
from sdps.methods import rows
from sdps.methods.method import Method
from sdps.models.registry import TRUE_LIGHTS

METRICS = {  # of the figures: title and unit
    "direction_mae": ("Light directions", "mean angular error (degrees)"),
    "intensity_error": ("Light intensities", "mean relative error"),
    "normal_mae": ("Normals", "mean angular error (degrees)"),
}


class LeftOut(InputError):
    """A figure cannot be made of these methods, shapes or materials; the others can."""


@dataclass(frozen=True, eq=False)
class Drawn:
    """A figure as it is shown and kept.

    Attributes:
        title: Heading.
        text: What was evaluated, and how the numbers are defined.
        charts: (file name without suffix, caption, chart).
        tables: Tables.
        values: The numbers, JSON ready.
    """

    title: str
    text: str
    charts: tuple[tuple[str, str, Figure], ...]
    tables: tuple[Table, ...]
    values: dict[str, Any] = field(default_factory=dict)


def paper_row(method: Method) -> str:
    """Return the row of the paper's table that a method is, `PF14` for that method, or an empty string."""
    if (method.lights, method.normals, method.intensities) == ("", "pf14", ""):
        return "PF14"
    return rows.paper_row(method)


def finds(method: Method, metric: str) -> bool:
    """Tell whether a method can be scored by a metric, that is, estimates the quantity itself."""
    if metric == "normal_mae":
        return bool(method.normals)
    if metric == "intensity_error" and method.intensities:
        return False
    learned = bool(method.lights) and method.lights != TRUE_LIGHTS
    return learned or (not method.lights and not method.models())
