"""`sdps eval-classical`: every classical method on regenerated scenes, by kind of reflectance and of lights.

The scenes are those of the preset's `test` section under each light set, with random light intensities. The paper's
figure on PF14 (supplement: good on diffuse, bad on specular reflectance) is a row of these tables.
"""

import argparse
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from pipelines.evaluate.evaluation import Evaluation
from pipelines.evaluate.lit import lit_object
from pipelines.rendering.render_data import render_planned
from pipelines.report.sections import Section, SectionWriter, Table
from pipelines.shared import presets, scenes
from pipelines.shared.lists import split_list
from pipelines.shared.presets import TestConfig
from pipelines.shared.text_tables import number, render_text
from render.materials import surfaces
from render.records.manifest import SceneSpec
from render.shared.files import write_json
from render.shared.progress import progress_bar
from sdps.classical import registry
from sdps.methods import pretrained
from sdps.methods.parse import parse
from sdps.methods.runner import Runner

LIGHT_SETS = ("near-uniform:96", "biased:96")
TABLES = {
    "normal_mae": "Normals, mean angular error in degrees",
    "direction_mae": "Light directions, mean angular error in degrees",
    "intensity_error": "Light intensities, mean relative error",
}
DEFINITION = (
    "Means over scenes, one per shape and material, of random light intensities. Normals: mean angular error over mask "
    "pixels. Calibrated methods are given the true lights. Failures are scenes a method refused, with a reason."
)


@dataclass(frozen=True)
class Row:
    """What one method made of one scene.

    Attributes:
        method: Its name.
        lights: The light set.
        shape: Shape of the scene.
        category: Kind of reflectance.
        scores: Metrics by name; empty where the method refused.
        seconds: Time it took.
        reason: Why it refused, or empty.
    """

    method: str
    lights: str
    shape: str
    category: str
    scores: dict[str, float]
    seconds: float = 0.0
    reason: str = ""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the flags of `sdps eval-classical`."""
    presets.add_common_arguments(parser, default="classical")
    parser.add_argument("--methods", action="append", help=f"{', '.join(registry.METHODS)} (default: all)")
    parser.add_argument("--light-sets", action="append", help=f"default: {','.join(LIGHT_SETS)}")


def main(args: argparse.Namespace) -> int:
    """Render or reuse the scenes, run the methods, print the tables and write results.json."""
    preset, out = presets.from_arguments(args)
    names = split_list(args.methods) or list(registry.METHODS)
    runners = [classical_runner(name) for name in names]
    rows: list[Row] = []
    evaluation = Evaluation(out / "eval")
    for lights in split_list(args.light_sets) or LIGHT_SETS:
        test = replace(preset.test, lights=lights)
        wanted, folder = scenes.test_scenes(test), out / scenes.slug(lights)
        render_planned(wanted, folder, replace(preset, test=test))
        rows += evaluate(wanted, folder, runners, test, evaluation)
    tables = build_tables(rows, names)
    listed = [vars(row) for row in rows]
    rendered = {table.title: {"header": table.header, "rows": table.rows} for table in tables}
    write_json(out / "results.json", {"definition": DEFINITION, "tables": rendered, "rows": listed})
    section = Section(name="classical", title="Classical methods on regenerated scenes", text=DEFINITION, order=50,
                      tables=tuple(tables), command=f"sdps eval-classical --out {out}")  # fmt: skip
    SectionWriter(section).write(out)
    texts = (render_text(f"\n{table.title}", list(table.header), list(table.rows)) for table in tables)
    sys.stdout.write("\n".join(texts))
    sys.stdout.write(f"\n{DEFINITION}\n{out / 'results.json'}\n")
    return 0


def classical_runner(name: str) -> Runner:
    """Return a classical method, told the true lights if it is a calibrated one.

    Raises:
        InputError: an unknown name, with the nearest.
    """
    registry.method(name)
    return Runner(parse(name, pretrained.require), pretrained.require)


def evaluate(
    wanted: Sequence[SceneSpec], folder: Path, runners: Sequence[Runner], config: TestConfig, evaluation: Evaluation
) -> list[Row]:
    """Run every method on every scene that is not in the cache yet."""
    rows = []
    for scene in progress_bar(wanted, desc=config.lights, unit="scene"):
        item, kind = lit_object(scene, folder, config), category(scene)
        found = evaluation.results(item, runners, [False] * len(runners))
        for runner, result in zip(runners, found, strict=True):
            name = runner.method.normals
            rows.append(Row(name, config.lights, scene.shape, kind, result.scores, result.seconds, result.reason))
    return rows


def category(scene: SceneSpec) -> str:
    """Return the kind of reflectance; `mixed` where materials vary over the surface."""
    kinds = {component.category for component in surfaces.load(scene.material).components}
    return kinds.pop() if len(kinds) == 1 else "mixed"


def build_tables(rows: list[Row], names: list[str]) -> list[Table]:
    """Average over the scenes of a shape, kind of reflectance and light set."""
    tables = []
    for metric, title in TABLES.items():
        for lights in dict.fromkeys(row.lights for row in rows):
            for shape in dict.fromkeys(row.shape for row in rows):
                part = [row for row in rows if (row.lights, row.shape) == (lights, shape)]
                kinds = list(dict.fromkeys(row.category for row in part))
                shown = [n for n in names if metric == "normal_mae" or not registry.METHODS[n].calibrated]
                body = tuple((name, *(_cell(part, name, kind, metric) for kind in kinds)) for name in shown)
                tables.append(Table(title=f"{title}: {shape}, {lights}", header=("method", *kinds), rows=body))
    return tables


def _cell(rows: list[Row], name: str, kind: str, metric: str) -> str:
    """Return a method's mean over the scenes of a category, and how many failed."""
    rows = [row for row in rows if (row.method, row.category) == (name, kind)]
    values = [row.scores[metric] for row in rows if metric in row.scores]
    text = number(float(np.mean(values))) if values else "-"
    return text + (f" [{len(rows) - len(values)} failed]" if len(values) < len(rows) else "")
