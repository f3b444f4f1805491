"""`lab eval-figures`: the paper's figures on MERL-Test, for any methods, with the published curves."""

import argparse
import logging
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from PIL import Image

from lab.figures import light_distributions, number_of_classes, number_of_images, per_material, pf14
from lab.figures.sweep import LeftOut, Panel
from pipelines.evaluate.report.sections import Section, SectionWriter, save_picture
from pipelines.evaluate.score_tables import tables_text
from pipelines.evaluate.workbench import Workbench
from pipelines.shared import presets
from pipelines.shared.flags import pick_names, split_list
from render.shared.config import to_plain
from render.shared.errors import InputError
from render.shared.files import atomic_path, read_json, write_json
from sdps.inference.inference_config import inference_config
from sdps.methods import pretrained
from sdps.methods.method import NONE, Method
from sdps.methods.parse import parse
from sdps.methods.pretrained import finder
from sdps.methods.runner import Runner
from sdps.models.registry import COMBINATIONS

_log = logging.getLogger(__name__)
FIGURES = {
    "bins": number_of_classes,
    "images": number_of_images,
    "lights": light_distributions,
    "pf14": pf14,
    "materials": per_material,
}
FOLDER = "figures"
_ORDER = 40


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the flags of `python -m lab eval-figures`."""
    presets.add_common_arguments(parser, default="paper")
    parser.add_argument("--figures", action="append", help=f"{', '.join(FIGURES)} (default: all)")
    parser.add_argument("--methods", action="append", metavar="[LIGHTS+]NORMALS",
                        help="models, combinations, classical methods; commas or repeat "
                             "(default: sdps and psfcn where there are weights, pf14, least-squares)")  # fmt: skip
    parser.add_argument("--draws", type=int, default=3, metavar="N",
                        help="random subsets per number of images (default: %(default)s)")  # fmt: skip


def main(args: argparse.Namespace) -> int:
    """Render or reuse the scenes, evaluate, and write each figure as it is done.

    Returns:
        0, or 1 where a figure was left out.
    """
    preset, out = presets.from_arguments(args)
    names = pick_names("figure", args.figures, FIGURES)
    if args.draws < 1:
        raise InputError(f"--draws must be at least 1, got {args.draws}")
    config = inference_config(preset.test)
    runners = tuple(Runner(item, finder(out), config) for item in choose_methods(split_list(args.methods), out))
    bench = Workbench(preset, out, runners, args.draws)
    left_out = 0
    for name in names:
        try:
            drawn = FIGURES[name].make(bench)
        except LeftOut as error:
            _log.warning("figure left out: %s", error)
            left_out += 1
            continue
        write(name, drawn, bench)
        for table in drawn.tables:
            sys.stdout.write(f"{tables_text([table])}{table.note}\n")
    if left_out == len(names):
        raise InputError("no figure could be made of these methods, shapes and materials")
    sys.stdout.write(f"\n{out / FOLDER / 'results.json'}\n")
    return 1 if left_out else 0


def choose_methods(names: Sequence[str], out: Path) -> list[Method]:
    """Return the methods that names stand for, or the default ones.

    Raises:
        InputError: an unknown name, or one without weights.
    """
    find = finder(out)
    if names:
        return list({method.name: method for method in (parse(name, find) for name in names)}.values())
    found = [parse(name, find) for name in (_find_default(item, out) for item in ("sdps", "psfcn")) if name]
    if not found:
        _log.warning("%s: neither sdps nor psfcn has weights here or in the package; classical methods only", out)
    return [*found, parse("pf14", find), parse("least-squares", find)]


def _find_default(name: str, out: Path) -> str:
    """Return a default model's or combination's name, that of its shipped weights, or nothing."""
    members = COMBINATIONS[name].members() if name in COMBINATIONS else (name,)
    if all(pretrained.trained_file(out, member).is_file() for member in members):
        return name
    return pretrained.SHIPPED + name if set(members) <= set(pretrained.list_shipped()) else NONE


def write(name: str, drawn: Panel, bench: Workbench) -> None:
    """Write a figure: its section of the report, its charts, and its numbers next to those of earlier figures.

    Raises:
        InputError: a file cannot be written.
    """
    command = f"python -m lab eval-figures --preset {bench.preset.name} --out {bench.out} --figures {name}"
    section = Section(
        name=f"figure-{name}", title=drawn.title, text=drawn.text, order=_ORDER + list(FIGURES).index(name),
        tables=drawn.tables, command=command, pictures_first=True,
    )  # fmt: skip
    writer = SectionWriter(section)
    for file, caption, chart in drawn.charts:
        path = bench.out / FOLDER / f"{file}.png"
        with atomic_path(path) as temporary:
            save_picture(chart, temporary)
        with Image.open(path) as picture:  # a chart is laid out once
            writer.strip("", [(caption, picture.convert("RGB"))], wide=True)
    writer.write(bench.out)
    path = bench.out / FOLDER / "results.json"
    write_json(path, _earlier(path) | {name: _plain(drawn, bench)})


def _plain(drawn: Panel, bench: Workbench) -> dict[str, Any]:
    return {
        "title": drawn.title, "definition": drawn.text, "config": to_plain(bench.config), "draws": bench.draws,
        "methods": {r.method.name: {key: str(file) for key, file in r.files.items()} for r in bench.runners},
        "charts": [f"{file}.png" for file, _, _ in drawn.charts], "tables": to_plain(drawn.tables),
        "values": drawn.values,
    }  # fmt: skip


def _earlier(path: Path) -> dict[str, Any]:
    """Return the figures made before; those in a damaged file are made again when asked for."""
    if not path.is_file():
        return {}
    try:
        found = read_json(path, "delete it")
    except InputError:
        _log.warning("%s: damaged; it is written again", path)
        return {}
    return {name: found[name] for name in FIGURES if name in found} if isinstance(found, dict) else {}
