"""`sdps bench-classical`: seconds and memory of every classical method on an object of DiLiGenT's size.

The object is an analytic ellipsoid of nine colours with a glossy coat that fills 512x612 pixels but for a margin; each
method works in a process of its own, so that its peak memory is its own. Times are also given as ratios to plain
least squares in the same run.
"""

import argparse
import sys
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import numpy as np

from pipelines.shared.lists import split_list
from pipelines.shared.memory import apart, peak_gib
from pipelines.shared.text_tables import render_text
from render.planning import light_sets
from render.shared.errors import InputError
from render.shared.files import write_json, write_text
from render.shared.progress import progress_bar
from render.shared.seeds import generator
from sdps.classical import registry
from sdps.classical.common.isotropy import half_vectors
from sdps.core.metrics import normal_mae

SECONDS, GIBIBYTES = 60.0, 4.0
"""The limits of each method on two cores."""


@dataclass(frozen=True, kw_only=True)
class BenchClassicalConfig:
    """What is timed.

    Attributes:
        height: Rows of the images.
        width: Columns.
        lights: Number of images.
        seed: Seed of lights, colours and intensities.
    """

    height: int = 512
    width: int = 612
    lights: int = 96
    seed: int = 0

    def __post_init__(self) -> None:
        if min(self.height, self.width) < 32 or self.lights < 12:
            raise InputError("height and width must be at least 32, lights at least 12")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the flags of `sdps bench-classical`."""
    parser.add_argument("--methods", action="append", help=f"{', '.join(registry.METHODS)} (default: all)")
    parser.add_argument("--height", type=int, default=BenchClassicalConfig.height)
    parser.add_argument("--width", type=int, default=BenchClassicalConfig.width)
    parser.add_argument("--lights", type=int, default=BenchClassicalConfig.lights)
    parser.add_argument("--seed", type=int, default=BenchClassicalConfig.seed)
    parser.add_argument("--out", default="out/bench-classical", help="output folder (default: out/bench-classical)")


def main(args: argparse.Namespace) -> int:
    """Time the methods, print the table and write it."""
    config = BenchClassicalConfig(height=args.height, width=args.width, lights=args.lights, seed=args.seed)
    names = split_list(args.methods) or list(registry.METHODS)
    for name in names:
        registry.method(name)
    found = {name: measure(name, config) for name in progress_bar(names, desc="bench", unit="method")}
    out, text = Path(args.out), table(found, config)
    write_json(out / "bench_classical.json", {"config": vars(config), "methods": found})
    write_text(out / "bench_classical.md", text)
    sys.stdout.write(f"{text}{out / 'bench_classical.md'}\n")
    return 0


def measure(name: str, config: BenchClassicalConfig) -> dict[str, Any]:
    """Run a method in a fresh process: seconds, peak_gib, input_gib, pixels, normal_mae, error.

    The two sizes are None where the system does not tell them.
    """
    return apart(_work, name, config)


def _work(name: str, config: BenchClassicalConfig, results: Connection) -> None:
    """Make the images, run the method, and send what it took."""
    images, mask, normals, lights, gains = scene(config)
    before = peak_gib()
    try:
        estimate = registry.run(name, images, mask, lights, gains)
    except InputError as error:
        results.send({"error": str(error)})
        return
    results.send(
        {
            "seconds": estimate.diagnostics["seconds"],
            "peak_gib": peak_gib(),
            "input_gib": before,
            "pixels": int(mask.sum()),
            "normal_mae": normal_mae(estimate.normals, normals, mask),
            "error": "",
        }
    )


def scene(config: BenchClassicalConfig) -> tuple[np.ndarray, ...]:
    """Return images (L, H, W, 3) float32, mask (H, W), normals (H, W, 3), lights (L, 3), intensities (L,)."""
    rng = generator(config.seed, "bench classical")
    x = ((np.arange(config.width) + 0.5) / config.width * 2 - 1) / 0.96
    y = -((np.arange(config.height) + 0.5) / config.height * 2 - 1) / 0.96
    x, y = np.meshgrid(x, y)
    mask = x**2 + y**2 < 0.98
    aspect = config.width / config.height
    normals = np.stack([x / aspect, y, np.sqrt(np.maximum(1 - x**2 - y**2, 0))], axis=-1)
    normals = normals / np.linalg.norm(normals, axis=-1, keepdims=True) * mask[..., None]
    cell = (np.floor((x + 1) * 6).astype(int) * 5 + np.floor((y + 1) * 6).astype(int) * 3) % 9
    albedo = rng.uniform(0.2, 0.9, (9, 3))[cell]  # (H, W, 3)
    lights = light_sets.draw("near-uniform", config.lights, rng)
    gains = rng.uniform(0.2, 2.0, config.lights)
    half = half_vectors(lights)
    images = np.empty((config.lights, config.height, config.width, 3), np.float32)
    for index in range(config.lights):
        shading = np.maximum(normals @ lights[index], 0.0)
        gloss = 0.3 * np.maximum(normals @ half[index], 0.0) ** 60 * (shading > 0)
        images[index] = gains[index] * (albedo * shading[..., None] + gloss[..., None])
    return images, mask, normals.astype(np.float32), lights.astype(np.float32), gains.astype(np.float32)


def table(found: dict[str, dict[str, Any]], config: BenchClassicalConfig) -> str:
    """Lay the figures out as text, with the limits."""
    base = found.get("least-squares", {}).get("seconds")
    rows = []
    for name, item in found.items():
        if item["error"]:
            rows.append([name, "-", "-", "-", "-", item["error"]])
            continue
        ratio = f"{item['seconds'] / base:.1f}" if base else "-"
        size, verdict = "-", "-"
        if item["peak_gib"] is not None:
            size = f"{item['peak_gib']:.2f}"
            verdict = "yes" if item["seconds"] <= SECONDS and item["peak_gib"] <= GIBIBYTES else "no"
        rows.append([name, f"{item['seconds']:.1f}", ratio, size, f"{item['normal_mae']:.2f}", verdict])
    pixels = next((item["pixels"] for item in found.values() if not item["error"]), 0)
    title = f"{config.lights} images of {config.width}x{config.height}, {pixels:,} pixels of object"
    limit = f"within {SECONDS:.0f} s, {GIBIBYTES:.0f} GiB"
    header = ["method", "seconds", "times least squares", "peak GiB", "normal MAE", limit]
    return render_text(title, header, rows)
