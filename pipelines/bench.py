"""Time of the many-light renderer against its rays alone and against Mitsuba's `path`, one light at a time.

All three run in one process on the same scene, so that their ratios hold on any machine. Renders that
compile kernels or build acceleration structures are left out of the times.
"""

import argparse
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np
from tqdm import tqdm

from render import lights as light_sets
from render.config import to_plain
from render.errors import InputError
from render.files import write_json
from render.manifest import View
from render.progress import progress_bar
from render.seeds import generator


@dataclass(frozen=True, kw_only=True)
class BenchConfig:
    """What is timed; the default blob covers about 36 % of the frame.

    Attributes:
        shape: Name of the shape.
        scale: Radius of its bounding sphere, in half image widths.
        material: Name of the material.
        second: Material added to the first to see what another one costs.
        size: Image side in pixels.
        lights: Number of lights.
        spp: Camera samples per pixel.
        bounces: Interreflection bounces.
        repeats: Times each way is run; the median counts.
        path_repeats: The same for Mitsuba's `path`.
        seed: Seed of lights and sampler.
    """

    shape: str = "blobby:9"
    scale: float = 0.8
    material: str = "blue-acrylic"
    second: str = "gold-metallic-paint"
    size: int = 128
    lights: int = 64
    spp: int = 16
    bounces: int = 2
    repeats: int = 9
    path_repeats: int = 3
    seed: int = 0

    def __post_init__(self) -> None:
        for name in ("size", "lights", "spp", "repeats", "path_repeats"):
            if getattr(self, name) < 1:
                raise InputError(f"{name} must be at least 1, got {getattr(self, name)}")
        if self.bounces < 0:
            raise InputError(f"bounces must not be negative, got {self.bounces}")


def run(config: BenchConfig) -> dict:
    """Time the three ways of rendering the scene of `config`.

    Returns:
        `config`, `machine` (versions, variant, coverage), `seconds` (median per way), `spread` (fastest and slowest),
        `ratios` and `kernels_compiled` in steady state; plain values, ready for JSON.

    Raises:
        InputError: unknown shape or material, or no usable Mitsuba variant.
    """
    from render import variant

    mi = variant.load()
    import drjit as dr

    from render import many_lights, reference, scene, shapes
    from render.materials import library
    from render.materials.bsdf import PackedMaterials

    mesh, view = shapes.load(config.shape), View(scale=config.scale)
    lights = light_sets.draw("azimuth-elevation", config.lights, generator(config.seed, "bench", "lights"))
    lights = lights.astype(np.float32)
    built = scene.build(mesh)
    one = PackedMaterials([library.load(config.material)])
    two = PackedMaterials([library.load(config.material), library.load(config.second)])
    settings = {"size": config.size, "spp": config.spp, "bounces": config.bounces, "seed": config.seed}
    found = {}

    def all_lights(materials: PackedMaterials = one) -> None:
        found["truth"], images = many_lights.render(built, view, materials, lights, **settings)
        found["means"] = [float(image[0].mean()) for _, image in images]

    def rays_alone() -> None:
        many_lights.trace(built, view, one, lights, **settings)
        dr.sync_thread()

    with progress_bar(total=3 * (config.repeats + 2) + config.path_repeats, unit="run", desc="bench") as bar:
        ways = {"all_lights": all_lights, "rays_alone": rays_alone, "two_materials": lambda: all_lights(two)}
        times = _interleaved(ways, config.repeats, bar)
        compiled = _compiled(all_lights)
        times["path"], path_mean = [], 0.0
        for _ in range(config.path_repeats):
            # The first light is rendered twice: its first image loads the scene and compiles, and is not timed.
            again = np.concatenate([lights[:1], lights])
            images = reference.render_each_light(mesh, view, config.material, again, **settings)
            path_mean = float(next(images).mean())
            times["path"].append(_timed(lambda images=images: [image.shape for image in images]))
            bar.update()
    seconds = {name: float(np.median(values)) for name, values in times.items()}
    return {
        "config": to_plain(config),
        "machine": {
            "mitsuba": mi.__version__,
            "drjit": dr.__version__,
            "variant": mi.variant(),
            "threads": dr.thread_count(),
            "coverage": float(found["truth"].coverage.mean()),
        },
        "seconds": seconds,
        "spread": {name: [min(values), max(values)] for name, values in times.items()},
        "ratios": {
            "path / all_lights": seconds["path"] / seconds["all_lights"],
            "all_lights / rays_alone": seconds["all_lights"] / seconds["rays_alone"],
            "second material / first": seconds["two_materials"] / seconds["all_lights"] - 1,
        },
        "kernels_compiled": compiled,
        "first_light_mean": {"all_lights": found["means"][0], "path": path_mean},
    }


def _interleaved(ways: dict[str, Callable[[], None]], repeats: int, bar: tqdm) -> dict[str, list[float]]:
    """Run the ways in turn, so that a change of the machine's load meets all; two rounds warm up."""
    times: dict[str, list[float]] = {name: [] for name in ways}
    for number in range(repeats + 2):
        for name, way in ways.items():
            elapsed = _timed(way)
            if number >= 2:
                times[name].append(elapsed)
            bar.update()
    return times


def _timed(action: Callable[[], object]) -> float:
    start = time.perf_counter()
    action()
    return time.perf_counter() - start


def _compiled(action: Callable[[], None]) -> int:
    """Return the number of kernels that `action` compiles."""
    import drjit as dr

    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history_clear()
        action()
        history = dr.kernel_history([dr.KernelType.JIT])
    return sum(not kernel["cache_hit"] for kernel in history)


def table(result: dict) -> str:
    """Format the result of `run` as a Markdown table with a line about the scene and the machine."""
    config, machine, seconds, spread = (result[key] for key in ("config", "machine", "seconds", "spread"))
    labels = {
        "rays_alone": "rays alone (camera, bounces, shadows), nothing shaded",
        "all_lights": "all lights at once",
        "two_materials": "all lights at once, two materials",
        "path": "Mitsuba `path`, one light after another",
    }
    lines = [
        f"{config['shape']} covering {machine['coverage']:.0%} of {config['size']}x{config['size']} pixels, "
        f"{config['lights']} lights, {config['spp']} spp, {config['bounces']} bounces, {config['material']}; "
        f"{machine['variant']}, {machine['threads']} threads, mitsuba {machine['mitsuba']}",
        "",
        "| way | seconds (median) | fastest - slowest |",
        "|---|---|---|",
    ]
    for name, label in labels.items():
        lines.append(f"| {label} | {seconds[name]:.3f} | {spread[name][0]:.3f} - {spread[name][1]:.3f} |")
    lines += ["", "| ratio | |", "|---|---|"]
    lines += [f"| {name.replace('_', ' ')} | {value:.2f} |" for name, value in result["ratios"].items()]
    lines += [f"| kernels compiled in steady state | {result['kernels_compiled']} |", ""]
    return "\n".join(lines)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add one flag per field of `BenchConfig`, and `--out`."""
    for entry in fields(BenchConfig):
        flag = f"--{entry.name.replace('_', '-')}"
        parser.add_argument(flag, dest=entry.name, type=entry.type, default=entry.default, help="(default %(default)s)")
    parser.add_argument("--out", type=Path, help="also write the result as JSON to this file")


def main(args: argparse.Namespace) -> int:
    """Run the benchmark, print its table and return the exit code."""
    result = run(BenchConfig(**{entry.name: getattr(args, entry.name) for entry in fields(BenchConfig)}))
    sys.stdout.write(table(result))
    if args.out:
        write_json(args.out, result)
    return 0
