"""`sdps data plan`: write the manifest of a preset, and estimate the disk and time it will take."""

import argparse
import sys
import tempfile
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from pipelines.rendering.render_data import add_run_arguments, planned_scenes
from pipelines.shared import presets
from render.planning import budget
from render.planning.budget import Pace
from render.planning.chunks import cut, view_groups
from render.records import mirror
from render.records.ledger import survey
from render.records.manifest import SceneSpec
from render.running.supervisor import RunOptions, render_supervised
from render.shared.errors import InputError


@dataclass(frozen=True)
class Sample:
    """What rendering a few views told.

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


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the flags of `sdps data plan`."""
    presets.add_common_arguments(parser)
    add_run_arguments(parser)
    parser.add_argument("--no-sample", action="store_true", help="estimate without rendering some views first")


def main(args: argparse.Namespace) -> int:
    """Write the plan, render a sample elsewhere, and tell what the whole will take.

    Raises:
        InputError: another plan in the folder, or not enough disk space for this one.
    """
    preset, out = presets.from_arguments(args)
    options = RunOptions(workers=args.workers, keep_free=round(args.keep_free * 1e9))
    with mirror.open_folder(out / "data", purpose="run") as folder:
        scenes = planned_scenes(preset, folder)
        found = survey(folder, scenes)
        left = [scene for scene in scenes if scene.id not in found.done]
        sys.stdout.write(f"{mirror.display_name(folder)}: {composition(scenes)}\n")
        sample = None if args.no_sample or not left else render_sample(left, options)
        needed = budget.disk_bytes(left, sample.measured if sample else ())
        sys.stdout.write(describe(left, needed, folder, sample))
        if mirror.mirror_of(folder) is None:
            budget.require_space(folder, needed, options.keep_free)
    return 0


def render_sample(scenes: list[SceneSpec], options: RunOptions) -> Sample:
    """Render views spread evenly over the plan into a temporary folder, and measure time and size.

    Raises:
        InputError: nothing of the sample could be rendered.
    """
    from render.backend import variant

    workers = options.workers or budget.default_workers(variant.choose().variant)
    groups = list(view_groups(scenes))
    chosen = np.unique(np.linspace(0, len(groups) - 1, min(len(groups), max(8, 4 * workers))).round().astype(int))
    views = [groups[index] for index in chosen]
    picked = [scene for view in views for scene in view]
    with tempfile.TemporaryDirectory(prefix="sdps-plan-") as folder:
        summary = render_supervised(picked, folder, RunOptions(workers=workers, keep_free=0))
    if not summary.lines:
        raise InputError(f"no scene of the sample could be rendered: {summary.failed[0]['reason']}")
    by_id = {scene.id: scene for scene in picked}
    measured = [(by_id[line["id"]], line["bytes"]) for line in summary.lines]
    ids, sampled = {scene.id for scene in scenes}, set(by_id)
    loads = len(cut(scenes, ids, workers)) / len(scenes) / (len(cut(picked, sampled, workers)) / len(picked))
    pace = budget.sampled_pace(_settled(summary.lines, by_id), loads, workers)
    assert pace is not None  # there are lines
    failures = [line["reason"] for line in summary.failed]
    return Sample(len(views), len(summary.lines), pace, measured, failures)


def _settled(lines: list[dict[str, Any]], by_id: dict[str, SceneSpec]) -> list[dict[str, Any]]:
    """Leave out the first view of every process, which loads libraries and compiles kernels, if others are left."""
    first = {line["worker"]: by_id[line["id"]].seed for line in reversed(lines)}
    return [line for line in lines if by_id[line["id"]].seed != first[line["worker"]]] or lines


def composition(scenes: list[SceneSpec]) -> str:
    """Say in a line what a plan consists of."""
    families = Counter(scene.shape.partition(":")[0] for scene in scenes)
    splits = Counter(scene.split for scene in scenes)
    mixed = sum("+" in scene.material for scene in scenes)
    images = sum(len(scene.lights) for scene in scenes)
    parts = [
        " + ".join(f"{count:,} {family}" for family, count in families.items()),
        ", ".join(f"{count:,} {split}" for split, count in splits.items()),
        f"{len({scene.shape for scene in scenes}):,} shapes, {sum(1 for _ in view_groups(scenes)):,} views",
        f"{mixed:,} spatially varying",
    ]
    return f"{len(scenes):,} scenes, {images:,} images ({'; '.join(parts)})"


def describe(left: list[SceneSpec], needed: int, folder: Path, sample: Sample | None) -> str:
    """Lay out the estimates of what is left to render."""
    basis = f"measured on {sample.scenes} scenes of {sample.views} views" if sample else "not measured: a usual ratio"
    text = f"left: {len(left):,} scenes\n" if left else "left: nothing\n"
    place, free = "store", ""
    if mirror.mirror_of(folder) is None:
        place, free = "disk", f"; {budget.gigabytes(budget.free_bytes(folder))} free"
    text += f"{place}: about {budget.gigabytes(needed)} more ({basis}){free}\n"
    if sample and sample.failures:
        text += f"sample: {len(sample.failures)} scenes failed, the first one thus: {sample.failures[0]}\n"
    if sample:
        pace = sample.pace
        text += (
            f"time: {pace.seconds:.2f} s per scene and process, {pace.workers} at once: {pace.per_hour():,.0f} "
            f"scenes/hour, about {budget.duration(pace.left(len(left)))} on this machine\n"
        )
    return text
