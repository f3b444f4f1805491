"""Repeat the figures of joined answers in docs/studies/refinement.md, on rendered scenes.

    python -m lab.studies.fusion_study out/study                                   # shapes no network was trained on
    python -m lab.studies.fusion_study out/study --images 4 8 16 32 --every 3
    python -m lab.studies.fusion_study out/sphere --merltest out/sphere/merltest --every 10
    python -m lab.studies.fusion_study out/study --lights

Answers are kept in the folder, so a run that was stopped goes on. `--method` names another method, `--models` a folder
of runs whose networks it takes before the shipped ones, `--weights` another file than the shipped one that joins.
"""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from tqdm import tqdm

from lab.shared.answered_scenes import answer, keep, read_all, tabulate
from lab.studies.refinement_study import PRESET, Scene, render_scenes
from render.records.manifest import read_manifest
from sdps.inference.inference_config import InferenceConfig
from sdps.methods.fusion.fuse import WEIGHTS, load_fusion
from sdps.methods.parse import parse
from sdps.methods.pretrained import finder
from sdps.methods.runner import Runner


def main(arguments: Sequence[str] | None = None) -> int:
    """Answer, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("--images", type=int, nargs="+", default=[0], help="of each scene (default: all)")
    parser.add_argument("--lights", action="store_true", help="lights are given")
    parser.add_argument("--every", type=int, default=1, help="take every so many scenes")
    parser.add_argument("--part", default="0/1", metavar="K/N", help="of these every N-th, from the K-th on")
    parser.add_argument("--merltest", type=Path, help="folder with the scenes of `sdps evaluate merltest`")
    parser.add_argument("--method", default="", help="such as lightset+frames+refine")
    parser.add_argument("--models", type=Path, help="folder of runs")
    parser.add_argument("--weights", type=Path, default=WEIGHTS, help="that join")
    args = parser.parse_args(arguments)
    folder = args.merltest or render_scenes(PRESET, args.out / "scenes")
    find = finder(args.models)
    method = args.method or ("true+frames+refine" if args.lights else "sdps-frames+refine")
    runner = Runner(parse(method, find), find, InferenceConfig(light_views=8, normal_views=8))
    first, parts = (int(word) for word in args.part.split("/"))
    groups = {}
    for images in args.images:
        place = args.out / f"{method}-{images or 'all'}{'-merltest' if args.merltest else ''}"
        for number, spec in tqdm(list(enumerate(read_manifest(folder)))[:: args.every][first::parts], disable=None):
            file = place / f"{spec.id.replace('/', '_')}.npz"
            if file.exists():
                continue
            narrow = not args.merltest and number % 2 == 1
            scene = Scene(folder, spec, narrow, images, args.merltest is not None)
            given = (scene.lights, scene.gains) if args.lights else (None, None)
            keep(file, answer(runner, scene.images, scene.mask, *given), scene.normals, scene.lights, held_out=True)
        groups[f"{images or 'all'} images"] = read_all(place)
    for line in tabulate(groups, load_fusion(args.weights)):
        sys.stdout.write(line)
    return 0


if __name__ == "__main__":
    sys.exit(main())
