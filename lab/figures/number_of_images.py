"""Error against the number of images (paper sec. 5.1, its figure on input image numbers).

Each draw puts the lights in a random order; a set of n images is the first n of it, so that sets of one draw are nested
and all objects and methods see the same ones.
"""

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from lab.figures.sweep import METRICS, Panel, average, finds, list_shapes, paper_row, sweep, vary
from lab.shared import line_charts
from pipelines.evaluate import published
from pipelines.evaluate.evaluation import TestObject
from pipelines.evaluate.report.sections import Table
from pipelines.evaluate.score_tables import Mean
from pipelines.evaluate.workbench import Workbench
from pipelines.shared import charts
from pipelines.shared.text_tables import number
from render.records.manifest import SceneSpec
from render.shared.seeds import generator
from sdps.methods.method import Method

COUNTS = (2, 4, 8, 16, 32, 64)
Points = dict[tuple[str, str, int], list[dict[str, Mean]]]
"""(method, shape, images): for every draw the mean of each metric over materials."""


def draw_subsets(total: int, draws: int, seed: int) -> list[tuple[int, int, np.ndarray]]:
    """Return (images, draw, their places) with every count below `total` once per draw, and all images once."""
    chosen = []
    for draw in range(draws):
        order = generator(seed, "image subset", draw).permutation(total)
        chosen += [(count, draw, np.sort(order[:count])) for count in COUNTS if count < total]
    return [*chosen, (total, 0, np.arange(total))]


def select_images(item: TestObject, count: int, draw: int, places: np.ndarray) -> TestObject:
    """Return an object, whose images are an array, seen in some of them only."""
    if count == len(item.true_directions):
        return item
    return vary(
        item, f"{count} images, draw {draw}", places.astype(np.int64).tobytes(),
        load=lambda: np.asarray(item.load())[places], light_directions=item.true_directions[places],
        intensities=None if item.intensities is None else item.intensities[places],
    )  # fmt: skip


def make(bench: Workbench) -> Panel:
    """Evaluate and draw."""
    wanted, folder = bench.merltest()
    chosen = draw_subsets(len(wanted[0].lights), bench.draws, bench.config.seed)

    def variants(scene: SceneSpec, item: TestObject) -> Iterator[tuple[tuple[Any, ...], TestObject]]:
        for count, draw, places in chosen:
            yield (scene.shape, count, draw), select_images(item, count, draw, places)

    points: Points = {}
    found = sweep(bench, bench.runners, (wanted, folder), variants, len(chosen), "images")
    for (method, shape, count, _), results in found.items():
        points.setdefault((method, shape, count), []).append(average(results))
    methods = [runner.method for runner in bench.runners]
    shapes = list_shapes(wanted)
    counts = tuple(dict.fromkeys(count for count, _, _ in sorted(chosen, key=lambda part: part[0])))
    text = (
        f"{len(wanted)} MERL-Test scenes ({bench.config.lights}); {bench.draws} random subsets of each number of "
        "images, the same for all scenes and methods, and all images once. Lines: mean over materials and draws. "
        "Bands: from the lowest to the highest draw. Grey diamonds: the paper's figures for all images. A method given "
        "the true lights is scored on normals only."
    )
    drawn = tuple(
        (f"images-{shape}", f"{shape.capitalize()}: error against the number of images.",
         _chart(methods, shape, counts, points))
        for shape in shapes
    )  # fmt: skip
    tables = [_table(methods, shape, counts, points, metric) for shape in shapes for metric in METRICS]
    values = {
        f"{method} | {shape} | {count}": {name: [draw[name].plain() for draw in draws] for name in METRICS}
        for (method, shape, count), draws in points.items()
    }
    return Panel("Error against the number of images", text, drawn, tuple(each for each in tables if each.rows), values)


def _summarise(draws: Sequence[dict[str, Mean]], metric: str) -> tuple[float, float, float, int]:
    """Return mean, lowest and highest over the draws, and how many objects failed in all of them."""
    values = [draw[metric].value for draw in draws if np.isfinite(draw[metric].value)]
    failed = sum(draw[metric].failed for draw in draws)
    if not values:
        return np.nan, np.nan, np.nan, failed
    return float(np.mean(values)), min(values), max(values), failed


def _find_published(method: Method, shape: str, metric: str) -> float | None:
    """Return the paper's figure for all images, where it has the method and shape."""
    row = paper_row(method)
    if metric == "normal_mae":
        return published.figures(published.NORMALS, row, shape)[0]
    if row in ("B1", "B2"):  # both with LCNet's lights, row A0
        return published.figures(published.LIGHTING, "A0", shape, 2)[0 if metric == "direction_mae" else 1]
    return None


def _table(methods: Sequence[Method], shape: str, counts: tuple[int, ...], points: Points, metric: str) -> Table:
    rows = []
    for method in (method for method in methods if finds(method, metric)):
        cells = []
        for count in counts:
            middle, low, high, failed = _summarise(points[method.name, shape, count], metric)
            text = number(middle) + (f" [{number(low)}, {number(high)}]" if high > low else "")
            cells.append(text + (f" {failed} failed" if failed and np.isfinite(middle) else ""))
        known = _find_published(method, shape, metric)
        rows.append((method.name, *cells, number(known)))
    title, unit = METRICS[metric]
    header = ("method", *map(str, counts), f"published, {counts[-1]}" if counts[-1] == 100 else "published, 100")
    note = f"{unit.capitalize()}, mean over materials and draws; in brackets the lowest and the highest draw."
    return Table(title=f"{title} by number of images: {shape}", header=header, rows=tuple(rows), note=note)


def _chart(methods: Sequence[Method], shape: str, counts: tuple[int, ...], points: Points) -> Figure:
    shown = {m: item for m, item in METRICS.items() if any(finds(method, m) for method in methods)}
    figure = charts.new_figure(8.0, 2.9 * len(shown))
    for row, (metric, (title, unit)) in enumerate(shown.items()):
        axes = figure.add_subplot(len(shown), 1, row + 1)
        chart = line_charts.LineChart(axes)
        for place, method in enumerate(methods):
            if not finds(method, metric):
                continue
            drawn = [_summarise(points[method.name, shape, count], metric) for count in counts]
            middle, low, high = (np.array(part) for part in list(zip(*drawn, strict=True))[:3])
            axes.fill_between(counts, low, high, color=line_charts.colour(place), alpha=0.18, lw=0)
            chart.line(place, line_charts.shorten(method.name), counts, middle)
            if counts[-1] == 100:
                paper = published.NORMALS.get(paper_row(method), ("",))[0]
                chart.point(f"{paper}, published", 100, _find_published(method, shape, metric))
        chart.ticks(counts, list(map(str, counts)), base=2)
        axes.set(ylabel=unit, title=f"{title}, {shape}", xlabel="images")
        chart.finish(gap=0.09)
    return figure
