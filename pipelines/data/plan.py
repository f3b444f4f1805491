"""`sdps data plan`: write the manifest of a preset, and estimate the disk and time it will take."""

import argparse
import sys
from collections import Counter
from pathlib import Path

from pipelines.rendering.render_data import add_run_arguments, plan_scenes
from pipelines.shared import presets
from render.planning import budget
from render.planning.chunks import view_groups
from render.records import mirror
from render.records.ledger import survey
from render.records.manifest import SceneSpec
from render.running.sample_run import Sample, render_sample
from render.running.supervisor import RunOptions


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the flags of `sdps data plan`."""
    presets.add_common_arguments(parser)
    add_run_arguments(parser)
    parser.add_argument("--no-sample", action="store_true", help="estimate without rendering some views first")


def main(args: argparse.Namespace) -> int:
    """Write the plan, render a sample elsewhere, and say what the whole will take.

    Raises:
        InputError: another plan in the folder, or not enough disk space for this one.
    """
    preset, out = presets.from_arguments(args)
    options = RunOptions(workers=args.workers, keep_free=round(args.keep_free * 1e9))
    with mirror.open_folder(out / "data", purpose="run") as folder:
        scenes = plan_scenes(preset, folder)
        found = survey(folder, scenes)
        left = [scene for scene in scenes if scene.id not in found.done]
        sys.stdout.write(f"{mirror.display_name(folder)}: {composition(scenes)}\n")
        sample = None if args.no_sample or not left else render_sample(left, options)
        needed = budget.disk_bytes(left, sample.measured if sample else ())
        sys.stdout.write(describe(left, needed, folder, sample))
        if mirror.mirror_of(folder) is None:
            budget.require_space(folder, needed, options.keep_free)
    return 0


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
        text += f"sample: {len(sample.failures)} scenes failed, the first one: {sample.failures[0]}\n"
    if sample:
        pace = sample.pace
        text += (
            f"time: {pace.seconds:.2f} s per scene and process, {pace.workers} at once: {pace.per_hour():,.0f} "
            f"scenes/hour, about {budget.duration(pace.left(len(left)))} on this machine\n"
        )
    return text
