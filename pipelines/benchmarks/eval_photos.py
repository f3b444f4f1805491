"""`sdps eval-photos`: uncalibrated methods on real photographs, against least squares under the measured lights.

There is no ground truth: the error is the mean angle between the normals of a method that finds the lights itself and
those of one that is told them. The published figures of PF14 stand beside ours.
"""

import argparse
import logging
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.figure import Figure

from pipelines.benchmarks.psm_photos import Photos, list_objects, read_lights, read_photos, resolve_source
from pipelines.report.sections import Section, SectionWriter, Table
from pipelines.shared.lists import split_list
from pipelines.shared.pictures import auto_exposure, error_map, fitted, normal_map, tone_map
from pipelines.shared.text_tables import render_text
from render.shared.errors import InputError
from render.shared.files import atomic_path, write_json
from render.shared.progress import progress_bar
from sdps.core.estimate import Estimate
from sdps.core.metrics import direction_mae, normal_error_map, normal_mae
from sdps.methods.pretrained import finder

if TYPE_CHECKING:
    from sdps.methods.runner import Runner

_log = logging.getLogger(__name__)

PUBLISHED = {"pf14": {"rock": 11.61, "buddha": 4.98, "horse": 4.80, "cat": 5.37, "owl": 6.63}}
"""Degrees against calibrated photometric stereo (Favaro & Papadhimitri, CVPR 2012, table 1)."""

DEFINITION = (
    "Mean angle in degrees between a method's normals and those of calibrated photometric stereo, over mask pixels; in "
    "brackets the published figure. The last column is the mean over objects."
)
_HEIGHT = 240
_LIMIT = 30.0
"""Degrees at which the colours of error maps end."""


@dataclass(frozen=True, eq=False)
class Comparison:
    """What one method makes of one object.

    Attributes:
        photos: The object.
        reference: Estimate under the measured lights.
        estimates: By method; those that failed are missing.
        failures: One line by method.
    """

    photos: Photos
    reference: Estimate
    estimates: dict[str, Estimate]
    failures: dict[str, str]

    def error(self, name: str) -> float:
        """Return the mean angle in degrees, NaN where the method failed."""
        if name not in self.estimates:
            return float("nan")
        return normal_mae(self.estimates[name].normals, self.reference.normals, self.photos.mask)

    def to_json(self) -> dict[str, Any]:
        """Return the figures of every method, JSON ready."""
        rows: dict[str, Any] = {name: {"failed": text} for name, text in self.failures.items()}
        for name, estimate in self.estimates.items():
            errors = normal_error_map(estimate.normals, self.reference.normals, self.photos.mask)[self.photos.mask]
            rows[name] = {
                "normal_mae": self.error(name), "normal_median": float(np.median(errors)),
                "published": PUBLISHED.get(name, {}).get(self.photos.name),
                "seconds": estimate.diagnostics.get("seconds"),
                **{key: estimate.diagnostics[key] for key in ("gbr", "candidates", "intersections")
                   if key in estimate.diagnostics},
            }  # fmt: skip
            if len(estimate.light_directions) == len(self.reference.light_directions):
                rows[name]["direction_mae"] = direction_mae(estimate.light_directions, self.reference.light_directions)
        return {"pixels": int(self.photos.mask.sum()), "images": len(self.photos.images), "methods": rows}


def compare(photos: Photos, lights: np.ndarray, runners: "Sequence[Runner]", reference: str) -> Comparison:
    """Run the reference and the methods on an object; a method that refuses the object is noted and passed over.

    Raises:
        InputError: the reference fails, or the lights are not as many as the images.
    """
    from sdps.classical import registry

    if len(lights) != len(photos.images):
        raise InputError(f"{photos.name}: {len(photos.images)} images but {len(lights)} lights")
    truth = registry.run(reference, photos.images, photos.mask, lights)
    estimates, failures = {}, {}
    for runner in runners:
        name = runner.method.name
        try:
            estimates[name] = runner.estimate(photos.images, photos.mask, lights, None)
        except InputError as error:
            failures[name] = str(error)
            _log.warning("%s on %s: %s", name, photos.name, error)
    return Comparison(photos, truth, estimates, failures)


def table(results: Sequence[Comparison], methods: Sequence[str], reference: str) -> Table:
    """Lay out the errors, a method a row and an object a column."""
    rows = []
    for name in methods:
        errors = [result.error(name) for result in results]
        known = [PUBLISHED.get(name, {}).get(result.photos.name) for result in results]
        cells = [_cell(error, figure) for error, figure in zip(errors, known, strict=True)]
        mean = float(np.mean([figure for figure in known if figure is not None])) if all(known) else None
        rows.append((name, *cells, _cell(float(np.mean(errors)), mean)))
    header = ("method", *(result.photos.name for result in results), "mean")
    return Table(title=f"Normals against {reference} (degrees)", header=header, rows=tuple(rows))


def _cell(error: float, published: float | None) -> str:
    """Write one figure, with the published one in brackets; a dash where the method failed."""
    text = "-" if np.isnan(error) else f"{error:.2f}"
    return text if published is None else f"{text} ({published:.2f})"


