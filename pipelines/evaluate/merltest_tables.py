"""Tables A and B of the paper from our scores, with the published figure beside ours in each cell."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from pipelines.evaluate import published
from pipelines.report.sections import Table
from pipelines.shared.presets import TestConfig
from pipelines.shared.text_tables import number
from render.records.manifest import SceneSpec
from sdps.methods.method import Method

LIGHTING_COLUMNS = ("direction_mae", "intensity_error")
MISSING = "not trained"


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
    header = ["row", "model", *(f"{shape} {name}" for shape in shapes for name in ("direction", "intensity"))]
    body = [
        [method.paper or "-", method.name]
        + [
            cell(results, shape, method.name, metric, figure)
            for shape in shapes
            for metric, figure in zip(
                LIGHTING_COLUMNS, published.figures(published.LIGHTING, method.paper, shape, 2), strict=True
            )
        ]
        for method in methods
    ]
    if all_rows:
        body += _missing(published.LIGHTING, methods, shapes, 2)
    return Table(title="Table A, lighting estimation", header=tuple(header), rows=_sorted(body))


def normal_table(results: Sequence[SceneScores], methods: Sequence[Method], *, all_rows: bool) -> Table:
    """Return table B: mean angular errors of normals; arguments as in `lighting_table`."""
    shapes = _shapes(results)
    body = [
        [method.paper or "-", method.name]
        + [
            cell(
                results, shape, method.name, "normal_mae", *published.figures(published.NORMALS, method.paper, shape, 1)
            )
            for shape in shapes
        ]
        for method in methods
    ]
    if all_rows:
        body += _missing(published.NORMALS, methods, shapes, 1)
    return Table(title="Table B, normal estimation (MAE)", header=("row", "model", *shapes), rows=_sorted(body))


def _shapes(results: Sequence[SceneScores]) -> list[str]:
    return list(dict.fromkeys(result.scene.shape for result in results))


def cell(results: Sequence[SceneScores], shape: str, name: str, metric: str, paper: float | None) -> str:
    """Write the mean over the scenes of a shape, the paper's figure in brackets, and how many scenes failed."""
    scored = [r.scores[name] for r in results if r.scene.shape == shape]
    values = [scores[metric] for scores in scored if metric in scores]
    text = number(float(np.mean(values))) if values else "-"
    text += f" ({number(paper)})" if paper is not None else ""
    return text + (f" [{len(scored) - len(values)} of {len(scored)} failed]" if len(values) < len(scored) else "")


def _missing(
    table: dict[str, tuple[Any, ...]], methods: Sequence[Method], shapes: Sequence[str], count: int
) -> list[list[str]]:
    """Return a row for each of the paper's that no method fills."""
    filled = {method.paper for method in methods}
    rows = []
    for row in table:
        if row not in filled:
            figures = [figure for shape in shapes for figure in published.figures(table, row, shape, count)]
            cells = [MISSING + ("" if figure is None else f" ({number(figure)})") for figure in figures]
            rows.append([row, table[row][0], *cells])
    return rows


def _sorted(rows: list[list[str]]) -> tuple[tuple[str, ...], ...]:
    """Put the paper's rows first, in its order; the others stay in theirs."""
    named = sorted((row for row in rows if row[0] != "-"), key=lambda row: row[0])
    return tuple(tuple(row) for row in [*named, *(row for row in rows if row[0] == "-")])
