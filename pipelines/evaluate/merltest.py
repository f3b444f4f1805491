"""`sdps evaluate merltest`: render MERL-Test scenes and score every method on them in the layout of the paper's tables.

Table A is lighting estimation, table B normal estimation (SDPS-Net, sec. 5.1); each number is the mean over the
materials, with the paper's in brackets. Every scene gets random light intensities. Every model that is trained in the
output folder, and every shipped one, has its row, and the paper's rows without a model are marked so; least squares and
a constant predictor, which shows what knowing nothing scores, stand below.
"""

import argparse
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from pipelines.evaluate import published
from pipelines.evaluate.object_pictures import ERROR_LIMIT, tiles
from pipelines.evaluate.report import page as report
from pipelines.evaluate.report.sections import Section, SectionWriter, Table
from pipelines.evaluate.score_tables import cell, mean, tables_text, weights_of
from pipelines.evaluate.workbench import Workbench, build_test_object
from pipelines.shared import network_flags, presets
from pipelines.shared.cluster import cluster_config
from pipelines.shared.presets import Preset, TestConfig
from pipelines.shared.text_tables import number
from render.records.manifest import SceneSpec
from render.shared.config import to_plain
from render.shared.errors import InputError
from render.shared.files import write_json
from render.shared.seeds import spread_evenly
from sdps.inference.inference_config import inference_config
from sdps.methods import rows
from sdps.methods.method import CONSTANT, Method
from sdps.methods.pretrained import SHIPPED, finder
from sdps.methods.runner import Runner
from sdps.models.registry import MODELS, TRUE_LIGHTS

LIGHTING_METRICS = ("direction_mae", "intensity_error")
MISSING = "not trained"
_METRICS = (("normal_mae", "normals", 2), ("direction_mae", "directions", 2), ("intensity_error", "intensities", 3))


