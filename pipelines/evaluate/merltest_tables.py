"""What is shown of MERL-Test: tables A and B of the paper with the published figures beside ours, and pictures."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from pipelines.evaluate import published
from pipelines.evaluate.object_pictures import ERROR_LIMIT, tiles
from pipelines.evaluate.report.sections import Section, SectionWriter, Table
from pipelines.evaluate.results import mean
from pipelines.evaluate.workbench import Workbench, lit_object
from pipelines.shared.pictures import spread
from pipelines.shared.presets import TestConfig
from pipelines.shared.text_tables import number
from render.records.manifest import SceneSpec
from sdps.methods.method import Method
from sdps.methods.runner import Runner

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


def definition(config: TestConfig) -> str:
    """Return what the tables' numbers are and what the methods saw."""
    margin = config.margin_of((config.size, config.size))
    seen = "whole frame" if margin is None else f"object's box with {margin} pixels of margin"
    return (
        "Means over scenes (one per material). Normals: mean angular error in degrees over mask pixels. Directions: "
        "mean angular error in degrees over images. Intensities: mean relative error after one least-squares scale. "
        "Inputs: linear half-float radiance times random intensities, multiplied by the mask; networks see the "
        f"{seen}. In brackets: the paper's figure, of its own rendering of the same materials."
    )


def lighting_table(results: Sequence[SceneScores], methods: Sequence[Method], *, all_rows: bool) -> Table:
    """Return table A: light directions and intensities.

    Args:
        results: Scores of every scene.
        methods: One per row.
        all_rows: Also list the paper's rows that no method fills.
    """
    shapes = _shapes(results)
    header = ("row", "model", *(f"{shape} {name}" for shape in shapes for name in ("direction", "intensity")))
    body = _rows(results, methods, published.LIGHTING, LIGHTING_METRICS, all_rows)
    return Table(title="Table A, lighting estimation", header=header, rows=body)


def normal_table(results: Sequence[SceneScores], methods: Sequence[Method], *, all_rows: bool) -> Table:
    """Return table B: mean angular errors of normals; arguments as in `lighting_table`."""
    header = ("row", "model", *_shapes(results))
    body = _rows(results, methods, published.NORMALS, ("normal_mae",), all_rows)
    return Table(title="Table B, normal estimation (MAE)", header=header, rows=body)


def _rows(
    results: Sequence[SceneScores],
    methods: Sequence[Method],
    paper: dict[str, list[Any]],
    metrics: tuple[str, ...],
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
            cells = [MISSING + ("" if figure is None else f" ({number(figure)})") for figure in figures]
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
        f"{repeats}. {definition(config)}{networks} "
        f"Error maps run from 0 (black) to {ERROR_LIMIT:g} degrees (yellow)."
    )
    names = [runner.method.name for runner in runners]
    section = Section(name="merltest", title="MERL-Test scenes", text=text, order=10, tables=tuple(tables),
                      command=f"sdps evaluate merltest --preset {bench.preset.name} --out {bench.out}")  # fmt: skip
    writer = SectionWriter(section)
    for result in choose(results, names[0], config.pictures):
        item = lit_object(result.scene, folder, config)
        kept = bench.evaluation.results(item, runners, names)
        found = {name: {item.name: one} for name, one in zip(names, kept, strict=True)}
        writer.strip(f"{result.scene.shape}, {result.scene.material}", tiles(item, found, names))
    writer.write(bench.out)
    single = Section(name="merltest-scenes", title="MERL-Test, scene by scene", text="", order=15,
                     tables=(_per_scene(results, names),))  # fmt: skip
    SectionWriter(single).write(bench.out)


def choose(results: Sequence[SceneScores], name: str, count: int) -> list[SceneScores]:
    """Pick scenes of each shape spread from the best to the worst normal error, so the page shows both ends."""
    chosen = []
    for shape in dict.fromkeys(result.scene.shape for result in results):
        ranked = sorted((r for r in results if r.scene.shape == shape), key=lambda r: _error(r, name))
        chosen += spread(ranked, count)
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

    def cell(scores: dict[str, float], metric: str, digits: int) -> str:
        return f"{scores[metric]:.{digits}f}" if metric in scores else "-"

    rows = [
        (r.scene.shape, r.scene.material, *(cell(r.scores[name], metric, digits) for name, metric, _, digits in wanted))
        for r in sorted(results, key=lambda r: _error(r, names[0]), reverse=True)
    ]
    header = ("shape", "material", *(f"{name}: {about}" for name, _, about, _ in wanted))
    return Table(title="Per scene, worst first", header=header, rows=tuple(rows))
