"""`sdps eval-merltest`: render MERL-Test scenes and score trained models in the layout of the paper's tables.

Table A is lighting estimation, table B normal estimation (SDPS-Net, sec. 5.1); each number is the mean over the
materials, with the paper's beside it. Every scene gets random light intensities. Every model that is trained in the
output folder has its row; least squares and a constant predictor, which shows what knowing nothing scores, stand below.
"""

import argparse
import logging
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from pipelines import methods, presets, published, scenes
from pipelines.methods import Method
from pipelines.presets import Preset, TestConfig
from pipelines.render_data import render_planned
from pipelines.tables import number, render_text
from render.config import to_plain
from render.errors import InputError
from render.files import write_json
from render.manifest import SceneSpec
from render.progress import progress_bar
from render.seeds import generator
from render.shards import Shard, read_shard

if TYPE_CHECKING:
    from pipelines.runners import Runner

_log = logging.getLogger(__name__)
LIGHTING_COLUMNS = ("direction_mae", "intensity_error")
DEFINITION = (
    "Means over scenes (one per material). Normals: mean angular error in degrees over mask pixels. Directions: mean "
    "angular error in degrees over images. Intensities: mean relative error after one least-squares scale. Inputs: "
    "linear half-float radiance times random intensities, multiplied by the mask. In brackets: the paper's figure, of "
    "its own rendering of the same materials."
)


@dataclass(frozen=True, eq=False)
class SceneResult:
    """Scores and pictures of one scene, without its images, so that 200 results stay small.

    Attributes:
        scene: The manifest line.
        scores: `scores[method][metric]`, averaged over the repeats.
        mask: (H, W) bool.
        truth: (H, W, 3) true normals.
        shown: The methods whose pictures are shown, the main one first.
        normals: (H, W, 3) estimated normals of these methods, by method; of those that found any.
        true_lights: (L, 3) directions.
        lights: (L, 3) directions the first method shown estimated; empty if it estimates none.
        picture: (H, W, 3) float32, the brightest input image.
    """

    scene: SceneSpec
    scores: dict[str, dict[str, float]]
    mask: np.ndarray
    truth: np.ndarray
    shown: tuple[str, ...]
    normals: dict[str, np.ndarray]
    true_lights: np.ndarray
    lights: np.ndarray
    picture: np.ndarray


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the flags of `sdps eval-merltest`."""
    presets.add_common_arguments(parser)
    parser.add_argument("--lights", default=None, metavar="NAME|FILE|true",
                        help="lighting model of a combination (default: every trained model, a row each)")  # fmt: skip
    parser.add_argument("--normals", default=None, metavar="NAME|FILE",
                        help="normal model, combination such as sdps-plus, or least-squares")  # fmt: skip
    parser.add_argument("--second", default=None, metavar="NAME|FILE", help="second lighting pass")
    parser.add_argument("--intensities", default=None, choices=("true",), help="give the true intensities only")


def main(args: argparse.Namespace) -> int:
    """Render or reuse the scenes, score, print the tables, and write results.json and report.html."""
    from pipelines import report
    from pipelines.runners import Runner

    preset, out = presets.from_arguments(args)
    lighting, normals = rows(args, out, preset)
    runners = [Runner(method, out, preset.test) for method in (*lighting, *normals)]
    wanted = scenes.test_scenes(preset.test)
    folder = out / "merltest"
    render_planned(wanted, folder, preset)
    results = list(evaluate(wanted, folder, preset.test, runners, shown(normals)))
    second = [method for method in normals if method.second]  # rows of both tables
    tables = build_tables(results, [*lighting, *second] if lighting else [], normals)
    presets.save_resolved(preset, out / "eval")
    weights = {name: str(methods.file_of(out, name)) for method in (*lighting, *normals) for name in method.models()}
    write_json(out / "eval" / "results.json", results_json(results, tables, preset, weights))
    report.write(out / "report.html", preset, tables, results, out)
    sys.stdout.write("\n".join(render_text(f"\n{title}", *table, left=(0, 1)) for title, table in tables.items()))
    sys.stdout.write(f"\n{DEFINITION}\n{out / 'report.html'}\n")
    return 0


def rows(args: argparse.Namespace, out: Path, preset: Preset) -> tuple[list[Method], list[Method]]:
    """Return the methods of the lighting table and of the normal table.

    Raises:
        InputError: nothing is trained, or flags name what is not there.
    """
    constant = Method(name="constant predictor", normals="constant")
    if any((args.lights, args.normals, args.second, args.intensities)):
        method = methods.chosen(out, args.lights, args.normals, args.second, args.intensities)
        return [], [method, Method(name="least-squares, true lights", lights="true", normals="least-squares"), constant]
    lighting, normals = methods.lighting_methods(out, preset), methods.normal_methods(out)
    if not lighting and all(not method.models() for method in normals):
        raise InputError(
            f"{out / 'models'}: no trained models; train them with `sdps train --preset {preset.name} --out {out}`"
        )
    return [*lighting, constant], [*normals, constant]


def shown(normals: Sequence[Method]) -> list[str]:
    """Return the names of the methods whose normal maps the page shows: the paper's pair, or the first, and a rival."""
    first = next((method for method in normals if method.paper == "B1"), normals[0])
    return list(dict.fromkeys([first.name, "least-squares, true lights"]))


