"""Errors of methods on the rendered scenes of refinement's study, with lights all around and near the camera only.

    python -m lab.studies.study_errors --methods shipped:lightset,shipped:sdps-frames,true+shipped:frames --every 3

Scenes are those of refinement_study.py, rendered where they are not yet. Test-time augmentation of lights is
eight-fold, that of normals the method's own. Methods trained in a folder are found with --models.
"""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from lab.studies.refinement_study import PRESET, Scene, render_scenes
from render.records.manifest import read_manifest
from render.shared.errors import InputError
from sdps.inference.inference_config import InferenceConfig
from sdps.methods.parse import parse
from sdps.methods.pretrained import finder
from sdps.methods.runner import Runner

_METRICS = ("direction_mae", "intensity_error", "normal_mae")


def main(argv: Sequence[str] | None = None) -> int:
    """Print a line for every method and kind of lights."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--methods", required=True, help="as for `sdps eval-diligent`, with commas between them")
    parser.add_argument("--out", type=Path, default=Path("out/refinement"), help="folder of the study")
    parser.add_argument("--models", type=Path, help="folder of runs whose weights come before the pretrained ones")
    parser.add_argument("--every", type=int, default=1, help="take every so many scenes")
    args = parser.parse_args(argv)
    folder = render_scenes(PRESET, args.out / "scenes")
    specs, find = read_manifest(folder)[:: args.every], finder(args.models)
    for name in args.methods.split(","):
        runner = Runner(parse(name, find), find, InferenceConfig(light_views=8))
        for narrow in (False, True):
            scores = [_scores(Scene(folder, spec, narrow, 0, False), runner) for spec in specs]
            means = ", ".join(f"{metric} {np.mean([each[metric] for each in scores]):.3f}" for metric in scores[0])
            sys.stdout.write(f"{name}, lights {'near the camera' if narrow else 'all around'}: {means}\n")
            sys.stdout.flush()
    return 0


def _scores(scene: Scene, runner: Runner) -> dict[str, float]:
    """Return what the method got wrong of what it estimated, and the error it expected of its light directions."""
    found = runner.estimate(scene.images, scene.mask, scene.lights, scene.gains, {})
    scores = runner.score(found, scene.mask, scene.normals, scene.lights, scene.gains)
    kept = {metric: scores[metric] for metric in _METRICS if metric in scores}
    expected = found.expected_light_error
    return kept if expected is None else kept | {"expected_light_error": float(np.mean(expected))}


if __name__ == "__main__":
    try:
        sys.exit(main())
    except InputError as error:
        sys.exit(f"error: {error}")
