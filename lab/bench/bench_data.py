"""The parts of `lab bench` that concern whole runs: steady state, memory, processes, stages and samples a pixel.

`PARTS` lists all.
"""

import os
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from lab.bench.bench_relight import relight
from lab.bench.image_noise import NoiseConfig, measure
from lab.shared.line_charts import tidy
from lab.shared.memory import resident_bytes
from pipelines.shared import presets
from pipelines.shared.charts import new_figure
from render.planning import budget
from render.planning.data_config import DataConfig
from render.planning.plan import material_pool, plan
from render.records.manifest import SceneSpec
from render.running.supervisor import RunOptions, RunSummary, render_supervised
from render.shared.errors import InputError
from render.shared.files import atomic_path
from render.shared.templates import markdown_table

_WARM_UP = 48  # views, after which every kernel a run needs has been met
_VIEWS = 40
_SAMPLES = (16, 32, 64)
_EVERY_MATERIAL = 7  # of the 100, in the measure of noise


def steady_state(_: int, __: Path | None) -> tuple[dict[str, Any], str]:
    """Count the kernels compiled while shapes, views, materials, lights and cameras change.

    Every third view is seen in perspective, half of these under near lights; every third is one of a composition.
    """
    from render import shapes
    from render.backend.jit import dr
    from render.kernel import many_lights, scene
    from render.materials.kernels.packed import pack

    config = presets.load("small").data
    config = replace(config, families={"blobby": 8, "sculpture": 18}, views=2, spatially_varying=0.0, spp=16)
    near = replace(config, near_lights=0.5, camera="perspective")
    composed = replace(config, families={"composition": 26}, composition_materials=(3, 3))
    plans = [plan(each) for each in (config, near, composed)]

    seen: set[str] = set()

    def render(number: int) -> None:
        turn, kind = divmod(number, len(plans))
        pair = plans[kind][2 * turn : 2 * turn + 2]
        seen.add(pair[0].shape)
        distances = np.asarray(pair[0].light_distances) if pair[0].light_distances else None
        built = scene.build(shapes.load(pair[0].shape))
        _, images = many_lights.render(
            built, pair[0].view, pack([one.material for one in pair], built.mesh), pair[0].light_directions(),
            size=config.size, spp=config.spp, bounces=config.bounces, seed=pair[0].seed,
            distances=distances,
        )  # fmt: skip
        for _ in images:
            pass

    for number in range(_WARM_UP):
        render(number)
    seen.clear()
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history_clear()
        for number in range(_WARM_UP, _WARM_UP + _VIEWS):
            render(number)
        history = dr.kernel_history([dr.KernelType.JIT])
    compiled = sum(not kernel["cache_hit"] or bool(kernel["cache_disk"]) for kernel in history)
    values = {"views": _VIEWS, "launches": len(history), "kernels_compiled": compiled}
    return values, (
        f"Steady state: {_VIEWS} views of {len(seen)} shapes with other poses, materials, "
        f"lights and cameras, {len(history):,} kernel launches, {compiled} kernels compiled.\n"
    )


