"""`sdps evaluate uw`: uncalibrated methods on real photographs, against least squares under the measured lights.

There is no ground truth: the error is the mean angle between the normals of a method that finds the lights itself and
those of one that is given them. The published figures of PF14 are in brackets.
"""

import argparse
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from pipelines.evaluate.benchmarks import suite
from pipelines.evaluate.benchmarks.uw_photos import list_objects, read_lights, read_photos, resolve_source
from pipelines.evaluate.evaluation import Found, Result, TestObject
from pipelines.evaluate.object_pictures import ERROR_LIMIT, tiles
from pipelines.evaluate.report.sections import Section, SectionWriter, Table
from pipelines.evaluate.score_tables import cell, mean_of_all, publish
from pipelines.shared.flags import add_models, add_out, pick_names, split_list
from pipelines.shared.pictures import contact_sheet, scale_to_height
from render.shared.errors import InputError
from render.shared.files import atomic_path
from sdps.classical import registry
from sdps.inference.inference_config import InferenceConfig
from sdps.methods.parse import parse
from sdps.methods.pretrained import finder

PUBLISHED = {"pf14": {"rock": 11.61, "buddha": 4.98, "horse": 4.80, "cat": 5.37, "owl": 6.63}}
"""Degrees against calibrated photometric stereo (Favaro & Papadhimitri, CVPR 2012, table 1)."""

DEFINITION = (
    "Mean angle in degrees between a method's normals and those of calibrated photometric stereo, over mask pixels; in "
    f"brackets the published figure. The last column is the mean over objects. Error maps end at {ERROR_LIMIT:g} "
    "degrees."
)
_HEIGHT = 240
_METRICS = ("normal_mae", "normal_median", "direction_mae")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the flags of `sdps evaluate uw`."""
    parser.add_argument("folder", type=Path, help="unpacked photographs: <object>/<object>.<k>.tga and masks")
    parser.add_argument("--objects", action="append", help="commas or repeat (default: all)")
    parser.add_argument("--methods", action="append", metavar="METHOD,LIGHTS+NORMALS,...",
                        help="commas or repeat (default: all uncalibrated classical methods)")  # fmt: skip
    add_models(parser)
    parser.add_argument("--reference", default="least-squares", metavar="METHOD",
                        help="calibrated method to compare with (default: %(default)s)")  # fmt: skip
    parser.add_argument("--lights", default="auto", choices=("auto", "chrome", "file"),
                        help="the reference's: chrome sphere or lights.txt (default: sphere if there)")  # fmt: skip
    add_out(parser, Path("out/photos"))


def main(args: argparse.Namespace) -> int:
    """Compare, print the table, and write results.json and a picture per object into the output folder."""
    names, out = pick_names("object", args.objects, list_objects(args.folder)), args.out
    chosen = split_list(args.methods) or [name for name, entry in registry.METHODS.items() if not entry.calibrated]
    methods = [parse(name, finder(args.models)) for name in chosen]
    if not registry.method(args.reference).calibrated:
        raise InputError(f"--reference {args.reference}: finds the lights itself; choose a calibrated method")
    source = resolve_source(args.folder, args.lights)
    lights = read_lights(args.folder, source)
    items = [add_reference(read_photos(args.folder, name, lights), args.reference) for name in names]
    shown = [method.name for method in methods]
    found, _ = suite.run(items, methods, args.models, out / "cache", InferenceConfig(), shown)
    section = Section(name="photos", title="Photographs of the University of Washington", text=DEFINITION, order=60,
                      tables=(build_table(items, found, args.reference),),
                      command=f"sdps evaluate uw {args.folder} --out {out}")  # fmt: skip
    writer = SectionWriter(section)
    for item in items:
        pictures = tiles(item, found, shown, "reference, lights known")
        writer.strip(item.name, pictures)
        flat = [
            (text, scale_to_height(picture, _HEIGHT))
            for text, picture, _ in pictures
            if isinstance(picture, np.ndarray)
        ]
        with atomic_path(out / f"{item.name}.png") as temporary:
            contact_sheet(flat).save(temporary)
    objects = {
        item.name: {"pixels": int(item.mask.sum()), "images": len(lights),
                    "methods": {name: describe_result(item.name, name, found[name][item.name]) for name in shown}}
        for item in items
    }  # fmt: skip
    values = {"reference": args.reference, "lights": source, "light_directions": lights.tolist(), "objects": objects}
    publish(writer, out, out / "results.json", values)
    return 0


def add_reference(item: TestObject, method: str) -> TestObject:
    """Return an object with the normals that a calibrated method gives it under the measured lights for true ones.

    Raises:
        InputError: an image that cannot be read, or the method fails.
    """
    images = item.load()
    estimate = registry.run(method, images[0 : len(images)], item.mask, item.light_directions)
    return replace(item, digest=f"{item.digest}-{method}", normals=estimate.normals)


def build_table(items: Sequence[TestObject], found: Found, reference: str) -> Table:
    """Lay out the errors, a method a row and an object a column, the published figures in brackets."""
    names, rows = [item.name for item in items], []
    for name, results in found.items():
        errors = {key: one.scores["normal_mae"] for key, one in results.items() if "normal_mae" in one.scores}
        known = PUBLISHED.get(name, {})
        cells = [cell(errors.get(key), known.get(key), 2) for key in names]
        rows.append((name, *cells, cell(mean_of_all(errors, names), mean_of_all(known, names), 2)))
    header = ("method", *names, "mean")
    return Table(title=f"Normals against {reference} (degrees)", header=header, rows=tuple(rows))


def describe_result(item: str, method: str, result: Result) -> dict[str, Any]:
    """Return what is written down of a method on an object, JSON ready."""
    if result.reason:
        return {"failed": result.reason}
    scores = {metric: result.scores[metric] for metric in _METRICS if metric in result.scores}
    published = PUBLISHED.get(method, {}).get(item)
    return {**scores, "published": published, "seconds": result.seconds, **result.notes}
