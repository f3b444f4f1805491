"""What the figures share: the sweep of methods over scenes, the form of a figure, and which methods it can show."""

import hashlib
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from pipelines.evaluate.evaluation import Result, TestObject
from pipelines.evaluate.report.sections import Table
from pipelines.evaluate.score_tables import Mean, mean
from pipelines.evaluate.workbench import Workbench
from render.records.manifest import SceneSpec
from render.shared.errors import InputError
from sdps.methods import rows
from sdps.methods.method import Method
from sdps.methods.runner import Runner
from sdps.models.registry import TRUE_LIGHTS

METRICS = {  # of the figures: title and unit
    "direction_mae": ("Light directions", "mean angular error (degrees)"),
    "intensity_error": ("Light intensities", "mean relative error"),
    "normal_mae": ("Normals", "mean angular error (degrees)"),
}


class LeftOut(InputError):
    """A figure cannot be made of these methods, shapes or materials; other figures can."""


@dataclass(frozen=True, eq=False)
class Panel:
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


Variants = Callable[[SceneSpec, TestObject], Iterable[tuple[tuple[Any, ...], TestObject]]]
"""From a scene to the objects that are scored in its place, each with what is varied."""
Sweep = dict[tuple[Any, ...], list[Result]]
"""By (method, *what is varied): a result per scene."""


def sweep(
    bench: Workbench,
    runners: Sequence[Runner],
    scenes: tuple[Sequence[SceneSpec], Path],
    variants: Variants,
    each: int,
    about: str,
) -> Sweep:
    """Score methods on variants of scenes.

    Args:
        bench: Keeps the results, so that a stopped sweep goes on where it was.
        runners: The methods.
        scenes: Scenes and the folder they are rendered into.
        variants: Makes the objects of a scene.
        each: Number of variants of a scene.
        about: What the progress bar says.
    """
    wanted, folder = scenes
    objects = (pair for scene, item in bench.objects(wanted, folder, bench.config) for pair in variants(scene, item))
    found: Sweep = {}
    for key, runner, result in bench.evaluation.run(objects, runners, len(wanted) * each, about):
        found.setdefault((runner.method.name, *key), []).append(result)
    return found


def average(results: Iterable[Result]) -> dict[str, Mean]:
    """Return the mean of each metric over scenes."""
    scores = [one.scores for one in results]
    return {metric: mean(scores, metric) for metric in METRICS}


def vary(item: TestObject, about: str, data: bytes, **changes: Any) -> TestObject:
    """Return an object with other attributes, under a name and a digest of its own, which depend on `data` as well."""
    digest = hashlib.sha256(item.digest.encode() + data).hexdigest()[:24]
    return replace(item, name=f"{item.name}, {about}", digest=digest, **changes)


def list_shapes(scenes: Iterable[SceneSpec]) -> tuple[str, ...]:
    """Return the shapes of scenes, each once."""
    return tuple(dict.fromkeys(scene.shape for scene in scenes))


def paper_row(method: Method) -> str:
    """Return the row of the paper's table that a method is, `PF14` for that method, or an empty string."""
    if (method.lighting, method.normals, method.intensities) == ("", "pf14", ""):
        return "PF14"
    return rows.paper_row(method)


def choose_runners(bench: Workbench, fits: Callable[[Method], bool], figure: str, what: str) -> list[Runner]:
    """Return the methods that fit a figure.

    Raises:
        LeftOut: there are none.
    """
    runners = [runner for runner in bench.runners if fits(runner.method)]
    if not runners:
        raise LeftOut(f"{figure} needs {what} to --methods")
    return runners


def finds(method: Method, metric: str) -> bool:
    """Return whether a method can be scored by a metric, that is, estimates the quantity itself."""
    if metric == "normal_mae":
        return bool(method.normals)
    if metric == "intensity_error" and method.intensities:
        return False
    learned = bool(method.lighting) and method.lighting != TRUE_LIGHTS
    return learned or (not method.lighting and not method.models())
