"""What the figures share: the methods, the scenes, the results kept on disk, and the form of what a figure gives."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from pipelines.evaluate.evaluation import Evaluation, Result, TestObject
from pipelines.evaluate.lit import lit_object
from pipelines.rendering.render_data import render_planned
from pipelines.report.sections import Table
from pipelines.shared import scenes
from pipelines.shared.presets import Preset, TestConfig
from pipelines.shared.text_tables import number
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


@dataclass(frozen=True, eq=False)
class Workbench:
    """Methods and scenes of a run.

    Attributes:
        preset: Its `test` section names shapes, materials, lights and how they are rendered.
        out: The run's folder; MERL-Test scenes are shared with `eval-merltest`.
        runners: The methods.
        evaluation: Keeps results.
        draws: Random choices per point, where a figure makes any.
    """

    preset: Preset
    out: Path
    runners: tuple[Runner, ...]
    evaluation: Evaluation
    draws: int = 3

    @property
    def config(self) -> TestConfig:
        """The `test` section."""
        return self.preset.test

    def merltest(self) -> tuple[list[SceneSpec], Path]:
        """Return the MERL-Test scenes and their folder, rendered where they are not yet.

        Raises:
            InputError: the folder holds other scenes, or one cannot be rendered.
        """
        return self.rendered(self.config, self.out / "merltest")

    def rendered(self, config: TestConfig, folder: Path) -> tuple[list[SceneSpec], Path]:
        """Return the scenes of a test configuration and their folder, rendered where they are not yet."""
        wanted = scenes.test_scenes(config)
        render_planned(wanted, folder, replace(self.preset, test=config))
        return wanted, folder

    def objects(self, wanted: Iterable[SceneSpec], folder: Path, config: TestConfig) -> Iterator[TestObject]:
        """Yield each scene under random intensities (the first draw), its images made once however often asked for."""
        for scene in wanted:
            item = lit_object(scene, folder, config)
            yield replace(item, load=cache(item.load))

    def results(self, item: TestObject, runners: Sequence[Runner]) -> list[Result]:
        """Return what methods make of an object, from the cache or by running them."""
        return self.evaluation.results(item, runners, [False] * len(runners))

    def calibrated(self) -> list[Runner]:
        """Return the methods that are told the lights."""
        return [runner for runner in self.runners if runner.method.lights == TRUE_LIGHTS]

    def uncalibrated(self) -> list[Runner]:
        """Return the methods that are told nothing."""
        told = (TRUE_LIGHTS,)
        return [r for r in self.runners if r.method.lights not in told and r.method.intensities not in told]


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


@dataclass(frozen=True)
class Mean:
    """A mean over objects.

    Attributes:
        value: The mean over those that were scored; NaN where none was.
        failed: Objects the method refused.
        count: Objects.
    """

    value: float
    failed: int
    count: int

    def cell(self, published: float | None = None) -> str:
        """Write it with the published figure in brackets, and what failed."""
        text = number(self.value) if np.isfinite(self.value) else "-"
        text += f" ({number(published)})" if published is not None else ""
        return text + (f" [{self.failed} of {self.count} failed]" if self.failed and self.failed < self.count else "")

    def plain(self) -> float | None:
        """Return the value, None where there is none, for JSON."""
        return float(self.value) if np.isfinite(self.value) else None


def mean(results: Sequence[Result], metric: str) -> Mean:
    """Average a metric over the objects that were scored."""
    values = [result.scores[metric] for result in results if metric in result.scores]
    return Mean(float(np.mean(values)) if values else float("nan"), len(results) - len(values), len(results))
