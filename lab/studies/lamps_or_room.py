"""How often `auto` recognises light that is not a single lamp: rendered scenes under lamps, in rooms, in surroundings.

    python -m lab.studies.lamps_or_room DATA
    python -m lab.studies.lamps_or_room DATA --models OUT --scenes 20 --photographs DiLiGenT/pmsData

The scenes are those of `lab.studies.any_light_study`, which no network has seen. Photographs of real objects under one
lamp at a time are looked at as they are, and mixed (`lab.studies.mixed_photographs`). Flat discs under lamps
(`lab.studies.flat_study`), which no network was trained on, are often mistaken for light from many sides.
"""

import argparse
import sys
from collections.abc import Iterator, Sequence
from itertools import product
from pathlib import Path

import numpy as np

from lab.studies import flat_study, mixed_photographs
from lab.studies.any_light_study import LIGHTS, choose, photograph, unpack
from pipelines.evaluate.benchmarks.diligent import DiligentConfig, diligent_objects
from pipelines.shared.text_tables import render_text
from sdps.data.scene_store import SceneStore, list_finished
from sdps.methods import pretrained
from sdps.methods.light_witness import ROOM, measure_spread

COUNTS = (4, 8, 16)
_SIDE, _DISC = 128, 0.9
"""Pixels of a disc's side, and its squared radius in half sides."""
_SHARES = (0.0, 0.5, 1.0)
"""Of the scenes, in order of what is told, whose values are shown."""


def tell_scenes(data: Path, light: str, scenes: int, models: Path | None) -> Iterator[list[float]]:
    """Yield what is told of each scene under a kind of light, for each number of images."""
    find, store = pretrained.finder(models), SceneStore(data, cache=False)
    for scene in choose(list_finished(data, "val", skip_missing=True), light, scenes):
        images, mask, _, _ = unpack(scene, photograph(scene, store, light))
        yield [measure_spread(images[:count], mask, find) for count in COUNTS]


def tell_photographs(data: Path, light: str, models: Path | None) -> Iterator[list[float]]:
    """Yield what is told of each real object, its photographs single or mixed."""
    find = pretrained.finder(models)
    for item in diligent_objects(data, DiligentConfig()):
        images = mixed_photographs.read_all(item)
        mixed = (mixed_photographs.mix(images, count, mixed_photographs.MIXED[light], item.name) for count in COUNTS)
        yield [measure_spread(each, item.mask, find) for each in mixed]


def tell_discs(models: Path | None) -> Iterator[list[float]]:
    """Yield what is told of each flat thing under lamps, cut out as a disc."""
    find, (x, y) = pretrained.finder(models), np.meshgrid(*2 * [np.linspace(-1.0, 1.0, _SIDE)])
    for kind, lamps in product(flat_study.KINDS, flat_study.LAMPS.values()):
        images = flat_study.photograph(kind, _SIDE, max(COUNTS), **lamps).images
        yield [measure_spread(images[:count], x**2 + y**2 < _DISC, find) for count in COUNTS]


def tabulate(light: str, told: Sequence[Sequence[float]]) -> list[list[str]]:
    """Return a row for each number of images: how many count as lit from many sides, and what is told of all."""
    rows = []
    for count, values in zip(COUNTS, np.reshape(told, (-1, len(COUNTS))).T, strict=True):
        shown = " ".join(f"{each:.2f}" for each in np.quantile(values, _SHARES)) if len(values) else "-"
        rows.append([light, str(count), f"{(values >= ROOM).sum()} of {len(values)}", shown])
    return rows


def main(arguments: Sequence[str] | None = None) -> int:
    """Ask, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("data", type=Path)
    parser.add_argument("--models", type=Path, default=None, help="folder of trained runs (default: shipped weights)")
    parser.add_argument("--scenes", type=int, default=20)
    parser.add_argument("--photographs", type=Path, default=None)
    args = parser.parse_args(arguments)
    lines = []
    for light in LIGHTS:
        lines += tabulate(light, list(tell_scenes(args.data, light, args.scenes, args.models)))
    lines += tabulate("flat discs, lamps", list(tell_discs(args.models)))
    for light in mixed_photographs.MIXED if args.photographs else ():
        lines += tabulate(f"real, {light}", list(tell_photographs(args.photographs, light, args.models)))
    head = ["light", "images", "not lamps", "least, median and largest variance"]
    sys.stdout.write(render_text("Variance of the directions of light, as a network tells it", head, lines))
    return 0


if __name__ == "__main__":
    sys.exit(main())