@dataclass(frozen=True)
class SceneScores:
    """Scores of one scene, averaged over the draws of random intensities.

    Attributes:
        scene: The manifest line.
        scores: `scores[method][metric]`; empty of a method that refused one of the draws.
    """

    scene: SceneSpec
    scores: dict[str, dict[str, float]]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the flags of `sdps evaluate merltest`."""
    presets.add_common_arguments(parser)
    cluster_config.add_arguments(parser)
    parser.add_argument("--lighting", default=None, metavar="NAME|FILE|true",
                        help="lighting model of a combination (default: every trained model, a row each)")  # fmt: skip
    parser.add_argument("--lights", dest="lighting", default=None, help=argparse.SUPPRESS)  # its earlier name
    parser.add_argument("--normals", default=None, metavar="NAME|FILE",
                        help="normal model, combination such as sdps-plus, or classical method")  # fmt: skip
    parser.add_argument("--intensities", default=None, choices=("true",), help="give the true intensities only")


def main(args: argparse.Namespace) -> int:
    """Render or reuse the scenes, score, print the tables, and write results.json, the section and report.html."""
    preset, out = presets.from_arguments(args)
    lighting, normals = table_rows(args, out, preset)
    config = inference_config(preset.test)
    runners = tuple(Runner(method, finder(out), config) for method in (*lighting, *normals))
    bench = Workbench(preset, out, runners, cluster=cluster_config.from_arguments(args))
    pictured = pick_pictured(normals)
    wanted, folder = bench.merltest()
    results = evaluate(bench, wanted, folder, pictured)
    tables, networks = build_tables(results, lighting, normals), network_flags.describe(runners, config)
    presets.save_resolved(preset, out / "eval")
    write_json(out / "eval" / "results.json", {
        "definition": describe(preset.test),
        "networks": networks.strip(),
        "weights": weights_of(runners),
        "config": to_plain(preset.test),
        "tables": {table.title: {"header": table.header, "rows": table.rows} for table in tables},
        "scenes": [
            {"id": r.scene.id, "shape": r.scene.shape, "material": r.scene.material, "scores": r.scores}
            for r in results
        ],
    })  # fmt: skip
    chosen = {runner.method.name: runner for runner in runners}
    write(bench, folder, tables, results, [chosen[name] for name in pictured if name in chosen], networks)
    page = report.write(out, preset)
    sys.stdout.write(f"{tables_text(tables, left=(0, 1))}\n{describe(preset.test)}{networks}\n{page}\n")
    return 0


def table_rows(args: argparse.Namespace, out: Path, preset: Preset) -> tuple[list[Method], list[Method]]:
    """Return the methods of the lighting table and of the normal table.

    Raises:
        InputError: nothing is trained, or flags name what is not there.
    """
    constant = Method(name="constant predictor", normals=CONSTANT)
    if any((args.lighting, args.normals, args.intensities)):
        method = rows.from_flags(out, args.lighting, args.normals, args.intensities)
        reference = Method(name="least-squares, true lights", lighting="true", normals="least-squares")
        return [], [method, *([reference] if method.name != reference.name else []), constant]
    normals = rows.normal_methods(out, preset.test.shipped, preset.test)
    lighting = rows.lighting_methods(out, _own_lighting(preset), preset.test, normals, preset.test.shipped)
    if not lighting and all(not method.models() for method in normals):
        raise InputError(
            f"{out / 'models'}: no trained models; train them with `sdps train --preset {preset.name} --out {out}`"
        )
    return [*lighting, constant], [*normals, constant]


def _own_lighting(preset: Preset) -> list[str]:
    """Return the runs of a preset that give lights, without those that others start from, which are not results."""
    starts = {settings.get("start") for settings in preset.runs.values()}
    models = {name: preset.run(name).model for name in preset.runs if name not in starts}
    return [name for name, model in models.items() if model in MODELS and MODELS[model].role == "lighting"]


def pick_pictured(normals: Sequence[Method]) -> list[str]:
    """Return the names of the methods whose normal maps the page shows.

    The paper's pair if it was trained here, the last of the shipped ways that find the lights (the rows have the best
    last), and least squares; where there is neither, the first method.
    """
    finders = [method for method in normals if method.lighting != TRUE_LIGHTS and method.normals in method.models()]
    shipped = [method for method in finders if all(name.startswith(SHIPPED) for name in method.models())]
    pairs = [method for method in finders if method.paper == "B1" and method not in shipped]
    chosen = [*pairs[:1], *shipped[-1:]] or normals[:1]
    return list(dict.fromkeys([*(method.name for method in chosen), "least-squares, true lights"]))


def evaluate(bench: Workbench, wanted: Sequence[SceneSpec], folder: Path, pictured: Sequence[str]) -> list[SceneScores]:
    """Score every scene, averaged over the draws of random intensities; normal maps of the first draw are kept."""
    repeats = range(bench.config.repeats)
    objects = (
        ((place, repeat), build_test_object(scene, folder, bench.config, repeat))
        for place, scene in enumerate(wanted)
        for repeat in repeats
    )
    found: list[dict[str, list[dict[str, float]]]] = [{} for _ in wanted]  # [scene][method][draw]
    total = len(wanted) * len(repeats)
    for (place, repeat), runner, result in bench.evaluation.run(objects, bench.runners, total, "evaluate", pictured):
        draws = found[place].setdefault(runner.method.name, [{} for _ in repeats])
        draws[repeat] |= result.scores  # the constant predictor has a row in both tables
    return [
        SceneScores(scene, {name: _mean_scores(values) for name, values in draws.items()})
        for scene, draws in zip(wanted, found, strict=True)
    ]


def _mean_scores(draws: list[dict[str, float]]) -> dict[str, float]:
    """Average each metric over the draws; none of a method that failed in one of them."""
    if not all(draws):
        return {}
    return {metric: float(np.mean([values[metric] for values in draws])) for metric in draws[0]}


def build_tables(results: list[SceneScores], lighting: list[Method], normals: list[Method]) -> list[Table]:
    """Return table A, lights, where every model has its row, and table B, mean angular errors of normals."""
    shapes = _shapes(results)
    tables = []
    if lighting:
        header = ("row", "model", *(f"{shape} {name}" for shape in shapes for name in ("direction", "intensity")))
        body = _rows(results, lighting, published.LIGHTING, LIGHTING_METRICS, all_rows=True)
        tables.append(Table(title="Table A, lighting estimation", header=header, rows=body))
    body = _rows(results, normals, published.NORMALS, ("normal_mae",), all_rows=bool(lighting))
    return [*tables, Table(title="Table B, normal estimation (MAE)", header=("row", "model", *shapes), rows=body)]


def describe(config: TestConfig) -> str:
    """Return what the tables' numbers are and what the methods saw."""
    margin = config.margin_of((config.size, config.size))
    seen = "whole frame" if margin is None else f"object's box with {margin} pixels of margin"
    return (
        "Means over scenes (one per material). Normals: mean angular error in degrees over mask pixels. Directions: "
        "mean angular error in degrees over images. Intensities: mean relative error after one least-squares scale. "
        "Inputs: linear half-float radiance times random intensities, multiplied by the mask; networks see the "
        f"{seen}. In brackets: the paper's figure, of its own rendering of the same materials."
    )


