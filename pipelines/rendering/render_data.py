"""`sdps render-data`: plan the training scenes of a preset and render them into shards."""

import argparse
import sys
from collections import Counter
from pathlib import Path

from pipelines.shared import pictures, presets
from pipelines.shared.cluster import cluster_config
from pipelines.shared.cluster.dask_pool import open_pool
from render.planning import budget
from render.records import manifest, mirror
from render.records.manifest import FAILED, MANIFEST, SceneSpec, read_manifest
from render.running.supervisor import RunOptions, RunSummary, render_supervised
from render.shared.config import to_plain
from render.shared.errors import InputError
from render.shared.files import atomic_path

STAGES = {
    "shape": "shape generation",
    "build": "BVH build",
    "render": "rendering",
    "write": "writing",
    "other": "other",
}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the flags of `sdps render-data`."""
    presets.add_common_arguments(parser)
    add_run_arguments(parser)
    parser.add_argument("--timeout", type=float, default=600.0, metavar="SECONDS",
                        help="give a view up that takes longer; 0 waits for ever (default: 600)")  # fmt: skip
    parser.add_argument("--shard", default="1/1", metavar="I/N", help="render only every N-th shape, from the I-th on")
    parser.add_argument("--retry-failed", action="store_true", help="try scenes again that failed before")
    cluster_config.add_arguments(parser)
    parser.add_argument("--verify", action="store_true", help="check finished shards by their hash, not their ledger")


def add_run_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the flags that tell what a run may use."""
    parser.add_argument("--workers", type=int, default=0, metavar="N",
                        help="processes (default: what cores and memory allow; 1 on a GPU)")  # fmt: skip
    parser.add_argument("--keep-free", type=float, default=budget.KEEP_FREE / 1e9, metavar="GB",
                        help=f"disk space to leave free (default: {budget.KEEP_FREE / 1e9:.1f})")  # fmt: skip


def run_options(args: argparse.Namespace) -> RunOptions:
    """Return the options the flags describe.

    Raises:
        InputError: a flag out of range, or a shard that is not I/N.
    """
    part, slash, parts = args.shard.partition("/")
    if not (slash and part.isdecimal() and parts.isdecimal()):
        raise InputError(f"--shard {args.shard}: expected I/N, for instance 1/4")
    return RunOptions(
        workers=args.workers, timeout=args.timeout, part=int(part), parts=int(parts), retry_failed=args.retry_failed,
        verify=args.verify, keep_free=round(args.keep_free * 1e9),
    )  # fmt: skip


def main(args: argparse.Namespace) -> int:
    """Plan, render what is missing, and say how it went: 0 when every scene is finished, 1 when some failed."""
    preset, out = presets.from_arguments(args)
    options, cluster = run_options(args), cluster_config.from_arguments(args)
    with (
        mirror.open_folder(out / "data", purpose="run") as folder,
        open_pool(cluster, folder, timeout=options.timeout) as pool,
    ):
        scenes = plan_scenes(preset, folder)
        mirror.publish(folder)  # other machines, and `sdps data status`, see the plan
        summary = render_supervised(scenes, folder, options, pool=pool)
        if summary.lines:
            write_preview(scenes, folder)
    sys.stdout.write(report(summary, mirror.display_name(folder), len(scenes[0].lights)))
    return 1 if summary.failed or summary.skipped else 0


def plan_scenes(preset: presets.Preset, folder: Path) -> list[SceneSpec]:
    """Return the plan of a data folder, written there with the configuration if it has none yet.

    Raises:
        InputError: the folder holds another plan, or stands inside of a data folder.
    """
    saved = folder / "config.yaml"
    if (folder.parent / MANIFEST).is_file() and not folder.exists():
        raise InputError(f"{folder.parent}: is a data folder itself; --out names the folder above it")
    if (folder / MANIFEST).exists() and saved.is_file():
        _require_same_data(preset, saved)
        return read_manifest(folder)
    from render.planning.plan import plan

    scenes = plan(preset.data, budget.cores())
    claim(scenes, folder, preset)
    return scenes


