"""`sdps evaluate gourd-apple` and `light-stage`: lighting estimation on photographs whose lights were measured.

Gourd&Apple (Alldrin et al. 2008) and the Light Stage Data Gallery (Einarsson et al. 2006), as in SDPS-Net's table
"Lighting estimation results on the Gourd&Apple dataset and the Light Stage Data Gallery".
"""

import argparse
from collections.abc import Sequence

from pipelines.evaluate.benchmarks import suite
from pipelines.evaluate.benchmarks.lit_photographs import (
    GOURD_APPLE,
    LIGHT_STAGE,
    gourd_apple_objects,
    light_stage_objects,
)
from pipelines.evaluate.evaluation import TestObject
from render.shared.errors import InputError
from sdps.methods import select
from sdps.methods.method import CONSTANT
from sdps.models.registry import TRUE_LIGHTS

BENCHMARKS = {
    name: suite.Benchmark(name, title, 50, known, (
        (f"{title}, light directions, degrees", "directions", "direction_mae", 2),
        (f"{title}, light intensities, relative error", "intensities", "intensity_error", 3),
    ))
    for name, title, known in (("gourd-apple", "Gourd&Apple", GOURD_APPLE),
                               ("light-stage", "Light Stage Data Gallery", LIGHT_STAGE))
}  # fmt: skip


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the flags of `sdps eval-lights`, the earlier name of both commands."""
    parser.add_argument("--dataset", required=True, choices=tuple(BENCHMARKS), help="which layout the folder has")
    _declare(parser, *BENCHMARKS)


def add_gourd_apple_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the flags of `sdps evaluate gourd-apple`."""
    _declare(parser, "gourd-apple")
    parser.set_defaults(dataset="gourd-apple", least_z=0.0, gamma=1.0)


def add_light_stage_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the flags of `sdps evaluate light-stage`."""
    _declare(parser, "light-stage")
    parser.set_defaults(dataset="light-stage", measured_lights=False)


def _declare(parser: argparse.ArgumentParser, *datasets: str) -> None:
    """Declare the flags of all benchmarks, and those of these data sets."""
    suite.add_arguments(parser)
    add = parser.add_argument
    add("--longest-side", type=int, default=0, metavar="PIXELS",
        help="average larger crops down to this, to save memory (default: 0, never)")  # fmt: skip
    if "gourd-apple" in datasets:
        add("--measured-lights", action="store_true",
            help="gourd-apple: compare with the measured lights, not the refined ones")  # fmt: skip
    if "light-stage" in datasets:
        add("--least-z", type=float, default=0.0, metavar="Z",
            help="light-stage: use images whose light direction has z above it (default: 0)")  # fmt: skip
        add("--gamma", type=float, default=1.0,
            help="light-stage: exponent that makes PNG values linear (default: 1, linear)")  # fmt: skip


def main(args: argparse.Namespace) -> int:
    """Evaluate, print the tables, and write <out>/<dataset>/results.json and the report's section."""
    _check(args)
    bench, chosen = BENCHMARKS[args.dataset], suite.named_methods(args)
    given = next((method for method in chosen if method.lighting == TRUE_LIGHTS), None)
    if given:
        raise InputError(f"--methods: {given.name} is given the lights, so there is nothing to score")
    items, about = read(args)
    items = suite.pick_objects(items, args.objects)
    if not chosen:  # every method that finds lights, and the paper's pair for its normals
        models = select.runs_folder(args.models)
        pairs = [method for method in select.every_method(models) if method.paper == "B1"]
        chosen = [*select.lighting_rows(models), *pairs, *select.classical_rows(calibrated=False)]
    return suite.evaluate(
        bench, args, items, chosen, text=describe(bench, items, about, args.longest_side),
        protocol={name: getattr(args, name) for name in ("measured_lights", "least_z", "gamma", "longest_side")},
        command=f"sdps evaluate {args.dataset} {args.data}",
    )  # fmt: skip


def read(args: argparse.Namespace) -> tuple[list[TestObject], str]:
    """Return the objects of the folder, and what is special to their images in a clause."""
    if args.dataset == "gourd-apple":
        lights = "measured" if args.measured_lights else "refined"
        items = gourd_apple_objects(args.data, refined=not args.measured_lights, longest=args.longest_side)
        return items, f"against the {lights} lights"
    items = light_stage_objects(args.data, least_z=args.least_z, gamma=args.gamma, longest=args.longest_side)
    return items, f"images whose light has z > {args.least_z:g}, PNG values to the power {args.gamma:g}"


def _check(args: argparse.Namespace) -> None:
    if not -1.0 <= args.least_z < 1.0:
        raise InputError(f"--least-z {args.least_z:g}: must be from -1 to below 1")
    if not args.gamma > 0:
        raise InputError(f"--gamma {args.gamma:g}: must be positive")
    if args.longest_side < 0 or 0 < args.longest_side < 16:
        raise InputError(f"--longest-side {args.longest_side}: must be 0 or at least 16 pixels")


def describe(bench: suite.Benchmark, items: Sequence[TestObject], about: str, longest: int) -> str:
    """Say what the numbers are of."""
    images = ", ".join(f"{item.name} {len(item.true_directions)}" for item in items)
    size = f", crops averaged down to {longest} pixels" if longest else ""
    return (
        f"{bench.title}: images of {images}; {about}; cropped to the mask's box with 15 pixels of margin, "
        f"times the mask{size}. Directions: mean angular error in degrees over images. Intensities: truth divided per "
        "channel by the first image's, one least-squares scale, mean relative error. No true normals exist; "
        f"the {CONSTANT} predictor sees nothing. A dash: not in the folder or not printed."
    )
