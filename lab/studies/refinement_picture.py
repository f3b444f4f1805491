"""Draw a photograph, and normals and their errors before and after refinement.

    python -m lab.studies.refinement_picture --merltest out/merl/merltest

The folder is one that `sdps evaluate merltest` rendered. Scenes are refined where that has not been done yet.
"""

import argparse
import sys
from pathlib import Path

import numpy as np
from PIL import Image

from lab.studies.refinement_study import Scene, expect_errors, refine_scene
from pipelines.shared import pictures
from render.records.manifest import read_manifest
from sdps.core.metrics import angle_degrees

SCENES = ("bunny-blue-acrylic", "bunny-black-fabric", "bunny-chrome", "sphere-black-obsidian")
_YELLOW, _SIDE = 20.0, 220  # degrees; pixels of a tile


def main() -> int:
    """Draw one row a scene."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("out/refinement"), help="folder where answers are kept")
    parser.add_argument("--start", default="sdps-frames", help="method to start from")
    parser.add_argument("--merltest", type=Path, required=True)
    parser.add_argument("--scenes", nargs="+", default=SCENES, help="names in the folder's manifest")
    parser.add_argument("--picture", type=Path, default=Path("docs/images/refinement.jpg"))
    args = parser.parse_args()
    specs = {spec.id: spec for spec in read_manifest(args.merltest)}
    rows = []
    for name in args.scenes:
        scene = Scene(args.merltest, specs[name], False, 0, True)
        begun, found = refine_scene(scene, args.out / f"merltest-all-{args.start}", args.start, False, 0.0)
        lit = scene.images[int(np.argmax(scene.lights @ np.array([-0.4, 0.5, 0.77])))]
        maps = [
            pictures.tone_map(lit, pictures.auto_exposure(lit[None], scene.mask)),
            pictures.normal_map(begun.normals, scene.mask), _errors(scene, begun.normals),
            pictures.normal_map(found.normals, scene.mask), _errors(scene, found.normals),
            pictures.error_map(np.where(scene.mask, expect_errors(scene, begun, found).normals, np.nan), _YELLOW),
        ]  # fmt: skip
        rows.append(np.concatenate([pictures.scale_to_height(part, _SIDE) for part in maps], axis=1))
    Image.fromarray(np.concatenate(rows)).save(args.picture, quality=88)
    return 0


def _errors(scene: Scene, normals: np.ndarray) -> np.ndarray:  # (H, W, 3) uint8
    return pictures.error_map(np.where(scene.mask, angle_degrees(normals, scene.normals), np.nan), _YELLOW)


if __name__ == "__main__":
    sys.exit(main())
