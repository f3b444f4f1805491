"""Normals under any light: distant lamps, near ones, lamps in a room, and surroundings alone; few images and more.

    python -m lab.studies.any_light_study DATA out/any-light --models OUT --scenes 10
    python -m lab.studies.any_light_study DATA out/any-light --models OUT

The scenes are those of split `val` of a data folder (preset `anylight`), whose shapes and materials no network has
seen. A camera records every image; images are mixed as in training (`render.shared.imaging.scene_mixing`). All methods
see the same images, the first ones of 16, and are told the focal length. Rows are kept in the folder, so that a run
that was stopped goes on.
"""

import argparse
import json
import sys
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path

import numpy as np

from pipelines.shared.text_tables import render_text
from render.records.manifest import SceneSpec
from render.shared.errors import InputError
from render.shared.imaging.mixing import LightStage
from render.shared.imaging.scene_mixing import SceneMix
from render.shared.imaging.sensor import SensorModel
from render.shared.seeds import generator, spread_evenly
from sdps.api import estimate
from sdps.core.geometry import Camera
from sdps.core.metrics import angle_degrees
from sdps.data.augment import Augmentation
from sdps.data.dataset import Batch, SampleOptions, make_sample
from sdps.data.scene_store import SceneStore, list_finished

LIGHTS = {
    "distant lamps": SceneMix(sparse=True, single=1.0),
    "near lamps": SceneMix(sparse=True, single=1.0),
    "lamps and room": SceneMix(sparse=True, steady=1.0),
    "surroundings": SceneMix(sparse=True, surrounded=1.0),
}
COUNTS = (4, 8, 16)
METHODS = ("anylight", "anylight+refine", "sdps-frames", "sdps-frames+fuse", "pf14")
_SIDE, _ROWS = 128, "rows.jsonl"
_WIDEST = 50.0
"""Degrees from any direction to the nearest light in scenes that surroundings are mixed from."""


@dataclass(frozen=True)
class Row:
    """The mean error of a method's normals in degrees; None where it refused the images."""

    light: str
    scene: str
    images: int
    method: str
    error: float | None


def choose(scenes: Sequence[SceneSpec], light: str, count: int) -> list[SceneSpec]:
    """Return so many scenes, evenly spread: with near lamps or distant ones, or lit from all around to be mixed."""
    wanted = {"distant lamps": False, "near lamps": True}.get(light)

    def fits(scene: SceneSpec) -> bool:
        if wanted is None:
            return LightStage(scene.light_directions(), scene.id, sparse=True).gap <= _WIDEST
        return (scene.light_positions() is not None) == wanted

    fit = [scene for scene in scenes if fits(scene)]
    return spread_evenly(fit, count)


def photograph(scene: SceneSpec, store: SceneStore, light: str) -> Batch:
    """Return a scene under a kind of light, its images of random exposure, as a camera records them."""
    augmentation = Augmentation(noise=0.0, sensor=SensorModel(), mixed=LIGHTS[light])
    options = SampleOptions(seed=0, images=max(COUNTS), size=_SIDE, augmentation=augmentation)
    return make_sample(scene, store.load(scene), options, generator(0, "any-light", light, scene.id))


def unpack(scene: SceneSpec, sample: Batch) -> tuple[np.ndarray, np.ndarray, np.ndarray, Camera]:
    """Return images (L, H, W, 3), mask (H, W) bool, true normals (H, W, 3) and the camera of what `photograph` gave."""
    mask, truth = sample.mask[0].numpy() > 0.5, sample.normals.numpy().transpose(1, 2, 0)
    images, lens = np.ascontiguousarray(sample.images.numpy().transpose(0, 2, 3, 1)), scene.view.camera_distance
    return images, mask, truth, Camera(lens * mask.shape[1] / 2) if lens else Camera()


