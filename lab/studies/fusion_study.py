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

from lab.shared.answered_scenes import answer, keep, make_runner, read_all, tabulate
from lab.shared.scene_parts import add_part
from lab.studies.refinement_study import PRESET, Scene, render_scenes
from render.records.manifest import read_manifest
from sdps.methods.fusion.fuse import WEIGHTS, load_fusion


def main(arguments: Sequence[str] | None = None) -> int:
    """Answer, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("--images", type=int, nargs="+", default=[0], help="of each scene (default: all)")
    parser.add_argument("--lights", action="store_true", help="lights are given")
    parser.add_argument("--every", type=int, default=1, help="take every so many scenes")
    add_part(parser)
    parser.add_argument("--merltest", type=Path, help="folder with the scenes of `sdps evaluate merltest`")
    parser.add_argument("--method", default="", help="such as lightset+frames+refine")
    parser.add_argument("--models", type=Path, help="folder of runs")
    parser.add_argument("--weights", type=Path, default=WEIGHTS, help="that join")
    args = parser.parse_args(arguments)
    folder = args.merltest or render_scenes(PRESET, args.out / "scenes")
    method = args.method or ("true+frames+refine" if args.lights else "sdps-frames+refine")
    runner = make_runner(method, args.models)
    groups = {}
    for images in args.images:
        place = args.out / f"{method}-{images or 'all'}{'-merltest' if args.merltest else ''}"
        for number, spec in tqdm(args.part.take(list(enumerate(read_manifest(folder)))[:: args.every]), disable=None):
            file = place / f"{spec.id.replace('/', '_')}.npz"
            if file.exists():
                continue
            narrow = not args.merltest and number % 2 == 1
            scene = Scene(folder, spec, narrow, images, args.merltest is not None)
            given = (scene.lights, scene.gains) if args.lights else (None, None)
            answered = answer(runner, scene.images, scene.mask, *given)
            keep(file, answered, scene.normals, scene.lights, held_out=True, lit=args.lights)
        groups[f"{images or 'all'} images"] = read_all(place)
    for line in tabulate(groups, load_fusion(args.weights)):
        sys.stdout.write(line)
    return 0


if __name__ == "__main__":
    sys.exit(main())
