"""Error per material on BUNNY and the published curves (the paper's supplement)."""

import csv
from collections.abc import Iterator
from dataclasses import dataclass
from importlib import resources

import numpy as np
from matplotlib.figure import Figure
from scipy.stats import spearmanr

from lab.figures.sweep import LeftOut, Panel, choose_runners, paper_row, sweep
from lab.shared import line_charts
from pipelines.evaluate.evaluation import TestObject
from pipelines.evaluate.report.sections import Table
from pipelines.evaluate.workbench import Workbench, build_test_object
from pipelines.shared import charts
from pipelines.shared.text_tables import number
from render.records.manifest import SceneSpec
from render.shared.errors import InputError
from render.shared.files import read_text

SHAPE = "bunny"
FILE = "published/sdps_bunny_per_brdf.csv"
COLUMNS = {"B1": "SDPS_Net", "B0": "PS_FCN", "B5": "UPS_FCN_deep_mask", "B9": "UPS_FCN_retrain"}
LABELS = {"SDPS_Net": "SDPS-Net", "PS_FCN": "PS-FCN", "UPS_FCN_deep_mask": "UPS-FCN deep+mask",
          "UPS_FCN_retrain": "UPS-FCN retrain"}  # fmt: skip
HARDEST = 10


def read_published() -> dict[str, dict[str, float]]:
    """Return {method: {material: MAE in degrees}} of the published curves.

    Raises:
        InputError: the table that travels with the package is missing or damaged.
    """
    path = resources.files("assets") / FILE
    lines = [line for line in read_text(str(path)).splitlines() if not line.startswith("#")]
    try:
        rows = list(csv.DictReader(lines))
        return {name: {row["brdf"]: float(row[name]) for row in rows} for name in COLUMNS.values()}
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"{path}: damaged table ({error}); install the package again") from error


@dataclass(frozen=True)
class Curve:
    """A method's errors and the published curve it is compared with.

    Attributes:
        method: Its name.
        errors: MAE in degrees by material; without those it failed on.
        column: Column of the published curve.
    """

    method: str
    errors: dict[str, float]
    column: str

    def rank_correlation(self, curves: dict[str, dict[str, float]]) -> tuple[float, float, int]:
        """Return Spearman's rho with the published curve, its p-value and the number of materials; NaN where
        fewer than 3 errors differ."""
        shared = [name for name in self.errors if name in curves[self.column]]
        ours, theirs = ([column[name] for name in shared] for column in (self.errors, curves[self.column]))
        if len(set(ours)) < 3:
            return float("nan"), float("nan"), len(shared)
        found = spearmanr(ours, theirs)
        return float(found.statistic), float(found.pvalue), len(shared)


def make(bench: Workbench) -> Panel:
    """Evaluate and draw; errors are averaged over `test.repeats` draws of the intensities."""
    if SHAPE not in bench.config.shapes:
        raise LeftOut(f"materials needs {SHAPE} in test.shapes; the published curves are for it")
    runners = choose_runners(bench, lambda m: bool(m.normals), "materials", "a method that gives normals; add one")
    published = read_published()
    wanted, folder = bench.merltest()
    wanted = [scene for scene in wanted if scene.shape == SHAPE]

    def variants(scene: SceneSpec, _: TestObject) -> Iterator[tuple[tuple[str], TestObject]]:
        for repeat in range(bench.config.repeats):
            yield (scene.material,), build_test_object(scene, folder, bench.config, repeat)

    found = sweep(bench, runners, (wanted, folder), variants, bench.config.repeats, "materials")
    errors = {key: [one.scores.get("normal_mae", np.nan) for one in results] for key, results in found.items()}
    curves = []
    for method in (runner.method for runner in runners):  # without what it failed on in any of the repeats
        own = {material: values for (name, material), values in errors.items() if name == method.name}
        kept = {material: float(np.mean(values)) for material, values in own.items() if np.isfinite(values).all()}
        curves.append(Curve(method.name, kept, COLUMNS.get(paper_row(method), "SDPS_Net")))
    names = [scene.material for scene in wanted]
    reference = published["SDPS_Net"]
    order = sorted(names, key=lambda name: (reference.get(name, np.inf), name))
    text = (
        f"Normals of {SHAPE} with {len(names)} materials under the lights of {bench.config.lights}, "
        f"{bench.config.repeats} draw(s) of random intensities. Materials are in the order of the published SDPS-Net "
        "curve. Grey: the paper's curves, of its own rendering, digitised from the vector figure of its poster."
    )
    values = {
        curve.method: {"rank_correlation": rho if np.isfinite(rho) else None, "beside": curve.column,
                       "normal_mae": curve.errors}
        for curve in curves
        for rho in curve.rank_correlation(published)[:1]
    }  # fmt: skip
    chart = ("materials", "Mean angular error of normals per material.", _chart(curves, order, published))
    return Panel(
        "Error per material", text, (chart,), (_summarise(curves, published), _list_hardest(curves, published)), values
    )