def measure_scene(
    scene: SceneSpec, sample: Batch, light: str, methods: Sequence[str], models: Path | None
) -> Iterator[Row]:
    """Yield the errors of methods that see some of a rendered scene's images, and all."""
    images, mask, truth, camera = unpack(scene, sample)
    for count in COUNTS:
        for method in methods:
            error = measure(images[:count], mask, truth, method, camera=camera, models=models)
            yield Row(light, scene.id, count, method, error)


def measure(
    images: np.ndarray, mask: np.ndarray, truth: np.ndarray, method: str, *, camera: Camera, models: Path | None
) -> float | None:
    """Return the mean error of a method's normals in degrees; None where it refuses the images, which it says.

    Args:
        images: (L, H, W, 3), linear radiance.
        mask: (H, W) bool.
        truth: (H, W, 3), unit normals.
        method, camera, models: As of `sdps.estimate`.
    """
    try:
        found = estimate(images, mask, method, camera=camera, models=models).normals[mask]
    except InputError as reason:  # too few images for a method
        sys.stderr.write(f"{method}, {len(images)} images: {reason}\n")
        return None
    return round(float(angle_degrees(found, truth[mask]).mean()), 3)


def summarise(
    rows: Sequence[Row], methods: Sequence[str], lights: Iterable[str] = LIGHTS, counts: Sequence[int] = COUNTS
) -> str:
    """Return the mean errors by light, number of images and method."""
    lines = []
    for light, count in product(lights, counts):
        some = [row for row in rows if (row.light, row.images) == (light, count)]
        errors = [[row.error for row in some if row.method == method and row.error is not None] for method in methods]
        cells = [f"{np.mean(each):.2f}" if each else "-" for each in errors]
        lines.append([light, str(count), str(len({row.scene for row in some})), *cells])
    return render_text("Mean error of the normals, degrees", ["light", "images", "scenes", *methods], lines)


def read_rows(folder: Path) -> list[Row]:
    """Return the rows that were kept in a folder, which is made where there is none."""
    folder.mkdir(parents=True, exist_ok=True)
    file = folder / _ROWS
    return [Row(**json.loads(line)) for line in file.read_text(encoding="utf-8").splitlines()] if file.exists() else []


def list_missing(rows: Sequence[Row], light: str, scene: str, images: int, methods: Sequence[str]) -> list[str]:
    """Return the methods that have no row yet of a scene under a light with so many images."""
    done = {row.method for row in rows if (row.light, row.scene, row.images) == (light, scene, images)}
    return [method for method in methods if method not in done]


def keep_rows(folder: Path, rows: Sequence[Row]) -> None:
    """Add rows to those of a folder, and say them."""
    with (folder / _ROWS).open("a", encoding="utf-8") as out:
        out.writelines(json.dumps(vars(row)) + "\n" for row in rows)
    for light, scene in dict.fromkeys((row.light, row.scene) for row in rows):
        said = [row.error for row in rows if (row.light, row.scene) == (light, scene)]
        sys.stdout.write(f"{light}, {scene}: {said}\n")
    sys.stdout.flush()


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure, a scene at a time, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("data", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--models", type=Path, default=None, help="folder of trained runs (default: shipped weights)")
    parser.add_argument("--scenes", type=int, default=40)
    parser.add_argument("--methods", nargs="+", default=METHODS)
    args = parser.parse_args(arguments)
    rows = read_rows(args.out)
    scenes, store = list_finished(args.data, "val", skip_missing=True), SceneStore(args.data, cache=False)
    chosen = {light: choose(scenes, light, args.scenes) for light in LIGHTS}
    wanted = [(light, scene) for number in range(args.scenes) for light in LIGHTS
              for scene in chosen[light][number : number + 1]]  # fmt: skip
    for light, scene in wanted:
        if missing := list_missing(rows, light, scene.id, COUNTS[-1], args.methods):
            new = list(measure_scene(scene, photograph(scene, store, light), light, missing, args.models))
            rows += new
            keep_rows(args.out, new)
    kept = {(light, scene.id) for light, scene in wanted}
    sys.stdout.write(summarise([row for row in rows if (row.light, row.scene) in kept], args.methods))
    return 0


if __name__ == "__main__":
    sys.exit(main())
