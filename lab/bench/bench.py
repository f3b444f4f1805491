"""`lab bench`: the renderer's cost as ratios, all from one run in one process.

The many-light renderer is timed against its rays alone, against Mitsuba's `path` one light at a time, and against
itself with more materials, lights and pixels; renders that compile kernels or build acceleration structures are left
out. `lab.bench.bench_data` adds what concerns whole runs: steady state, memory, processes, stages, mixed
light.
"""

import argparse
import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation
from tqdm import tqdm

from lab.bench import bench_data
from lab.shared.memory import measure_seconds
from pipelines.shared.flags import add_fields, from_flags
from render.planning import light_sets
from render.records.manifest import View
from render.shared.config import check_fields, to_plain
from render.shared.files import write_json, write_text
from render.shared.progress import progress_bar
from render.shared.seeds import generator
from render.shared.templates import markdown_table


@dataclass(frozen=True, kw_only=True)
class BenchConfig:
    """What is timed; the default blob covers about 36 % of the frame.

    Attributes:
        shape: Name of the shape.
        scale: Radius of its bounding sphere, in half image widths.
        material: Name of the material.
        second: Material added to the first to see what another one costs.
        mirror: Mirror-like material, whose highlights get samples of their own.
        textured: Textured material with a relief.
        layered: Texture with fitted materials in its regions.
        composition: Composition, enlarged until it covers as much of the frame as the shape.
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
    mirror: str = "chrome"
    textured: str = "procedural:tiles:5"
    layered: str = "procedural:wood:5:blue-acrylic+gold-metallic-paint"
    composition: str = "composition:15"
    size: int = 128
    lights: int = 64
    spp: int = 64
    bounces: int = 2
    repeats: int = 7
    path_repeats: int = 3
    seed: int = 0

    def __post_init__(self) -> None:
        check_fields(self, "at least 1", "size", "lights", "spp", "repeats", "path_repeats")
        check_fields(self, "not negative", "bounces")


_CAMERA = 5.0  # distance of the perspective camera, in radii of the object
_NEAR = (2.0, 5.0)  # those of near lights
LABELS = {
    "rays": "rays alone (camera, bounces, shadows), nothing shaded",
    "rays, every sample": "the same with a shadow ray for every sample and light",
    "one material": "all lights at once",
    "two materials": "all lights at once, two materials",
    "mirror-like": "all lights at once, a mirror-like material",
    "near lights": "all lights at once, near ones",
    "perspective": "all lights at once, perspective camera",
    "near lights, perspective": "all lights at once, near ones, perspective camera",
    "textured": "all lights at once, a textured material",
    "layered": "all lights at once, fitted materials in a texture",
    "composition": "all lights at once, a composition, two materials by object",
    "composition, 3 bounces": "the same with three bounces, as presets have it",
    "twice the lights": "all lights at once, twice as many",
    "twice the size": "all lights at once, twice the image side",
    "path": "Mitsuba `path`, one light after another",
}
# name: (numerator, denominator, subtracted afterwards, target)
RATIOS = {
    "path / all lights": ("path", "one material", 0, "at least 8"),
    "all lights / rays": ("one material", "rays", 0, "at most 1.25"),
    "all lights / rays of every sample": ("one material", "rays, every sample", 0, ""),
    "second material / first": ("two materials", "one material", 1, "at most 0.35"),
    "128 / 64 lights": ("twice the lights", "one material", 0, "at most 2"),
    "256x256 / 128x128": ("twice the size", "one material", 0, "at most 4.4"),
    "mirror-like / plain material": ("mirror-like", "one material", 0, ""),
    "near / distant lights": ("near lights", "one material", 0, "at most 1.3"),
    "perspective / orthographic": ("perspective", "one material", 0, ""),
    "near and perspective / plain": ("near lights, perspective", "one material", 0, ""),
    "textured / plain material": ("textured", "one material", 0, "at most 1.5"),
    "layered / plain material": ("layered", "one material", 0, "at most 1.5"),
    "composition / plain": ("composition", "one material", 0, "at most 1.5"),
    "composition of 3 bounces / plain": ("composition, 3 bounces", "one material", 0, "at most 1.5"),
}


def run(config: BenchConfig) -> dict[str, Any]:
    """Time the ways of rendering the scene of `config`.

    Returns:
        `config`, `machine` (versions, variant, coverage), `seconds` (median per way), `spread` (fastest and slowest)
        and `ratios`; plain values, ready for JSON.

    Raises:
        InputError: unknown shape or material, or no usable Mitsuba variant.
    """
    from render.backend.jit import dr, mi

    found: dict[str, Any] = {}
    ways = _ways(config, found)
    with progress_bar(total=len(ways) * (config.repeats + 2) + config.path_repeats, unit="run", desc="bench") as bar:
        times = _interleave(ways, config.repeats, bar)
        times["path"] = [_path(config, found, bar) for _ in range(config.path_repeats)]
    seconds = {name: float(np.median(values)) for name, values in times.items()}
    return {
        "config": to_plain(config),
        "machine": {"mitsuba": mi.__version__, "drjit": dr.__version__, "variant": mi.variant(),
                    "threads": dr.thread_count(), "coverage": found["coverage"]},
        "seconds": seconds,
        "spread": {name: [min(values), max(values)] for name, values in times.items()},
        "ratios": {name: seconds[a] / seconds[b] - less for name, (a, b, less, _) in RATIOS.items()},
        "first_light_mean": {"all lights": found["mean"], "path": found["path_mean"]},
    }  # fmt: skip


def _ways(config: BenchConfig, found: dict[str, Any]) -> dict[str, Callable[[], None]]:
    """Return the ways of rendering that are timed in turn, but for `path`."""
    from render import shapes
    from render.backend.jit import dr
    from render.kernel import many_lights, paths, scene
    from render.materials.kernels.packed import pack

    view, built = View(scale=config.scale), scene.build(shapes.load(config.shape))
    lights = _lights(config, 2 * config.lights)
    one, two, mirror = pack([config.material]), pack([config.material, config.second]), pack([config.mirror])
    textured, layered = pack([config.textured]), pack([config.layered])
    settings: dict[str, Any] = {"size": config.size, "spp": config.spp, "bounces": config.bounces, "seed": config.seed}

    pinhole = replace(view, camera_distance=_CAMERA * config.scale)
    near = np.linspace(*_NEAR, config.lights) * config.scale
    heap, framed = _composition(config)
    dealt, heaped = pack([f"parts:0:{config.material}+{config.second}"], heap), scene.build(heap)

    def all_lights(
        surfaces: Any = one, count: int = config.lights, seen: View = view, hit: Any = built, **changes: Any
    ) -> None:
        truth, images = many_lights.render(hit, seen, surfaces, lights[:count], **settings | changes)
        means = [float(image[0].mean()) for _, image in images]
        if surfaces is one and seen is view and not changes and count == config.lights:
            found["coverage"], found["mean"] = float(truth.coverage.mean()), means[0]

    def rays_alone(probe: bool = True) -> None:
        paths.trace(built, view, one, lights[: config.lights], **settings, probe=probe)
        dr.sync_thread()

    return {
        "rays": rays_alone,
        "rays, every sample": lambda: rays_alone(False),
        "one material": all_lights,
        "two materials": lambda: all_lights(two),
        "mirror-like": lambda: all_lights(mirror),
        "near lights": lambda: all_lights(distances=near),
        "perspective": lambda: all_lights(seen=pinhole),
        "near lights, perspective": lambda: all_lights(seen=pinhole, distances=near),
        "textured": lambda: all_lights(textured),
        "layered": lambda: all_lights(layered),
        "composition": lambda: all_lights(dealt, seen=framed, hit=heaped),
        "composition, 3 bounces": lambda: all_lights(dealt, seen=framed, hit=heaped, bounces=3),
        "twice the lights": lambda: all_lights(count=2 * config.lights),
        "twice the size": lambda: all_lights(size=2 * config.size),
    }


def _composition(config: BenchConfig) -> tuple[Any, View]:
    """Return the composition and a view of it from above in which it covers as much as the shape does."""
    from render import shapes
    from render.planning.framing import measure

    mesh, low, high = shapes.load(config.composition), 0.1, 4.0
    wanted = measure(shapes.load(config.shape), View(scale=config.scale)).foreground
    view = View(rotation=tuple(Rotation.from_euler("x", 40, degrees=True).as_matrix().ravel()))
    for _ in range(12):
        view = replace(view, scale=(low + high) / 2)
        low, high = (low, view.scale) if measure(mesh, view).foreground > wanted else (view.scale, high)
    return mesh, view


def _lights(config: BenchConfig, count: int) -> np.ndarray:
    drawn = light_sets.draw("azimuth-elevation", count, generator(config.seed, "bench", "lights"))
    return drawn.astype(np.float32)


def _path(config: BenchConfig, found: dict[str, Any], bar: "tqdm[Any]") -> float:
    """Time Mitsuba's `path` over all lights of a scene loaded once."""
    from render import shapes
    from render.kernel import reference

    lights = _lights(config, 2 * config.lights)[: config.lights]
    # The first light is rendered twice: its first image loads the scene and compiles, and is not timed.
    images = reference.render_each_light(
        shapes.load(config.shape), View(scale=config.scale), config.material, np.concatenate([lights[:1], lights]),
        size=config.size, spp=config.spp, bounces=config.bounces, seed=config.seed,
    )  # fmt: skip
    found["path_mean"] = float(next(images).mean())
    elapsed = measure_seconds(lambda: [image.shape for image in images])
    bar.update()
    return elapsed


