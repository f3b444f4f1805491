"""Errors of methods on the rendered scenes of refinement's study, with lights all around and near the camera only.

    python docs/scripts/study_errors.py --methods shipped:lightset,shipped:sdps-frames,true+shipped:frames --every 3

Scenes are those of refinement_study.py, rendered where they are not yet. Lights are averaged over eight views, normals
over as many as the method has. Methods trained in a folder are found with --models.
"""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from refinement_study import Scene, rendered

from render.records.manifest import read_manifest
from render.shared.errors import InputError
from sdps.core.metrics import angle_degrees, intensity_error
from sdps.inference.inference_config import InferenceConfig
from sdps.methods.parse import parse
from sdps.methods.pretrained import finder
from sdps.methods.runner import Runner


def main(argv: Sequence[str] | None = None) -> int:
    """Print a line for every method and kind of lights."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--methods", required=True, help="as for `sdps eval-diligent`, with commas between them")
    parser.add_argument("--out", type=Path, default=Path("out/refinement"), help="folder of the study")
    parser.add_argument("--models", type=Path, help="folder of runs whose weights come before the shipped ones")
    parser.add_argument("--every", type=int, default=1, help="take every so many scenes")
    args = parser.parse_args(argv)
    folder = rendered(args.out / "scenes")
    specs, find = read_manifest(folder)[:: args.every], finder(args.models)
    sys.stdout.write(
        "method, lights, scenes: directions, intensities, normals, expected error of directions (degrees)\n"
    )
    for name in args.methods.split(","):
        runner = Runner(parse(name, find), find, InferenceConfig(light_views=8))
        for narrow in (False, True):
            found = [_errors(Scene(folder, spec, narrow, 0, False), runner) for spec in specs]
            means = "  ".join(f"{value:.3f}" for value in np.mean(found, axis=0))
            sys.stdout.write(f"{name}, {'narrow' if narrow else 'all around'}, {len(found)}: {means}\n")
            sys.stdout.flush()
    return 0


def _errors(scene: Scene, runner: Runner) -> tuple[float, float, float, float]:
    """Return the errors of directions, intensities and normals, and the one expected of directions; nan: not told."""
    found = runner.estimate(scene.images, scene.mask, scene.lights, scene.gains, {})
    directions = gains = normals = np.nan
    if found.light_directions.size:
        directions = float(angle_degrees(found.light_directions, scene.lights).mean())
    if found.intensities.size:
        gains = intensity_error(found.intensities, scene.gains)
    if found.normals.size:
        normals = float(angle_degrees(found.normals[scene.mask], scene.normals[scene.mask]).mean())
    return directions, gains, normals, float(np.mean(found.diagnostics.get("expected_light_error", np.nan)))


if __name__ == "__main__":
    try:
        sys.exit(main())
    except InputError as error:
        sys.exit(f"error: {error}")
