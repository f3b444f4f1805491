"""`sdps regenerate`: test scenes of chosen shapes, materials and lights."""

import argparse
import sys
from dataclasses import replace
from pathlib import Path

from pipelines import presets, scenes
from pipelines.render_data import render_planned
from render.errors import InputError


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the flags of `sdps regenerate`; what they leave open comes from the preset's `test` section."""
    parser.add_argument("--shapes", action="append", help="sphere, bunny, blobby:7, a mesh file, ...; commas or repeat")
    parser.add_argument("--materials", action="append", help="names, categories, all, lambertian:0.5, YAML files")
    parser.add_argument("--lights", action="append", help="merltest, diligent, biased:64, or a file of directions")
    presets.add_common_arguments(parser)


def main(args: argparse.Namespace) -> int:
    """Render the scenes and a contact sheet of them."""
    preset, _ = presets.from_arguments(args)
    lights = split_list(args.lights) or [preset.test.lights]
    if len(lights) != 1:
        raise InputError(f"--lights: name one light set per run, got {', '.join(lights)}")
    test = replace(
        preset.test,
        shapes=tuple(split_list(args.shapes)) or preset.test.shapes,
        materials=tuple(split_list(args.materials)) or preset.test.materials,
        lights=lights[0],
    )
    wanted = scenes.test_scenes(test)
    folder = Path(args.out or "out/regenerated")
    rendered = render_planned(wanted, folder, replace(preset, test=test))
    sys.stdout.write(
        f"{folder}: {len(wanted)} scenes x {len(wanted[0].lights)} lights; {rendered} rendered now; see preview.png\n"
    )
    return 0


def split_list(values: list[str] | None) -> list[str]:
    """Flatten a flag that may be repeated and may hold commas."""
    return [item.strip() for value in values or [] for item in value.split(",") if item.strip()]
