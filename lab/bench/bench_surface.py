"""`lab bench-surface`: accuracy of depth, albedo and relit pictures on rendered scenes, and what each step takes.

Accuracy needs scenes whose depth is known, such as those of `make eval-classical`; steps are timed on the object of
`bench-classical`. Each timing is a process of its own, so that its memory is its own.
"""

import argparse
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from lab.bench.bench_scenes import BenchClassicalConfig, add_size, large_object, size_from
from lab.shared.memory import apart, measure_seconds, peak_gib
from pipelines.shared.flags import add_out, pick_names
from pipelines.shared.text_tables import render_text
from render.records.manifest import SceneSpec, read_manifest
from render.records.shards import Shard, read_shard
from render.shared.files import write_json
from render.shared.progress import progress_bar
from sdps.classical import registry
from sdps.core.integration import Depth, integrate
from sdps.core.metrics import normal_mae
from sdps.surface.meshing import mesh, write_mesh
from sdps.surface.relight import fit_albedo, relit, residuals, trace_light
from sdps.surface.views import strip

GRAZING, DARK = 0.1, 0.5
"""A pixel is in cast shadow where n . l is over the first, and its radiance under the second times Lambert's."""
STEPS = ("integrate", "discontinuities", "mesh", ".ply", ".glb", ".obj", "views", "cast shadows", "albedo", "residuals")
LOW_LIGHT = np.array((0.9, 0.2, 0.3))


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the flags of `python -m lab bench-surface`."""
    parser.add_argument("folders", nargs="*", type=Path, help="data folders of rendered scenes (default: timings only)")
    add_size(parser)
    parser.add_argument("--steps", action="append", help=f"commas or repeat; of {', '.join(STEPS)} (default: all)")
    add_out(parser, Path("out/bench-surface"))


def main(args: argparse.Namespace) -> int:
    """Score every scene, time every step, print the tables and write bench_surface.json."""
    config, steps = size_from(args), pick_names("step", args.steps, STEPS)
    scenes = [(folder, spec) for folder in args.folders for spec in read_manifest(folder)]
    shapes: dict[str, list[dict[str, Any]]] = {}
    rows = []
    for folder, spec in progress_bar(scenes, desc="score", unit="scene"):
        shard = read_shard(folder / spec.file, spec)
        if spec.shape not in shapes:  # the geometry of the others is the same
            shapes[spec.shape] = [_depth_row(spec.shape, "true normals", shard, shard.normals)]
        rows.append(judge(spec, shard))
    found = {step: apart(_work, step, config) for step in progress_bar(steps, desc="time", unit="step")}
    depths = [row for part in shapes.values() for row in part] + [row.pop("depth") for row in rows]
    scored = {"depths": depths, "pictures": rows}
    write_json(args.out / "bench_surface.json", scored | {"config": vars(config), "steps": found})
    text = (_depth_table(depths) + _picture_table(rows) if scenes else "") + _step_table(found, config)
    sys.stdout.write(f"{text}{args.out / 'bench_surface.json'}\n")
    return 0


def judge(spec: SceneSpec, shard: Shard) -> dict[str, Any]:
    """Score depth from least-squares normals; albedo, residuals and cast shadows from the true normals of a scene."""
    images, gains = shard.images.astype(np.float32), np.ones(len(shard.images), np.float32)
    lights, mask = shard.light_directions, shard.mask
    estimate = registry.run("least-squares", images, mask, lights, gains)
    albedo = fit_albedo(images, mask, shard.normals, lights, gains)
    explained = residuals(images, mask, shard.normals, lights, gains, albedo).overall
    return {
        "scene": spec.id,
        "depth": _depth_row(spec.id, "least squares", shard, estimate.normals),
        "albedo": np.median(albedo[mask], axis=0).round(4).tolist(),
        "residual": explained,
        "shadows": _shadows(shard, albedo) if spec.material.startswith("lambertian") else {},
    }


def _depth_row(name: str, source: str, shard: Shard, normals: np.ndarray) -> dict[str, Any]:
    """Integrate normals in both ways; errors in pixels after the mean over each component."""
    truth = _true_depth(shard)
    row = {"scene": name, "normals": source, "range": float(np.ptp(truth[shard.mask])),
           "mae": normal_mae(normals, shard.normals, shard.mask)}  # fmt: skip
    for way, option in (("plain", False), ("discontinuities", True)):
        depth = integrate(normals, shard.mask, discontinuities=option)
        off = np.abs(_centre(depth.z - truth, depth))[shard.mask]
        row[way] = {"mean": float(off.mean()), "largest": float(off.max()), "residual": depth.residual}
    return row


def _true_depth(shard: Shard) -> np.ndarray:  # (H, W) in pixels
    return shard.depth * (max(shard.mask.shape) / 2.0)


def _centre(values: np.ndarray, depth: Depth) -> np.ndarray:
    """Take from each component what no normal tells: how far away it lies."""
    labels = depth.labels[depth.mask]
    means = np.bincount(labels, values[depth.mask]) / np.bincount(labels)
    centred = np.zeros_like(values)
    centred[depth.mask] = values[depth.mask] - means[labels]
    return centred


def _shadows(shard: Shard, albedo: np.ndarray) -> dict[str, dict[str, float]]:
    """Compare the relit pictures' cast shadows with the rendered ones, over three depths and without any."""
    plain = integrate(shard.normals, shard.mask)
    truth = replace(plain, z=_true_depth(shard).astype(np.float32))
    torn = integrate(shard.normals, shard.mask, discontinuities=True)
    found = {}
    for name, depth in (("none", None), ("plain", plain), ("discontinuities", torn), ("true depth", truth)):
        counts, off, power = np.zeros(3), 0.0, 0.0
        for image, direction in zip(shard.images.astype(np.float32), shard.light_directions, strict=True):
            shading = shard.normals @ direction
            facing = shard.mask & (shading > GRAZING)
            dark = facing & (image.mean(-1) < DARK * (albedo.mean(-1) * shading))
            said = facing & ~trace_light(depth, direction) if depth is not None else np.zeros_like(dark)
            counts += dark.sum(), (said & dark).sum(), (said & ~dark).sum()
            picture = relit(shard.normals, albedo, direction, depth=depth)
            off += float(((picture - image)[shard.mask] ** 2).sum(dtype=np.float64))
            power += float((image[shard.mask] ** 2).sum(dtype=np.float64))
        shadowed, right, wrong = counts
        found[name] = {"found": right / max(shadowed, 1), "wrong": wrong / max(right + wrong, 1),
                       "pixels": int(shadowed), "rms": float(np.sqrt(off / power))}  # fmt: skip
    return found


