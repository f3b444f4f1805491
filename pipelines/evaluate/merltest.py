"""`sdps evaluate merltest`: render MERL-Test scenes and score every method on them in the layout of the paper's tables.

Table A is lighting estimation, table B normal estimation (SDPS-Net, sec. 5.1); each number is the mean over the
materials, with the paper's beside it. Every scene gets random light intensities. Every model that is trained in the
output folder, and every shipped one, has its row, and the paper's rows without a model are marked so; least squares and
a constant predictor, which shows what knowing nothing scores, stand below.
"""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from pipelines.evaluate.merltest_tables import SceneScores, definition, lighting_table, normal_table, write
from pipelines.evaluate.report import page as report
from pipelines.evaluate.report.sections import Table
from pipelines.evaluate.results import tables_text, weights_of
from pipelines.evaluate.workbench import Workbench, lit_object
from pipelines.shared import presets, using
from pipelines.shared.cluster import cluster_config
from pipelines.shared.presets import Preset
from render.records.manifest import SceneSpec
from render.shared.config import to_plain
from render.shared.errors import InputError
from render.shared.files import write_json
from sdps.inference.inference_config import inference_config
from sdps.methods import rows
from sdps.methods.method import CONSTANT, Method
from sdps.methods.pretrained import SHIPPED, finder
from sdps.methods.runner import Runner
from sdps.models.registry import MODELS, TRUE_LIGHTS


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
    pictured = shown(normals)
    wanted, folder = bench.merltest()
    results = evaluate(bench, wanted, folder, pictured)
    tables, networks = build_tables(results, lighting, normals), using.describe(runners, config)
    presets.save_resolved(preset, out / "eval")
    write_json(out / "eval" / "results.json", {
        "definition": definition(preset.test),
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
    sys.stdout.write(f"{tables_text(tables, left=(0, 1))}\n{definition(preset.test)}{networks}\n{page}\n")
    return 0


def table_rows(args: argparse.Namespace, out: Path, preset: Preset) -> tuple[list[Method], list[Method]]:
    """Return the methods of the lighting table and of the normal table.

    Raises:
        InputError: nothing is trained, or flags name what is not there.
    """
    constant = Method(name="constant predictor", normals=CONSTANT)
    if any((args.lighting, args.normals, args.intensities)):
        method = rows.chosen(out, args.lighting, args.normals, None, args.intensities)
        reference = Method(name="least-squares, true lights", lights="true", normals="least-squares")
        return [], [method, *([reference] if method.name != reference.name else []), constant]
    normals = rows.normal_methods(out, preset.test.shipped, preset.test)
    lighting = rows.lighting_methods(out, _own_lighting(preset), preset.test, normals, preset.test.shipped)
    if not lighting and all(not method.models() for method in normals):
        raise InputError(
            f"{out / 'models'}: no trained models; train them with `sdps train --preset {preset.name} --out {out}`"
        )
    return [*lighting, constant], [*normals, constant]


def _own_lighting(preset: Preset) -> list[str]:
    """Return the runs of a preset that give lights, without those that others start from: they are no result."""
    starts = {settings.get("start") for settings in preset.runs.values()}
    models = {name: preset.run(name).model for name in preset.runs if name not in starts}
    return [name for name, model in models.items() if model in MODELS and MODELS[model].role == "lighting"]


def shown(normals: Sequence[Method]) -> list[str]:
    """Return the names of the methods whose normal maps the page shows.

    The paper's pair if it was trained here, the last of the shipped ways that find the lights (the rows have the best
    last), and least squares; where there is neither, the first method.
    """
    finders = [method for method in normals if method.lights != TRUE_LIGHTS and method.normals in method.models()]
    shipped = [method for method in finders if all(name.startswith(SHIPPED) for name in method.models())]
    pairs = [method for method in finders if method.paper == "B1" and method not in shipped]
    chosen = [*pairs[:1], *shipped[-1:]] or normals[:1]
    return list(dict.fromkeys([*(method.name for method in chosen), "least-squares, true lights"]))


def evaluate(bench: Workbench, wanted: Sequence[SceneSpec], folder: Path, pictured: Sequence[str]) -> list[SceneScores]:
    """Score every scene, averaged over the draws of random intensities; normal maps of the first draw are kept."""
    repeats = range(bench.config.repeats)
    objects = (
        ((number, repeat), lit_object(scene, folder, bench.config, repeat))
        for number, scene in enumerate(wanted)
        for repeat in repeats
    )
    found: list[dict[str, list[dict[str, float]]]] = [{} for _ in wanted]  # [scene][method][draw]
    total = len(wanted) * len(repeats)
    for (number, repeat), runner, result in bench.evaluation.run(objects, bench.runners, total, "evaluate", pictured):
        draws = found[number].setdefault(runner.method.name, [{} for _ in repeats])
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
    """Return table A where every model has its row, and table B."""
    first = [lighting_table(results, lighting, all_rows=True)] if lighting else []
    return [*first, normal_table(results, normals, all_rows=bool(lighting))]