def _interleave(ways: dict[str, Callable[[], None]], repeats: int, bar: "tqdm[Any]") -> dict[str, list[float]]:
    """Run the ways in turn, so that a change of the machine's load meets all; two rounds warm up."""
    times: dict[str, list[float]] = {name: [] for name in ways}
    for number in range(repeats + 2):
        for name, way in ways.items():
            elapsed = measure_seconds(way)
            if number >= 2:
                times[name].append(elapsed)
            bar.update()
    return times


def table(result: dict[str, Any]) -> str:
    """Format the result of `run` as Markdown tables with a line about the scene and the machine."""
    config, machine, seconds, spread = (result[key] for key in ("config", "machine", "seconds", "spread"))
    about = (
        f"{config['shape']} covering {machine['coverage']:.0%} of {config['size']}x{config['size']} pixels, "
        f"{config['lights']} lights, {config['spp']} spp, {config['bounces']} bounces, {config['material']}; "
        f"{machine['variant']}, {machine['threads']} threads, mitsuba {machine['mitsuba']}\n"
    )
    ways = [
        (label, f"{seconds[name]:.3f}", f"{spread[name][0]:.3f} - {spread[name][1]:.3f}")
        for name, label in LABELS.items()
    ]
    ratios = [(name, f"{value:.2f}", RATIOS[name][3]) for name, value in result["ratios"].items()]
    tables = (("way", "seconds (median)", "fastest - slowest"), ways), (("ratio", "measured", "target"), ratios)
    return "\n".join([about, *(f"{markdown_table(*table)}\n" for table in tables)])


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add one flag per field of `BenchConfig`, and what to run."""
    add_fields(parser, BenchConfig)
    parser.add_argument("--only", choices=("ratios", *bench_data.PARTS), help="run one part only")
    parser.add_argument("--scenes", type=int, default=1000, help="scenes of the memory test (default %(default)s)")
    parser.add_argument("--out", type=Path, help="folder for bench.md, bench.json and memory.png")


def main(args: argparse.Namespace) -> int:
    """Run the benchmark, print its tables and return the exit code."""
    config = from_flags(BenchConfig, args)
    result, texts = {}, []
    for part in [args.only] if args.only else ["ratios", *bench_data.PARTS]:
        if part == "ratios":
            result[part] = run(config)
            texts.append(table(result[part]))
        else:
            result[part], text = bench_data.PARTS[part](args.scenes, args.out)
            texts.append(text)
        sys.stdout.write(texts[-1] + "\n")
    if args.out:
        write_json(args.out / "bench.json", result)
        write_text(args.out / "bench.md", "\n".join(texts))
    return 0