def _summarise(curves: list[Curve], published: dict[str, dict[str, float]]) -> Table:
    rows = []
    for curve in curves:
        rho, p, count = curve.rank_correlation(published)
        theirs = [published[curve.column][name] for name in curve.errors if name in published[curve.column]]
        rows.append((
            curve.method, number(float(np.mean(list(curve.errors.values())))) if curve.errors else "-",
            LABELS[curve.column], number(float(np.mean(theirs))) if theirs else "-",
            number(rho, 2), f"{p:.1g}" if np.isfinite(p) else "-", str(count),
        ))  # fmt: skip
    note = "Mean angular error in degrees over mask pixels. Spearman's rank correlation over the materials."
    header = ("method", "mean", "published curve", "its mean, same materials", "rank correlation", "p", "materials")
    return Table(title=f"Error per material: {SHAPE}", header=header, rows=tuple(rows), note=note)


def _list_hardest(curves: list[Curve], published: dict[str, dict[str, float]]) -> Table:
    """List the materials the first method finds hardest."""
    first = curves[0].errors
    names = sorted(first, key=lambda name: first[name], reverse=True)[:HARDEST]
    rows = tuple(
        (name, *(number(c.errors.get(name)) for c in curves),
         *(number(column.get(name)) for column in published.values()))
        for name in names
    )  # fmt: skip
    header = ("material", *(c.method for c in curves), *(f"{LABELS[name]}, published" for name in published))
    return Table(title=f"Hardest materials of {curves[0].method}", header=header, rows=rows, note="Degrees, as above.")


def _chart(curves: list[Curve], order: list[str], published: dict[str, dict[str, float]]) -> Figure:
    figure = charts.new_figure(max(7.0, 2.6 + 0.105 * len(order)), 5.2)
    axes, x = figure.add_subplot(), np.arange(len(order))
    chart = line_charts.LineChart(axes)
    for style, (name, column) in enumerate(published.items()):
        y = [column.get(material, np.nan) for material in order]
        axes.plot(
            x,
            y,
            color=line_charts.PUBLISHED,
            lw=1.6 if style == 0 else 0.9,
            ls=line_charts.LINE_STYLES[style],
            zorder=1,
        )
        chart.end(f"{LABELS[name]}, published", y, "0.35")
    for place, curve in enumerate(curves):
        y = [curve.errors.get(material, np.nan) for material in order]
        chart.line(place, line_charts.shorten(curve.method), x, y, ms=3.5, lw=0.9, zorder=3)
    axes.set_xticks(x, order, rotation=90, fontsize=6 if len(order) > 40 else 8)
    axes.set(ylabel="normals, mean angular error (degrees)", xlim=(-0.5, len(order) - 0.5))
    chart.finish(gap=0.05)
    return figure