def evaluate(
    wanted: list[SceneSpec], folder: Path, config: TestConfig, runners: list["Runner"], pictured: list[str]
) -> Iterator[SceneResult]:
    """Score every scene, averaged over the repeats of random intensities; pictures are those of the first."""
    for scene in progress_bar(wanted, desc="evaluate", unit="scene"):
        shard = read_shard(folder / scene.file, scene)
        runs = [_evaluate_once(scene, shard, repeat, config, runners, pictured) for repeat in range(config.repeats)]
        first = runs[0]
        averaged = {method: _mean_scores([run.scores[method] for run in runs]) for method in first.scores}
        yield replace(first, scores=averaged)


def _mean_scores(repeats: list[dict[str, float]]) -> dict[str, float]:
    """Average each metric over the repeats; none of a method that failed in one of them."""
    if not all(repeats):
        return {}
    return {metric: float(np.mean([values[metric] for values in repeats])) for metric in repeats[0]}


def _evaluate_once(
    scene: SceneSpec,
    shard: Shard,
    repeat: int,
    config: TestConfig,
    runners: list["Runner"],
    pictured: list[str],
) -> SceneResult:
    """Draw intensities, run every method, and score it on what it estimates."""
    rng = generator(config.seed, scene.id, "intensities", repeat)
    gains = rng.uniform(*config.intensity_range, len(shard.images)).astype(np.float32)
    mask, lights = shard.mask, shard.light_directions
    images = shard.images.astype(np.float32) * gains[:, None, None, None] * mask[..., None]
    scores, normals, estimated = {}, {}, np.zeros((0, 3), np.float32)
    for runner in runners:
        name = runner.method.name
        try:
            estimate = runner.estimate(images, mask, lights, gains)
        except InputError as error:  # such as least squares under lights that were all estimated alike
            _log.warning("%s, %s: no score (%s)", scene.id, name, error)
            scores.setdefault(name, {})
            continue
        scores[name] = scores.get(name, {}) | runner.score(estimate, mask, shard.normals, lights, gains)
        if name in pictured and estimate.normals.size:
            normals[name] = estimate.normals
            estimated = estimate.light_directions if name == pictured[0] else estimated
    return SceneResult(
        scene=scene,
        scores=scores,
        mask=mask,
        truth=shard.normals,
        shown=tuple(pictured),
        normals={name: normals[name] for name in pictured if name in normals},
        true_lights=lights,
        lights=estimated,
        picture=images[np.argmax(images[:, mask].mean((1, 2)))].copy(),  # a view would keep the whole stack alive
    )


def build_tables(
    results: list[SceneResult], lighting: list[Method], normals: list[Method]
) -> dict[str, tuple[list[str], list[list[str]]]]:
    """Average over the materials of each shape: {title: (header, rows)}, all text."""
    shapes = list(dict.fromkeys(result.scene.shape for result in results))

    def cell(shape: str, method: Method, metric: str, paper: float | None) -> str:
        scored = [r.scores[method.name] for r in results if r.scene.shape == shape]
        values = [scores[metric] for scores in scored if metric in scores]
        text = number(float(np.mean(values))) if values else "-"
        text += f" ({number(paper)})" if paper is not None else ""
        return text + (f" [{len(scored) - len(values)} of {len(scored)} failed]" if len(values) < len(scored) else "")

    tables = {}
    if lighting:
        body = []
        for method in lighting:
            cells = []
            for shape in shapes:
                beside = _beside(published.LIGHTING, method.paper, shape, len(LIGHTING_COLUMNS))
                cells += [
                    cell(shape, method, metric, figure) for metric, figure in zip(LIGHTING_COLUMNS, beside, strict=True)
                ]
            body.append([method.paper or "-", method.name, *cells])
        header = ["row", "model", *(f"{shape} {name}" for shape in shapes for name in ("direction", "intensity"))]
        tables["Table A, lighting estimation"] = (header, body)
    body = [
        [method.paper or "-", method.name]
        + [cell(shape, method, "normal_mae", *_beside(published.NORMALS, method.paper, shape, 1)) for shape in shapes]
        for method in normals
    ]
    tables["Table B, normal estimation (MAE)"] = (["row", "model", *shapes], body)
    return tables


def _beside(table: dict[str, tuple], row: str, shape: str, count: int) -> tuple[float | None, ...]:
    """Return the paper's `count` figures of a row and shape, None where it has none."""
    if row not in table or shape not in published.SHAPES:
        return (None,) * count
    figures = table[row][1 + published.SHAPES.index(shape)]
    return figures if isinstance(figures, tuple) else (figures,)


def results_json(results: list[SceneResult], tables: dict, preset: Preset, weights: dict[str, str]) -> dict:
    """Collect everything a reader needs to judge the numbers."""
    return {
        "definition": DEFINITION,
        "weights": weights,
        "config": to_plain(preset.test),
        "tables": {title: {"header": header, "rows": rows} for title, (header, rows) in tables.items()},
        "scenes": [
            {"id": r.scene.id, "shape": r.scene.shape, "material": r.scene.material, "scores": r.scores}
            for r in results
        ],
    }