def _work(step: str, config: BenchClassicalConfig) -> dict[str, Any]:
    """Do one step on the large object, and tell what it took."""
    images, mask, normals, lights, gains = large_object(config)
    if step not in ("albedo", "residuals"):
        images = images[:1]
    kind = step.partition(".")[0]  # of file formats, nothing
    depth: Any = integrate(normals, mask) if kind in ("mesh", "views", "cast shadows", "") else None
    surface: Any = mesh(depth, normals=normals) if not kind else None
    albedo = np.full((*mask.shape, 3), 0.5, np.float32)
    with tempfile.TemporaryDirectory() as folder:
        actions = {
            "integrate": lambda: integrate(normals, mask),
            "discontinuities": lambda: integrate(normals, mask, discontinuities=True),
            "mesh": lambda: mesh(depth, normals=normals),
            "": lambda: write_mesh(surface, Path(folder) / f"object{step}"),
            "views": lambda: strip(depth),
            "cast shadows": lambda: relit(normals, albedo, LOW_LIGHT, depth=depth),
            "albedo": lambda: fit_albedo(images, mask, normals, lights, gains),
            "residuals": lambda: residuals(images, mask, normals, lights, gains, albedo),
        }
        before = peak_gib()
        seconds = measure_seconds(actions[kind])
    return {"seconds": seconds, "before_gib": before, "peak_gib": peak_gib(), "pixels": int(mask.sum())}


def _depth_table(depths: Sequence[dict[str, Any]]) -> str:
    ways = ("plain", "discontinuities")
    body = [
        [row["scene"], row["normals"], f"{row['mae']:.1f}", f"{row['range']:.0f}",
         *(f"{row[way]['mean']:.2f} ({row[way]['largest']:.1f})" for way in ways),
         *(f"{row[way]['residual']:.2f}" for way in ways)]
        for row in depths
    ]  # fmt: skip
    header = ["scene", "normals", "MAE", "range", *ways, "residual", "the same, discontinuities"]
    return render_text("Depth: mean error in pixels (largest); residual in degrees", header, body, (0, 1)) + "\n"


def _picture_table(rows: Sequence[dict[str, Any]]) -> str:
    body = []
    for row in rows:
        colour = " ".join(f"{value:.3f}" for value in row["albedo"])
        body.append([row["scene"], colour, f"{row['residual']:.3f}", "", "", "", ""])
        for name, item in row["shadows"].items():
            told = item["pixels"] and name != "none"
            shares = [f"{item['found']:.0%}", f"{item['wrong']:.0%}"] if told else ["-", "-"]
            body.append(["", "", "", name, *shares, f"{item['rms']:.3f}"])
    header = ["scene", "albedo, median", "residual", "cast shadows by", "found", "of those wrong", "RMS of pictures"]
    return render_text("Pictures, from true normals and lights", header, body, (0, 3)) + "\n"


def _step_table(found: dict[str, dict[str, Any]], config: BenchClassicalConfig) -> str:
    body = []
    for step, item in found.items():
        more = "-" if item["peak_gib"] is None else f"{1024 * (item['peak_gib'] - item['before_gib']):.0f}"
        body.append([step, f"{item['seconds']:.2f}", more])
    pixels = next(iter(found.values()))["pixels"]
    title = f"{config.width}x{config.height}, {pixels:,} pixels of object, {config.lights} images for the last two"
    return render_text(title, ["step", "seconds", "MiB more"], body)
