"""Classical PF14 against SDPS-Net by kind of reflectance and of lights (paper sec. 5.1 and its figure on PF14)."""

import colorsys
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from matplotlib.figure import Figure

from lab.figures.sweep import METRICS, LeftOut, Panel, average, choose_runners, finds, paper_row, sweep
from lab.shared import line_charts
from pipelines.evaluate.evaluation import TestObject
from pipelines.evaluate.published import POSTER
from pipelines.evaluate.report.sections import Table
from pipelines.evaluate.score_tables import Mean
from pipelines.evaluate.workbench import Workbench
from pipelines.shared import charts, scenes
from render.materials import library
from render.planning import light_sets
from render.planning.plan import material_pool
from render.records.manifest import SceneSpec
from render.shared.seeds import spread_evenly
from sdps.methods.method import Method
from sdps.methods.runner import Runner

LIGHT_SETS = ("near-uniform:100", "biased:100")
GROUPS = ("lambertian", "fabric", "plastic", "phenolic")
SHAPE = "bunny"
LAMBERTIAN = 15
Means = dict[tuple[str, str, str, str], Mean]
"""(method, light set, group, metric)."""


def list_albedos(count: int = LAMBERTIAN) -> list[str]:
    """Return Lambertian materials: a third greys from 0.1 to 0.9, the others colours of evenly spaced hues.

    The paper does not say which it took. A grey albedo only scales the images but for interreflection, hence colours.
    """
    greys = max(1, count // 3)
    colours = count - greys
    names = [f"lambertian:{value:.2g}" for value in np.linspace(0.1, 0.9, greys)]
    for place in range(colours):
        rgb = colorsys.hsv_to_rgb(place / colours, 0.6, 0.8 if place % 2 else 0.4)
        names.append("lambertian:" + "/".join(f"{value:.2g}" for value in rgb))
    return names


def group_materials(chosen: tuple[str, ...]) -> dict[str, list[str]]:
    """Return the materials of each group that `test.materials` leaves.

    All 15 + 12 + 9 + 12 where it is `all`. Otherwise the named ones; Lambertian ones that are not named are as large a
    share of the 15 as the others are of their groups, at least one.

    Raises:
        LeftOut: no material of the measured groups is among them.
    """
    pool, kinds = material_pool(chosen), library.categories()
    found = {group: [name for name in pool if name in kinds[group]] for group in GROUPS[1:]}
    kept = sum(map(len, found.values()))
    if not kept:
        raise LeftOut(f"pf14 needs materials of {', '.join(GROUPS[1:])}; add some to test.materials")
    named = [name for name in pool if name.startswith("lambertian:")]
    share = kept / sum(len(kinds[group]) for group in GROUPS[1:])
    some = spread_evenly(list_albedos(), max(1, round(share * LAMBERTIAN)))
    return {"lambertian": named or some} | {group: names for group, names in found.items() if names}


def make(bench: Workbench) -> Panel:
    """Render the two light sets, evaluate and draw."""
    runners = choose_runners(bench, lambda method: all(finds(method, metric) for metric in METRICS),
                             "pf14", "methods that find lights and normals; add sdps or pf14")  # fmt: skip
    shape = SHAPE if SHAPE in bench.config.shapes else bench.config.shapes[-1]
    kinds = group_materials(bench.config.materials)
    means: Means = {}
    for lights in LIGHT_SETS:
        means |= _evaluate(bench, runners, shape, kinds, lights)
    methods = [runner.method for runner in runners]
    counted = ", ".join(f"{len(names)} {group}" for group, names in kinds.items())
    note = "Grey diamonds and brackets: read off the paper's poster. " if shape == SHAPE else ""
    text = (
        f"{shape.capitalize()} with {counted} materials under {' and '.join(LIGHT_SETS)} lights (uniform on the unit "
        f"disc of x and y; biased: its part y > {light_sets.BIASED_MIN_Y}), with random intensities. {note}"
        "The Lambertian materials and the lights are ours; the paper's are not known."
    )
    tables = tuple(_table(methods, tuple(kinds), means, metric, shape) for metric in METRICS)
    caption = "Errors by kind of reflectance; plain bars: near-uniform lights, hatched: biased lights."
    drawn = (
        ("pf14", caption, _chart(methods, tuple(kinds), means, shape)),
        ("pf14-lights", "The two light sets as (x, y) on the unit disc.", _draw_light_sets()),
    )
    values = {" | ".join(key): {"mean": m.plain(), "failed": m.failed} for key, m in means.items()}
    return Panel("Classical PF14 against SDPS-Net", text, drawn, tables, {"materials": kinds, "means": values})


def _evaluate(bench: Workbench, runners: list[Runner], shape: str, kinds: dict[str, list[str]], lights: str) -> Means:
    """Return the means under one light set."""
    materials = tuple(name for names in kinds.values() for name in names)
    config = replace(bench.config, shapes=(shape,), materials=materials, lights=lights)
    wanted, folder = bench.render(config, bench.out / "figures" / scenes.slug(lights))
    group_of = {name: group for group, names in kinds.items() for name in names}

    def variants(scene: SceneSpec, item: TestObject) -> Iterator[tuple[tuple[str], TestObject]]:
        yield (group_of[scene.material],), replace(item, name=f"{item.name}, {lights}")

    found = sweep(bench, runners, (wanted, folder), variants, 1, lights)
    return {
        (method, lights, group, metric): value
        for (method, group), results in found.items()
        for metric, value in average(results).items()
    }


def find_published(method: Method, metric: str, group: str, lights: str, shape: str) -> float | None:
    """Return the paper's figure, or None."""
    row = POSTER[metric].get(paper_row(method))
    return row[GROUPS.index(group)][LIGHT_SETS.index(lights)] if row and shape == SHAPE else None


def _table(methods: list[Method], kinds: tuple[str, ...], means: Means, metric: str, shape: str) -> Table:
    rows = [
        (
            method.name,
            lights.split(":")[0],
            *(
                means[method.name, lights, g, metric].cell(find_published(method, metric, g, lights, shape))
                for g in kinds
            ),
        )
        for method in methods
        for lights in LIGHT_SETS
    ]
    title, unit = METRICS[metric]
    note = f"{unit.capitalize()}, mean over the materials of a group; in brackets the paper's, read off its poster."
    header = ("method", "lights", *kinds)
    return Table(title=f"{title} by kind of reflectance: {shape}", header=header, rows=tuple(rows), note=note)


def _chart(methods: list[Method], kinds: tuple[str, ...], means: Means, shape: str) -> Figure:
    figure = charts.new_figure(8.0, 7.6)
    bars = len(methods) * len(LIGHT_SETS)
    width = 0.84 / bars
    for row, (metric, (title, unit)) in enumerate(METRICS.items()):
        axes = figure.add_subplot(len(METRICS), 1, row + 1)
        for place, method in enumerate(methods):
            for number, lights in enumerate(LIGHT_SETS):
                x = np.arange(len(kinds)) + (place * len(LIGHT_SETS) + number - (bars - 1) / 2) * width
                heights = [means[method.name, lights, group, metric].value for group in kinds]
                axes.bar(
                    x, np.nan_to_num(heights), width * 0.92, color=line_charts.colour(place),
                    alpha=0.55 if number else 1.0, hatch="////" if number else None, edgecolor="white", lw=0,
                    label=f"{line_charts.shorten(method.name)}, {lights.split(':')[0]}",
                )  # fmt: skip
                known = [find_published(method, metric, group, lights, shape) for group in kinds]
                points = [(at, value) for at, value in zip(x, known, strict=True) if value is not None]
                if points:
                    axes.plot(*zip(*points, strict=True), "D", color="0.25", mfc="0.85", ms=5, ls="", zorder=5)
        axes.set_xticks(range(len(kinds)), [kind.capitalize() for kind in kinds])
        axes.set(ylabel=unit, title=title)
        line_charts.tidy(axes)
        if row == 0:
            handles, labels = axes.get_legend_handles_labels()
    if shape == SHAPE:
        handles.append(axes.plot([], [], "D", color="0.25", mfc="0.85", ms=5, ls="")[0])
        labels.append("published (same bar)")
    figure.legend(handles, labels, loc="outside upper center", ncols=len(methods) + 1, fontsize=8, frameon=False)
    return figure


def _draw_light_sets() -> Figure:
    figure = charts.new_figure(5.4, 2.9)
    for axes, lights in zip(figure.subplots(1, len(LIGHT_SETS)), LIGHT_SETS, strict=True):
        directions = light_sets.load(lights)
        charts.light_disc(axes, directions, np.ones(len(directions)))
        axes.set_title(lights, fontsize=9)
    return figure
