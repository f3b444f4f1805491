"""`lab noise`: how far the images at a sample count are from converged ones, material by material.

The error of a scene is the mean of |image - reference| over the object's pixels, all lights and channels, divided by
the mean of the reference; the bias is the same without the bars. The reference has its own random numbers, many samples
(4,096), and a shadow ray for every one of them.
"""

import argparse
import sys
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from pipelines.shared.flags import add_fields, split_list
from render.planning import light_sets
from render.planning.chunks import GROUP_SIZE
from render.records.manifest import View
from render.shared.config import build
from render.shared.errors import InputError
from render.shared.files import write_json, write_text
from render.shared.progress import progress_bar
from render.shared.seeds import generator
from render.shared.templates import markdown_table

_NUMBERS = ("reference", "lights", "size", "bounces", "seed")


@dataclass(frozen=True, kw_only=True)
class NoiseConfig:
    """What is measured.

    Attributes:
        shapes: Shape names.
        materials: Names or categories.
        spp: Sample counts to judge.
        reference: Samples of the reference.
        lights: Number of lights.
        size: Image side in pixels.
        bounces: Interreflection bounces.
        scale: Radius of the object's unit sphere, in half image widths.
        seed: Seed of lights and sampler; the reference uses the next one.
    """

    shapes: tuple[str, ...] = ("bunny",)
    materials: tuple[str, ...] = ("all",)
    spp: tuple[int, ...] = (64, 128)
    reference: int = 4096
    lights: int = 4
    size: int = 128
    bounces: int = 2
    scale: float = 0.95
    seed: int = 0

    def __post_init__(self) -> None:
        if not self.spp or min(self.spp) < 1 or self.reference <= max(self.spp):
            raise InputError(f"spp must be positive and below the reference's {self.reference}, got {self.spp}")
        if self.lights < 2 or self.size < 16 or self.bounces < 0:
            raise InputError("lights must be at least 2, size at least 16, and bounces not negative")


@dataclass(frozen=True)
class Row:
    """Error and bias in percent of one material on one shape, by sample count."""

    shape: str
    material: str
    error: dict[int, float]
    bias: dict[int, float]


def measure(config: NoiseConfig) -> list[Row]:
    """Return a row per shape and material.

    Raises:
        InputError: unknown shape or material.
    """
    from render import shapes
    from render.planning.plan import material_pool

    names = material_pool(config.materials)
    for shape in config.shapes:
        shapes.load(shape)
    rows = []
    with progress_bar(total=len(names) * len(config.shapes), unit="material", desc="noise") as bar:
        for shape in config.shapes:
            for first in range(0, len(names), GROUP_SIZE):
                part = _measure_group(config, shape, names[first : first + GROUP_SIZE])
                rows += part
                bar.update(len(part))
    return rows


@lru_cache(maxsize=1)
def _build(shape: str) -> Any:
    """Return the scene of a shape, kept for its next materials."""
    from render import shapes
    from render.kernel import scene

    return scene.build(shapes.load(shape))


def _measure_group(config: NoiseConfig, shape: str, materials: list[str]) -> list[Row]:
    """Render materials of one shape, which share rays, and compare."""
    from render.kernel import many_lights
    from render.materials.kernels.packed import pack

    directions = light_sets.draw("azimuth-elevation", config.lights, generator(config.seed, "noise", "lights"))
    built = _build(shape)
    packed = pack(materials, built.mesh)

    def images(spp: int, seed: int, probe: bool) -> tuple[Any, list[np.ndarray]]:
        truth, stacks = many_lights.render(
            built, View(scale=config.scale), packed, directions.astype(np.float32), size=config.size, spp=spp,
            bounces=config.bounces, seed=seed, probe=probe,
        )  # fmt: skip
        return truth, [stack for _, stack in stacks]

    truth, converged = images(config.reference, config.seed + 1, False)
    seen = truth.coverage > 0
    tried = {spp: images(spp, config.seed, True)[1] for spp in config.spp}
    rows = []
    for number, name in enumerate(materials):
        level = converged[number][:, seen].mean()
        gaps = {spp: (stacks[number] - converged[number])[:, seen] for spp, stacks in tried.items()}
        error = {spp: float(100 * np.abs(gap).mean() / level) for spp, gap in gaps.items()}
        rows.append(Row(shape, name, error, {spp: float(100 * gap.mean() / level) for spp, gap in gaps.items()}))
    return rows


def table(rows: list[Row], config: NoiseConfig) -> str:
    """Format the rows as a Markdown table, largest error at the last sample count first."""
    last = config.spp[-1]
    by_name: dict[str, dict[str, Row]] = {}
    for row in rows:
        by_name.setdefault(row.material, {})[row.shape] = row
    order = sorted(by_name, key=lambda name: -max(row.error[last] for row in by_name[name].values()))
    heads = [f"{shape} {spp} spp" for shape in config.shapes for spp in config.spp]
    heads += [f"{shape} bias, {last} spp" for shape in config.shapes]
    body = []
    for name in order:
        shown = [by_name[name][shape] for shape in config.shapes]
        errors = [f"{row.error[spp]:.2f}" for row in shown for spp in config.spp]
        body.append([name, *errors, *(f"{row.bias[last]:+.2f}" for row in shown)])
    return markdown_table(["material", *heads], body) + "\n"


def summary(rows: list[Row], config: NoiseConfig) -> str:
    """Say in a line per shape and sample count how the errors are distributed."""
    lines = []
    for shape in config.shapes:
        for spp in config.spp:
            errors = np.array([row.error[spp] for row in rows if row.shape == shape])
            lines.append(
                f"{shape}, {spp} spp: median {np.median(errors):.2f} %, worst {errors.max():.2f} %, "
                f"{(errors > 3).sum()} of {len(errors)} above 3 %"
            )
    return "\n".join(lines) + "\n"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the flags of `python -m lab noise`."""
    parser.add_argument("--shapes", action="append", help="commas or repeat (default: bunny)")
    parser.add_argument("--materials", action="append", help="names, categories, files (default: all)")
    parser.add_argument("--spp", action="append", help="sample counts to judge (default: 64,128)")
    add_fields(parser, NoiseConfig, _NUMBERS)
    parser.add_argument("--out", type=Path, help="also write noise.md and noise.json into this folder")


def main(args: argparse.Namespace) -> int:
    """Measure, print the summary and the table."""
    given = {name: split_list(getattr(args, name)) for name in ("shapes", "materials", "spp")}
    numbers = {name: getattr(args, name) for name in _NUMBERS}
    config = build(NoiseConfig, {name: value for name, value in given.items() if value} | numbers)
    rows = measure(config)
    text = summary(rows, config) + "\n" + table(rows, config)
    sys.stdout.write(text)
    if args.out:
        write_text(args.out / "noise.md", text)
        write_json(args.out / "noise.json", [row.__dict__ for row in rows])
    return 0