def write_picture(result: Comparison, path: Path) -> None:
    """Draw the reference's normals above, and below it every method's beside its error map."""
    mask, names = result.photos.mask, list(result.estimates)
    height, width = mask.shape
    side = 3.2
    figure = Figure(figsize=(2 * side + 0.8, (1 + len(names)) * (side * height / width + 0.3)), layout="constrained")
    axes = figure.subplots(1 + len(names), 2, squeeze=False)
    shown = result.photos.images.mean(0)
    axes[0, 0].imshow(np.clip(shown / max(float(np.percentile(shown[mask], 99)), 1e-6), 0, 1) ** (1 / 2.2))
    axes[0, 0].set_title(f"{result.photos.name}, mean image", fontsize=9)
    axes[0, 1].imshow(normal_map(result.reference.normals, mask))
    axes[0, 1].set_title("reference, lights known", fontsize=9)
    drawn = None
    for row, name in zip(axes[1:], names, strict=True):
        estimate = result.estimates[name]
        row[0].imshow(normal_map(estimate.normals, mask))
        row[0].set_title(name, fontsize=9)
        errors = normal_error_map(estimate.normals, result.reference.normals, mask)
        drawn = row[1].imshow(errors, cmap="inferno", vmin=0.0, vmax=_LIMIT)
        row[1].set_title(f"error, mean {result.error(name):.2f}°", fontsize=9)
    for axis in axes.flat:
        axis.set_axis_off()
    if drawn is not None:
        figure.colorbar(drawn, ax=axes[1:, 1].tolist(), shrink=0.8, label="degrees", extend="max")
    with atomic_path(path) as temporary:
        figure.savefig(temporary, dpi=110)


def tiles(result: Comparison) -> list[tuple[str, np.ndarray]]:
    """Return (caption, picture) for the report: the mean image, the reference, and each method with its errors."""
    photos = result.photos
    mean = photos.images.mean(0)
    shown = [("mean image", tone_map(mean, auto_exposure(mean[None], photos.mask)))]
    shown.append(("reference, lights known", normal_map(result.reference.normals, photos.mask)))
    for name, estimate in result.estimates.items():
        errors = normal_error_map(estimate.normals, result.reference.normals, photos.mask)
        shown.append((f"normals, {name}", normal_map(estimate.normals, photos.mask)))
        shown.append((f"{name}: {result.error(name):.1f}°, to {_LIMIT:g}°", error_map(errors, _LIMIT)))
    return [(caption, fitted(picture, min(_HEIGHT, len(picture)))) for caption, picture in shown]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the flags of `sdps eval-photos`."""
    parser.add_argument("folder", type=Path, help="unpacked photographs: <object>/<object>.<k>.tga and masks")
    parser.add_argument("--objects", action="append", help="commas or repeat (default: all)")
    parser.add_argument("--methods", action="append", metavar="METHOD,LIGHTS+NORMALS,...",
                        help="commas or repeat (default: all uncalibrated classical methods)")  # fmt: skip
    parser.add_argument("--models", type=Path, default=None, help="folder of trained runs (default: shipped weights)")
    parser.add_argument("--reference", default="least-squares", metavar="METHOD",
                        help="calibrated method to compare with (default: %(default)s)")  # fmt: skip
    parser.add_argument("--lights", default="auto", choices=("auto", "chrome", "file"),
                        help="the reference's: chrome sphere or lights.txt (default: sphere if there)")  # fmt: skip
    parser.add_argument("--out", type=Path, default=Path("out/photos"), help="output folder (default: %(default)s)")


def main(args: argparse.Namespace) -> int:
    """Compare, print the table, and write results.json and a picture per object into the output folder."""
    from sdps.classical import registry
    from sdps.methods.parse import parse
    from sdps.methods.runner import Runner

    names = split_list(args.objects) or list_objects(args.folder)
    chosen = split_list(args.methods) or [name for name, entry in registry.METHODS.items() if not entry.calibrated]
    find = finder(args.models)
    runners = [Runner(parse(name, find), find) for name in chosen]
    methods = [runner.method.name for runner in runners]
    if not registry.method(args.reference).calibrated:
        raise InputError(f"--reference {args.reference}: finds the lights itself; choose a calibrated method")
    objects = [read_photos(args.folder, name) for name in names]
    source = resolve_source(args.folder, args.lights)
    lights = read_lights(args.folder, source)
    out = args.out
    results = []
    for photos in progress_bar(objects, desc="photographs", unit="object"):
        results.append(compare(photos, lights, runners, args.reference))
        write_picture(results[-1], out / f"{photos.name}.png")
    compared = table(results, methods, args.reference)
    section = Section(name="photos", title="Photographs of the University of Washington", text=DEFINITION, order=60,
                      tables=(compared,), command=f"sdps eval-photos {args.folder} --out {out}")  # fmt: skip
    writer = SectionWriter(section)
    for item in results:
        writer.strip(item.photos.name, tiles(item))
    writer.write(out)
    write_json(out / "results.json", {
        "definition": DEFINITION, "reference": args.reference, "lights": source,
        "light_directions": lights.tolist(), "objects": {item.photos.name: item.to_json() for item in results},
    })  # fmt: skip
    text = render_text(compared.title, list(compared.header), [list(row) for row in compared.rows])
    sys.stdout.write(f"\n{text}\n{DEFINITION}\n{out}\n")
    return 0
