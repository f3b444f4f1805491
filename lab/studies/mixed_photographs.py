"""Normals of real objects whose photographs are mixed: several lamps at once, a true test of mixed light.

    python -m lab.studies.mixed_photographs DiLiGenT/pmsData out/mixed
    python -m lab.studies.mixed_photographs DiLiGenT/pmsData out/mixed --models OUT --methods anylight sdps-frames

Light adds up, so a weighted mean of photographs is the photograph under their lamps together. Each mixed picture is of
so many photographs, drawn by chance, with strengths of their own; of single ones, the pictures are those that
`sdps evaluate diligent --images` draws. Rows are kept in the folder, so that a run that was stopped goes on.
"""

import argparse
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from lab.studies.any_light_study import METHODS, Row, keep_rows, list_missing, measure, read_rows, summarise
from pipelines.evaluate.benchmarks.diligent import DiligentConfig, diligent_objects
from pipelines.evaluate.evaluation import TestObject
from render.shared.seeds import generator
from sdps.core.geometry import Camera

MIXED = {"single": 1, "pairs": 2, "triples": 3}
COUNTS = (8, 16, 96)
_STRENGTHS = (0.5, 1.5)
_FOCAL = 3772.0


def mix(images: np.ndarray, count: int, together: int, name: str) -> np.ndarray:
    """Return `count` pictures (count, H, W, 3) float32, each of so many of the images (L, H, W, 3) together."""
    rng = generator(0, name, "images" if together == 1 else f"mixed {together}")
    if together == 1:
        return images[np.sort(rng.permutation(len(images))[:count])]
    found = np.empty((count, *images.shape[1:]), np.float32)
    for number in range(count):
        chosen = rng.choice(len(images), together, replace=False)
        strengths = rng.uniform(*_STRENGTHS, together).astype(np.float32)
        found[number] = np.tensordot(strengths / together, images[chosen], axes=1)
    return found


def read_all(item: TestObject) -> np.ndarray:
    """Return all images (L, H, W, 3) of an object."""
    source = item.load()
    return np.asarray(source[0 : len(source)])


def measure_object(
    item: TestObject, images: np.ndarray, light: str, methods: Sequence[str], models: Path | None
) -> Iterator[Row]:
    """Yield the errors of methods on an object, its images (L, H, W, 3) under a kind of light, all numbers of them."""
    assert item.normals is not None
    for count in COUNTS:
        seen = mix(images, min(count, len(images)), MIXED[light], item.name)
        for method in methods:
            error = measure(seen, item.mask, item.normals, method, camera=item.camera or Camera(), models=models)
            yield Row(light, item.name, count, method, error)


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure, an object at a time, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("data", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--models", type=Path, default=None, help="folder of trained runs (default: shipped weights)")
    parser.add_argument("--methods", nargs="+", default=METHODS)
    args = parser.parse_args(arguments)
    rows = read_rows(args.out)
    for item in diligent_objects(args.data, DiligentConfig(focal=_FOCAL)):
        images: np.ndarray | None = None
        for light in MIXED:
            if missing := list_missing(rows, light, item.name, COUNTS[-1], args.methods):
                images = read_all(item) if images is None else images
                new = list(measure_object(item, images, light, missing, args.models))
                rows += new
                keep_rows(args.out, new)
    sys.stdout.write(summarise(rows, args.methods, MIXED, COUNTS))
    return 0


if __name__ == "__main__":
    sys.exit(main())