def memory(scenes: int, out: Path | None) -> tuple[dict[str, Any], str]:
    """Render many small scenes in this process and follow its memory."""
    from render.running.scene_rendering import render_scenes

    if resident_bytes() is None:
        raise InputError("bench: the memory part reads /proc, so it needs Linux; choose others by --only")
    config = presets.load("small").data
    shapes = -(-scenes // 16)
    config = replace(config, families={"blobby": shapes, "sculpture": shapes}, views=4, size=64, spp=16,
                     light_count=32, spatially_varying=0.1)  # fmt: skip
    sizes = []
    with tempfile.TemporaryDirectory() as folder:
        planned = plan(config)
        half = len(planned) // 2  # blobs, then as many sculptures: interleaved by shape, or a trend would be theirs
        pairs = zip(range(0, half, 8), range(half, len(planned), 8), strict=False)
        planned = [scene for pair in pairs for first in pair for scene in planned[first : first + 8]][:scenes]

        def record(scene: SceneSpec) -> None:
            sizes.append(resident_bytes())
            (Path(folder) / scene.file).unlink()

        render_scenes(planned, folder, on_shard=record)
    megabytes = np.array(sizes) / 1e6
    quarter = max(1, len(megabytes) // 4)
    growth = 1000 * np.polyfit(np.arange(len(megabytes))[quarter:], megabytes[quarter:], 1)[0]
    values = {"scenes": len(megabytes), "start_mb": float(megabytes[quarter]), "end_mb": float(megabytes[-1]),
              "peak_mb": float(megabytes.max()), "growth_mb_per_1000": float(growth)}  # fmt: skip
    if out:
        figure = new_figure(6.0, 2.6)
        axes = figure.add_subplot()
        axes.plot(np.arange(len(sizes)) + 1, megabytes, lw=0.8)
        axes.set(xlabel="scenes rendered", ylabel="resident memory, MB", ylim=(0, None))
        tidy(axes)
        with atomic_path(out / "memory.png") as temporary:
            figure.savefig(temporary)
    return values, (
        f"Memory over {len(megabytes):,} scenes in one process: {values['start_mb']:.0f} MB after a quarter of them, "
        f"{values['end_mb']:.0f} MB at the end, peak {values['peak_mb']:.0f} MB; trend of the last three quarters "
        f"{growth:+.0f} MB per 1,000 scenes.\n"
    )


def workers(_: int, __: Path | None) -> tuple[dict[str, Any], str]:
    """Render the same part of the `paper` preset on one core and on all; profile its stages."""
    base = presets.load("paper").data
    whole = _count(base)
    planned = _part(base)
    cores = budget.cores()
    ways = {"1 process on 1 core": (1, 1), f"1 process on {cores} cores": (1, cores)}
    ways[f"{cores} processes on {cores} cores"] = (cores, cores)
    runs = {name: _run(planned, *way) for name, way in ways.items()}
    rates = {name: len(summary.lines) / summary.seconds * 3600 for name, summary in runs.items()}
    names, shares = list(rates), list(runs.values())[-1].stage_shares()
    inside = sum(share for stage, share in shares.items() if stage != "other")
    values = {"scenes": len(planned), "scenes_per_hour": rates, "stages": shares,
              "scaling": rates[names[-1]] / rates[names[0]],
              "render_share_of_work": shares.get("render", 0.0) / max(inside, 1e-9),
              "paper_hours": whole / max(rates.values())}  # fmt: skip
    lines = [f"`render-data` on {len(planned)} scenes of the `paper` preset (start of the processes included):", ""]
    lines += [f"- {name}: {rate:,.0f} scenes/hour" for name, rate in rates.items()]
    lines += [
        f"- {names[-1]} against {names[0]}: {values['scaling']:.2f}",
        "- stages: " + ", ".join(f"{stage} {share:.0%}" for stage, share in shares.items()),
        f"- rendering is {values['render_share_of_work']:.0%} of the work (target: at least 70 %)",
        f"- projected for all {whole:,} samples: {values['paper_hours']:.1f} h",
    ]
    return values, "\n".join(lines) + "\n"


def samples(_: int, __: Path | None) -> tuple[dict[str, Any], str]:
    """Time the `paper` preset at several samples a pixel, and measure the noise each leaves."""
    base, cores = presets.load("paper").data, budget.cores()
    hours, noise = {}, {}
    for spp in _SAMPLES:
        planned = _part(replace(base, spp=spp))
        seconds = _run(planned, cores, cores).seconds
        hours[str(spp)] = _count(base) / len(planned) * seconds / 3600
    chosen = tuple(material_pool(("all",))[::_EVERY_MATERIAL])
    rows = list(measure(NoiseConfig(materials=chosen, spp=_SAMPLES)))
    for spp in _SAMPLES:
        errors = np.array([row.error[spp] for row in rows])
        noise[str(spp)] = {"median": float(np.median(errors)), "worst": float(errors.max())}
    values = {"paper_hours": hours, "noise_percent": noise, "materials": list(chosen)}
    table = [(k, f"{hours[k]:.1f}", f"{noise[k]['median']:.2f} %", f"{noise[k]['worst']:.2f} %") for k in hours]
    heads = ("samples a pixel", f"hours for {_count(base):,} samples", "noise, median material", "worst")
    about = (
        f"Projected from {len(planned)} scenes of the `paper` preset, {cores} processes on {cores} cores, start "
        f"included; noise of {len(chosen)} materials on the bunny, against {NoiseConfig().reference:,} samples.\n\n"
    )
    return values, about + markdown_table(heads, table) + "\n"


def _count(base: DataConfig) -> int:
    return sum(base.families.values()) * base.views * base.materials_per_view


def _part(base: DataConfig) -> list[SceneSpec]:
    """Plan as many scenes of each family as the whole has, in proportion."""
    return plan(replace(base, families={"blobby": 1, "sculpture": 2}, views=9, validation=0.0))


def _run(planned: Sequence[SceneSpec], processes: int, cores: int) -> RunSummary:
    """Render a plan into a temporary folder on the first `cores` of this machine's cores."""
    allowed = sorted(os.sched_getaffinity(0))
    os.sched_setaffinity(0, set(allowed[:cores]))
    try:
        with tempfile.TemporaryDirectory() as folder:
            return render_supervised(planned, Path(folder), RunOptions(workers=processes))
    finally:
        os.sched_setaffinity(0, set(allowed))


# What runs one part, given the scenes of the memory test and a folder for pictures: plain values, Markdown about them.
PARTS: dict[str, Callable[[int, Path | None], tuple[dict[str, Any], str]]] = {
    "steady": steady_state,
    "memory": memory,
    "workers": workers,
    "samples": samples,
    "relight": relight,
}
