"""Make what the fusion network learns from: rendered scenes, answered by networks and by refinement.

    python -m lab.releases.fusion_data out/fusion

renders the scenes of `lab/presets/fusion_world.yaml` and `fusion_ship.yaml` and answers them; `--part 0/2` answers
every second one. Each becomes a file with the evidence, the truth and how far lights were off. What is there stays, so
a run that was stopped goes on. A scene has 4 to 48 photographs of random intensities, by one of the training's cameras.
"""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from tqdm import tqdm

from lab.shared.answered_scenes import answer, keep, make_runner
from lab.shared.scene_parts import add_part
from lab.studies.refinement_study import render_scenes
from render.records.manifest import SceneSpec, read_manifest
from render.records.shards import read_shard
from render.shared.imaging.sensor import SensorModel
from render.shared.seeds import generator
from sdps.core.geometry import ORTHOGRAPHIC, Camera, Rig
from sdps.data.augment import exposure_scale
from sdps.data.sample_geometry import lay_out, place
from sdps.refinement.refine import RefineConfig

PRESETS = tuple(Path(__file__).parents[1] / "presets" / f"fusion_{name}.yaml" for name in ("ship", "world"))
_COUNTS, _SHARES = ((4, 12), (12, 32), (48, 48)), (0.3, 0.5, 0.2)
"""Numbers of photographs, evenly over their logarithm, and how often."""
_LENS_KNOWN, _LIT = 0.75, 0.15
_QUICK = RefineConfig(coarse_pixels=1200, iterations=500, iterations_before=200, fine_iterations=80)
_METERED = 0.3  # mean of the object's pixels at 0 stops, as in training
_SATURATED = 0.995  # a little is off where the black level is
_CAMERAS = SensorModel(stops=(-4.0, 1.0), black_error=(-8.0, 8.0))


class Photographs:
    """A rendered scene as somebody photographs it.

    Args:
        folder: Of the scenes.
        spec: The scene.
    """

    def __init__(self, folder: Path, spec: SceneSpec) -> None:
        shard, rng = read_shard(folder / spec.file, spec), generator(11, spec.id, "fusion")
        lights = shard.light_directions
        low, high = _COUNTS[rng.choice(len(_COUNTS), p=_SHARES)]
        count = round(float(np.exp(rng.uniform(np.log(low), np.log(min(high, len(lights)))))))
        chosen = np.sort(rng.permutation(len(lights))[:count])
        self.mask, self.normals = shard.mask, shard.normals
        layout = lay_out(spec, shard.depth, shard.mask, chosen)
        self.placed = place(layout, shard.mask, lights[chosen])
        gains = rng.uniform(0.3, 2.0, count).astype(np.float32)
        radiance = shard.images[chosen].astype(np.float32) * shard.mask[..., None] * gains[:, None, None, None]
        radiance *= exposure_scale(radiance[:, shard.mask], _METERED, 1.0)
        self.images = np.minimum(_CAMERAS.draw(rng).record(radiance, rng), 1.0)
        self.gains = gains * self.placed.irradiance
        lens = spec.view.camera_distance
        known = lens is not None and rng.random() < _LENS_KNOWN
        camera = Camera(lens * shard.mask.shape[1] / 2) if known else ORTHOGRAPHIC
        self.lit = bool(rng.random() < _LIT)
        self.rig = Rig(camera, self.placed.nearness if self.lit and self.placed.nearness.any() else None)


def main(arguments: Sequence[str] | None = None) -> int:
    """Render and answer."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    add_part(parser)
    parser.add_argument("--models", type=Path, help="folder of runs with networks to take before the shipped ones")
    parser.add_argument("--networks", default="sdps-frames+refine,true+frames+refine", help="without and with lights")
    args = parser.parse_args(arguments)
    rendered = [render_scenes(preset, args.out / preset.stem) for preset in PRESETS]
    scenes = [(folder, spec) for folder in rendered for spec in read_manifest(folder)]
    unlit, lit = (make_runner(text, args.models, _QUICK) for text in args.networks.split(","))
    for folder, spec in tqdm(args.part.take(scenes), disable=None, miniters=1):
        path = args.out / "answers" / f"{spec.id.replace('/', '_')}.npz"
        if path.exists():
            continue
        shown = Photographs(folder, spec)
        runner, lights, gains = (lit, shown.placed.directions, shown.gains) if shown.lit else (unlit, None, None)
        answered = answer(runner, shown.images, shown.mask, lights, gains, _SATURATED, shown.rig)
        held_out = spec.split == "val"
        keep(path, answered, shown.normals, shown.placed.directions, held_out=held_out, lit=shown.lit)
    return 0


if __name__ == "__main__":
    sys.exit(main())
