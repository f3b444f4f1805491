"""`lab bench-classical`: seconds and memory of every classical method on an object of DiLiGenT's size.

The object is an analytic ellipsoid of nine colours with a glossy coat that fills 512x612 pixels but for a margin; each
method works in a process of its own, so that its peak memory is its own. Times are also given as ratios to plain
least squares in the same run.
"""

import argparse
import sys
from typing import Any

from lab.bench.bench_scenes import BenchClassicalConfig, large_object
from lab.shared.memory import measure, peak_gib
from pipelines.shared.flags import add_fields, add_out, from_flags, pick_names
from pipelines.shared.text_tables import render_text
from render.shared.files import write_json, write_text
from render.shared.progress import progress_bar
from sdps.classical import registry
from sdps.core.metrics import normal_mae

SECONDS, GIBIBYTES = 60.0, 4.0
"""The limits of each method on two cores."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the flags of `python -m lab bench-classical`."""
    parser.add_argument("--methods", action="append", help=f"{', '.join(registry.METHODS)} (default: all)")
    add_fields(parser, BenchClassicalConfig)
    add_out(parser, "out/bench-classical")


def main(args: argparse.Namespace) -> int:
    """Time the methods, print the table and write it."""
    config, names = from_flags(BenchClassicalConfig, args), pick_names("method", args.methods, registry.METHODS)
    found = {name: measure(_work, name, config) for name in progress_bar(names, desc="bench", unit="method")}
    text = table(found, config)
    write_json(args.out / "bench_classical.json", {"config": vars(config), "methods": found})
    write_text(args.out / "bench_classical.md", text)
    sys.stdout.write(f"{text}{args.out / 'bench_classical.md'}\n")
    return 0


def _work(name: str, config: BenchClassicalConfig) -> dict[str, Any]:
    """Make the images, run the method, and tell what it took; sizes are None where the system does not tell them."""
    images, mask, normals, lights, gains = large_object(config)
    before = peak_gib()
    estimate = registry.run(name, images, mask, lights, gains)
    return {
        "seconds": estimate.seconds,
        "peak_gib": peak_gib(),
        "input_gib": before,
        "pixels": int(mask.sum()),
        "normal_mae": normal_mae(estimate.normals, normals, mask),
    }


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
