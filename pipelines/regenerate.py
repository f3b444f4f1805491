"""`sdps regenerate`: test scenes of chosen shapes, materials and lights."""

import argparse
import sys
from pathlib import Path

from pipelines import scenes
from pipelines.render_data import render_planned
from render.errors import InputError


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the flags of `sdps regenerate`."""
    parser.add_argument("--shapes", action="append", help="sphere, bunny, blobby:7, a mesh file ... (default: both)")
    parser.add_argument("--materials", action="append", help="names, categories, `all`, lambertian:0.5, YAML files")
    parser.add_argument("--lights", action="append", help="merltest, diligent, or a file of directions")
    parser.add_argument("--out", default="out/regenerated", help="output folder (default: out/regenerated)")
    parser.add_argument("--size", type=int, default=128, help="image side in pixels (default: 128)")
    parser.add_argument("--spp", type=int, default=64, help="samples per pixel (default: 64)")
    parser.add_argument("--bounces", type=int, default=2, help="interreflection bounces (default: 2)")
    parser.add_argument("--scale", type=float, default=0.95, help="radius in half image widths (default: 0.95)")
    parser.add_argument("--seed", type=int, default=0, help="sampler seed (default: 0)")


def main(args: argparse.Namespace) -> int:
    """Render the scenes and a contact sheet of them."""
    if args.size < 16 or args.spp < 1 or not 0 <= args.bounces <= 16 or args.seed < 0:
        raise InputError("--size must be at least 16, --spp at least 1, --bounces in 0..16, --seed not negative")
    lights = split_list(args.lights) or ["merltest"]
    if len(lights) != 1:
        raise InputError(f"--lights: name one light set per run, got {', '.join(lights)}")
    wanted = scenes.grid(
        split_list(args.shapes) or ["sphere", "bunny"], split_list(args.materials) or ["all"], lights[0],
        size=args.size, spp=args.spp, bounces=args.bounces, seed=args.seed, scale=args.scale,
    )  # fmt: skip
    folder = Path(args.out)
    rendered = render_planned(wanted, folder)
    sys.stdout.write(
        f"{folder}: {len(wanted)} scenes x {len(wanted[0].lights)} lights; {rendered} rendered now; see preview.png\n"
    )
    return 0


def split_list(values: list[str] | None) -> list[str]:
    """Flatten a flag that may be repeated and may hold commas."""
    return [item.strip() for value in values or [] for item in value.split(",") if item.strip()]
