"""Rendering a few views of a plan, to measure the time and the disk that the whole will take."""

import tempfile
from dataclasses import dataclass
from typing import Any

from render.planning import budget
from render.planning.budget import Pace
from render.planning.chunks import cut, view_groups
from render.records.manifest import SceneSpec
from render.running.supervisor import RunOptions, render_supervised
from render.shared.errors import InputError
from render.shared.seeds import spread_evenly


@dataclass(frozen=True)
class Sample:
    """What rendering a few views showed.

    Attributes:
        views: Views rendered.
        scenes: Scenes rendered.
        pace: Of a whole run in steady state.
        measured: Scenes and the bytes of their shards.
        failures: Reasons why scenes of the sample could not be rendered.
    """

    views: int
    scenes: int
    pace: Pace
    measured: list[tuple[SceneSpec, int]]
    failures: list[str]


def render_sample(scenes: list[SceneSpec], options: RunOptions) -> Sample:
    """Render views spread evenly over the plan into a temporary folder, and measure time and size.

    Raises:
        InputError: nothing of the sample could be rendered.
    """
    from render.backend import variant

    workers = options.workers or budget.default_workers(variant.choose().variant)
    groups = list(view_groups(scenes))
    views = spread_evenly(groups, max(8, 4 * workers))
    picked = [scene for view in views for scene in view]
    with tempfile.TemporaryDirectory(prefix="sdps-plan-") as folder:
        summary = render_supervised(picked, folder, RunOptions(workers=workers, keep_free=0))
    if not summary.lines:
        raise InputError(f"no scene of the sample could be rendered: {summary.failed[0]['reason']}")
    by_id = {scene.id: scene for scene in picked}
    measured = [(by_id[line["id"]], line["bytes"]) for line in summary.lines]
    ids, sampled = {scene.id for scene in scenes}, set(by_id)
    loads = len(cut(scenes, ids, workers)) / len(scenes) / (len(cut(picked, sampled, workers)) / len(picked))
    pace = budget.estimate_pace(_drop_first_views(summary.lines, by_id), loads, workers)
    assert pace is not None  # there are lines
    failures = [line["reason"] for line in summary.failed]
    return Sample(len(views), len(summary.lines), pace, measured, failures)


def _drop_first_views(lines: list[dict[str, Any]], by_id: dict[str, SceneSpec]) -> list[dict[str, Any]]:
    """Leave out the first view of every process, which loads libraries and compiles kernels, if others are left."""
    first = {line["worker"]: by_id[line["id"]].seed for line in reversed(lines)}
    return [line for line in lines if by_id[line["id"]].seed != first[line["worker"]]] or lines
