"""`sdps eval-lights`: lighting estimation on real photographs whose lights were measured and whose normals were not.

Gourd&Apple (Alldrin et al. 2008) and the Light Stage Data Gallery (Einarsson et al. 2006), as in SDPS-Net's table
"Lighting estimation results on the Gourd&Apple dataset and the Light Stage Data Gallery".
"""

import argparse
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pipelines.benchmarks import gourd_apple, light_stage, published_real, suite
from pipelines.benchmarks.object_tables import object_table
from pipelines.evaluate.evaluation import TestObject
from pipelines.report.sections import Section, Table
from pipelines.shared.lists import split_list
from pipelines.shared.using import describe
from render.shared.config import to_plain
from render.shared.errors import InputError
from sdps.inference.inference_config import inference_config
from sdps.methods import select
from sdps.methods.method import CONSTANT, Method
from sdps.models.registry import TRUE_LIGHTS


@dataclass(frozen=True)
class Benchmark:
    """A benchmark of lighting estimation.

    Attributes:
        name: Folder name of its results.
        title: Its name in tables.
        known: Its objects in the order of the published table.
        load: Reads the objects for the flags.
        directions, intensities: Published rows.
        about: What is special to its images, one clause.
    """

    name: str
    title: str
    known: tuple[str, ...]
    load: Callable[[argparse.Namespace], list[TestObject]]
    directions: tuple[published_real.PublishedRow, ...]
    intensities: tuple[published_real.PublishedRow, ...]
    about: Callable[[argparse.Namespace], str]


BENCHMARKS = {
    "gourd-apple": Benchmark(
        "gourd-apple", "Gourd&Apple", gourd_apple.OBJECTS,
        lambda args: gourd_apple.gourd_apple_objects(
            args.data, refined=not args.measured_lights, longest=args.longest_side),
        published_real.GOURD_APPLE_DIRECTIONS, published_real.GOURD_APPLE_INTENSITIES,
        lambda args: f"against the {'measured' if args.measured_lights else 'refined'} lights",
    ),
    "light-stage": Benchmark(
        "light-stage", "Light Stage Data Gallery", light_stage.OBJECTS,
        lambda args: light_stage.light_stage_objects(
            args.data, least_z=args.least_z, gamma=args.gamma, longest=args.longest_side),
        published_real.LIGHT_STAGE_DIRECTIONS, published_real.LIGHT_STAGE_INTENSITIES,
        lambda args: f"images whose light has z > {args.least_z:g}, PNG values to the power {args.gamma:g}",
    ),
}  # fmt: skip


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the flags of `sdps eval-lights`."""
    suite.add_arguments(parser, "out/real")
    parser.add_argument("--dataset", required=True, choices=tuple(BENCHMARKS), help="which layout the folder has")
    parser.add_argument("--measured-lights", action="store_true",
                        help="gourd-apple: compare with the measured lights, not the refined ones")  # fmt: skip
    parser.add_argument("--least-z", type=float, default=0.0, metavar="Z",
                        help="light-stage: use images whose light direction has z above it (default: 0)")  # fmt: skip
    parser.add_argument("--gamma", type=float, default=1.0,
                        help="light-stage: exponent that makes PNG values linear (default: 1, linear)")  # fmt: skip
    parser.add_argument("--longest-side", type=int, default=0, metavar="PIXELS",
                        help="average larger crops down to this, to save memory (default: 0, never)")  # fmt: skip


def main(args: argparse.Namespace) -> int:
    """Evaluate, print the tables, and write <out>/<dataset>/results.json and the report's section."""
    _check(args)
    bench = BENCHMARKS[args.dataset]
    models = select.runs_folder(args.models)
    using = inference_config(args)
    chosen = select.selected(split_list(args.methods), models, using)
    _refuse_given([method for method in chosen if method.lights == TRUE_LIGHTS])
    items = suite.pick(bench.load(args), split_list(args.objects))
    chosen = chosen or default_methods(models)
    shown = suite.pictured(chosen)
    found, runners = suite.run(items, chosen, models, args.out / bench.name / "cache", using, shown)
    tables = build_tables(bench, items, found, chosen)
    text = definition(bench, items, args) + describe(runners, using)
    section = Section(
        name=bench.name,
        title=bench.title,
        text=text,
        order=50,
        tables=tuple(tables),
        command=f"sdps eval-lights {args.data} --dataset {args.dataset} --out {args.out}",
    )
    protocol = {name: getattr(args, name) for name in ("measured_lights", "least_z", "gamma", "longest_side")}
    suite.write(args.out, section, items, found, runners, shown, {**protocol, **to_plain(using)})
    sys.stdout.write(f"{suite.text_of(tables, found)}\n{text}\n{args.out / bench.name / 'results.json'}\n")
    return 0


def _check(args: argparse.Namespace) -> None:
    if not -1.0 <= args.least_z < 1.0:
        raise InputError(f"--least-z {args.least_z:g}: must be from -1 to below 1")
    if not args.gamma > 0:
        raise InputError(f"--gamma {args.gamma:g}: must be positive")
    if args.longest_side < 0 or 0 < args.longest_side < 16:
        raise InputError(f"--longest-side {args.longest_side}: must be 0 or at least 16 pixels")


def _refuse_given(given: Sequence[Method]) -> None:
    if given:
        raise InputError(f"--methods: {given[0].name} is given the lights, so there is nothing to score")


def default_methods(models: Path | None) -> list[Method]:
    """Return every method that finds lights, and the paper's pair for its normals."""
    pairs = [method for method in select.every_method(models) if method.paper == "B1" or method.second]
    return [*select.lighting_rows(models), *pairs, *select.classical_rows(calibrated=False)]


def build_tables(
    bench: Benchmark, items: Sequence[TestObject], found: suite.Found, chosen: Sequence[Method]
) -> list[Table]:
    """Return the tables of directions and intensities."""
    lights = suite.lighting_only(found, chosen)
    common: dict[str, Any] = {"present": [item.name for item in items], "known": bench.known}
    return [
        object_table(f"{bench.title}, light directions, degrees", lights, "direction_mae",
                     published=bench.directions, digits=2, **common),
        object_table(f"{bench.title}, light intensities, relative error", lights, "intensity_error",
                     published=bench.intensities, digits=3, **common),
    ]  # fmt: skip


def definition(bench: Benchmark, items: Sequence[TestObject], args: argparse.Namespace) -> str:
    """Say what the numbers are of."""
    images = ", ".join(f"{item.name} {len(item.true_directions)}" for item in items)
    size = f", crops averaged down to {args.longest_side} pixels" if args.longest_side else ""
    return (
        f"{bench.title}: images of {images}; {bench.about(args)}; cropped to the mask's box with 15 pixels of margin, "
        f"times the mask{size}. Directions: mean angular error in degrees over images. Intensities: truth divided per "
        "channel by the first image's, one least-squares scale, mean relative error. No true normals exist; "
        f"the {CONSTANT} predictor sees nothing. A dash: not in the folder or not printed."
    )
