"""`sdps eval-diligent`: any objects of DiLiGenT, every method, the tables of the paper with all published rows.

Table (a) is light directions, (b) light intensities, (c) normals (SDPS-Net, table "Results of SDPS-Net on the DiLiGenT
benchmark"). Every number carries its protocol: bits, crop, mask, images of bear.
"""

import argparse
import sys
from collections.abc import Sequence
from typing import Any

from pipelines.benchmarks import published_real, suite
from pipelines.benchmarks.diligent import OBJECTS, DiligentConfig, diligent_objects
from pipelines.benchmarks.object_tables import object_table
from pipelines.evaluate.evaluation import TestObject
from pipelines.report.sections import Section, Table
from pipelines.shared.lists import split_list
from pipelines.shared.using import describe
from render.shared.config import to_plain
from sdps.inference.inference_config import inference_config
from sdps.methods import select
from sdps.methods.method import Method

_PRINTED = "Published rows: bear with 96 images; 'this object' and 'mean of' are over the objects present."


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the flags of `sdps eval-diligent`."""
    suite.add_arguments(parser, "out/real")
    parser.add_argument("--bits", type=int, default=8, choices=(8, 16),
                        help="16: the PNGs exactly; 8: their high byte, as published (default: 8)")  # fmt: skip
    parser.add_argument("--bear", type=int, default=96, choices=(96, 76),
                        help="images of bear; 76 drops the corrupted first 20 (default: 96, as the paper)")  # fmt: skip


def main(args: argparse.Namespace) -> int:
    """Evaluate, print the tables, and write <out>/diligent/results.json and the report's section."""
    config = DiligentConfig(bits=args.bits, bear=args.bear)
    models = select.runs_folder(args.models)
    using = inference_config(args)
    chosen = select.selected(split_list(args.methods), models, using)
    items = suite.pick(diligent_objects(args.data, config), split_list(args.objects))
    chosen = chosen or select.every_method(models, using)
    shown = suite.pictured(chosen)
    found, runners = suite.run(items, chosen, models, args.out / "diligent" / "cache", using, shown)
    tables = build_tables(items, found, chosen)
    text = definition(items, config) + describe(runners, using)
    section = Section(
        name="diligent",
        title="DiLiGenT",
        text=text,
        order=40,
        tables=tuple(tables),
        command=f"sdps eval-diligent {args.data} --bits {args.bits} --bear {args.bear} --out {args.out}",
    )
    suite.write(args.out, section, items, found, runners, shown, {**to_plain(config), **to_plain(using)})
    sys.stdout.write(f"{suite.text_of(tables, found)}\n{text}\n{args.out / 'diligent' / 'results.json'}\n")
    return 0


def build_tables(items: Sequence[TestObject], found: suite.Found, chosen: Sequence[Method]) -> list[Table]:
    """Return tables (a), (b) and (c)."""
    names, lights = [item.name for item in items], suite.lighting_only(found, chosen)
    common: dict[str, Any] = {"present": names, "known": OBJECTS, "note": _PRINTED}
    tables = [
        object_table("DiLiGenT (a), light directions, degrees", lights, "direction_mae",
                     published=published_real.DILIGENT_DIRECTIONS, digits=2, **common),
        object_table("DiLiGenT (b), light intensities, relative error", lights, "intensity_error",
                     published=published_real.DILIGENT_INTENSITIES, digits=3, **common),
        object_table("DiLiGenT (c), normals, degrees", found, "normal_mae",
                     published=published_real.DILIGENT_NORMALS, digits=2, **common),
    ]  # fmt: skip
    return tables


def definition(items: Sequence[TestObject], config: DiligentConfig) -> str:
    """Say what the numbers are of."""
    counts = sorted({len(item.true_directions) for item in items})
    images = " or ".join(str(count) for count in counts)
    own = sum(item.name in OBJECTS for item in items)
    others = f" and {len(items) - own} others" if own < len(items) else ""
    return (
        f"{own} of DiLiGenT's ten objects{others}, {images} images each; {config.definition()}. Normals: mean angular "
        "error in degrees over mask pixels. Directions: mean angular error in degrees over images. Intensities: truth "
        "divided per channel by the first image's, one least-squares scale, mean relative error. A dash: not in the "
        "folder, not printed, or given to the method."
    )