def _require_same_data(preset: presets.Preset, saved: Path) -> None:
    """Refuse a folder whose configuration plans other scenes, naming the first field that differs."""
    there, here = to_plain(presets.load(str(saved)).data), to_plain(preset.data)
    field = next((name for name in here if there[name] != here[name]), None)
    if field:
        raise InputError(
            f"{saved.parent}: holds another plan (data.{field} is {there[field]} there, {here[field]} asked for); "
            "remove the folder or choose another --out"
        )


def claim(scenes: list[SceneSpec], folder: Path, preset: presets.Preset | None) -> None:
    """Write manifest and configuration, or check that the folder's manifest is the same.

    Raises:
        InputError: the folder holds another plan.
    """
    manifest.claim(folder, scenes)
    if preset is not None:
        presets.save_resolved(preset, folder)


def render_planned(
    scenes: list[SceneSpec],
    folder: Path,
    preset: presets.Preset | None = None,
    cluster: cluster_config.ClusterChoice | None = None,
) -> int:
    """Claim the folder, render what is missing in this process or on a cluster, and write a contact sheet.

    Returns:
        Number of shards rendered now.

    Raises:
        InputError: the folder holds another plan, or a scene cannot be rendered.
    """
    claim(scenes, folder, preset)
    if cluster is None:
        from render.running.scene_rendering import render_scenes

        rendered = render_scenes(scenes, folder)
    else:
        with open_pool(cluster, folder) as pool:
            summary = render_supervised(scenes, folder, RunOptions(retry_failed=True), pool=pool)
        rendered = len(summary.lines)
        if summary.failed:
            first = summary.failed[0]
            raise InputError(
                f"{folder}: {len(summary.failed)} scenes failed, the first was {first['id']}: {first['reason']}"
            )
    if rendered:
        write_preview(scenes, folder)
    return rendered


def write_preview(scenes: list[SceneSpec], folder: Path) -> None:
    """Write a contact sheet of finished scenes to `preview.png`.

    Raises:
        InputError: none is there any more.
    """
    finished = mirror.select_rendered(folder, scenes)
    if not finished:
        raise InputError(
            f"{folder}: the shards that were rendered are gone; was the folder moved? run the command again"
        )
    with atomic_path(folder / "preview.png") as temporary:
        pictures.scene_sheet(finished, folder).save(temporary)


def report(summary: RunSummary, folder: Path | str, lights: int) -> str:
    """Lay out what a run did, where its time went and what failed, a line each."""
    text = f"{folder}: {summary.done:,} of {summary.scenes:,} scenes finished, {summary.done * lights:,} images\n"
    if summary.lines:
        count, hours = len(summary.lines), summary.seconds / 3600
        text += (
            f"this run: {count:,} scenes, {count * lights:,} images, {len(summary.failed)} failures in "
            f"{budget.duration(summary.seconds)} with {_processes(summary.workers)}, "
            f"{count / hours:,.0f} scenes/hour; see preview.png\n"
        )
        shares = summary.stage_shares()
        parts = ", ".join(f"{about} {shares.get(name, 0):.0%}" for name, about in STAGES.items())
        text += f"time: {parts}\n"
    if summary.failed or summary.skipped:
        reason, most = (
            Counter(line["reason"] for line in summary.failed).most_common(1)[0] if summary.failed else ("", 0)
        )
        now = f"{len(summary.failed)} scenes failed now ({most} x {reason})" if summary.failed else ""
        before = f"{summary.skipped} failed earlier and were not tried" if summary.skipped else ""
        text += f"{'; '.join(filter(None, (now, before)))}; see {folder}/{FAILED}; try them again with --retry-failed\n"
    return text


def _processes(count: int) -> str:
    return "1 process" if count == 1 else f"{count} processes"