def _rows(
    results: Sequence[SceneScores],
    methods: Sequence[Method],
    paper: dict[str, list[Any]],
    metrics: tuple[str, ...],
    *,
    all_rows: bool,
) -> tuple[tuple[str, ...], ...]:
    """Return a row per method, and per row of the paper that no method fills; the paper's rows first, in its order."""
    shapes = _shapes(results)
    rows = []
    for method in methods:
        cells = [
            mean((r.scores[method.name] for r in results if r.scene.shape == shape), metric).cell(figure)
            for shape in shapes
            for metric, figure in zip(metrics, published.figures(paper, method.paper, shape, len(metrics)), strict=True)
        ]
        rows.append((method.paper or "-", method.name, *cells))
    for row in paper if all_rows else ():
        if row not in {method.paper for method in methods}:
            figures = [figure for shape in shapes for figure in published.figures(paper, row, shape, len(metrics))]
            cells = [cell(MISSING, figure) for figure in figures]
            rows.append((row, paper[row][0], *cells))
    return tuple(sorted(rows, key=lambda row: (row[0] == "-", row[0])))


def _shapes(results: Sequence[SceneScores]) -> list[str]:
    return list(dict.fromkeys(result.scene.shape for result in results))


def write(
    bench: Workbench,
    folder: Path,
    tables: Sequence[Table],
    results: Sequence[SceneScores],
    runners: Sequence[Runner],
    networks: str,
) -> None:
    """Write the sections of the report.

    Args:
        bench: What was run.
        folder: The rendered scenes.
        tables: Tables A and B.
        results: Scores of every scene.
        runners: The methods whose pictures are shown, the main one first.
        networks: How networks were used, in words.
    """
    config = bench.config
    repeats = f"{config.repeats} draws of intensities" if config.repeats > 1 else "one draw of intensities"
    text = (
        f"{len(results)} scenes of {config.size}x{config.size} pixels, {len(results[0].scene.lights)} lights, "
        f"{repeats}. {describe(config)}{networks} "
        f"Error maps run from 0 (black) to {ERROR_LIMIT:g} degrees (yellow)."
    )
    names = [runner.method.name for runner in runners]
    section = Section(name="merltest", title="MERL-Test scenes", text=text, order=10, tables=tuple(tables),
                      command=f"sdps evaluate merltest --preset {bench.preset.name} --out {bench.out}")  # fmt: skip
    writer = SectionWriter(section)
    for result in pick_spread(results, names[0], config.pictures):
        item = build_test_object(result.scene, folder, config)
        kept = bench.evaluation.results(item, runners, names)
        found = {name: {item.name: one} for name, one in zip(names, kept, strict=True)}
        writer.strip(f"{result.scene.shape}, {result.scene.material}", tiles(item, found, names))
    writer.write(bench.out)
    single = Section(name="merltest-scenes", title="MERL-Test, scene by scene", text="", order=15,
                     tables=(_per_scene(results, names),))  # fmt: skip
    SectionWriter(single).write(bench.out)


def pick_spread(results: Sequence[SceneScores], name: str, count: int) -> list[SceneScores]:
    """Pick scenes of each shape spread from the best to the worst normal error, so the page shows both ends."""
    chosen = []
    for shape in dict.fromkeys(result.scene.shape for result in results):
        ranked = sorted((r for r in results if r.scene.shape == shape), key=lambda r: _error(r, name))
        chosen += spread_evenly(ranked, count)
    return chosen


def _error(result: SceneScores, name: str) -> float:
    return result.scores[name].get("normal_mae", np.inf)


def _per_scene(results: Sequence[SceneScores], names: Sequence[str]) -> Table:
    """Return one line per scene, worst first."""
    wanted = [
        (name, metric, about, digits)
        for name in names
        for metric, about, digits in _METRICS
        if any(metric in result.scores[name] for result in results)
    ]
    rows = [
        (
            r.scene.shape,
            r.scene.material,
            *(number(r.scores[name].get(metric), digits) for name, metric, _, digits in wanted),
        )
        for r in sorted(results, key=lambda r: _error(r, names[0]), reverse=True)
    ]
    header = ("shape", "material", *(f"{name}: {about}" for name, _, about, _ in wanted))
    return Table(title="Per scene, worst first", header=header, rows=tuple(rows))
