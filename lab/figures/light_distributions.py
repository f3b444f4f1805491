"""True and estimated lights on the unit disc, as the paper's figure on light distributions shows them."""

import numpy as np
from matplotlib.figure import Figure

from lab.figures.sweep import Panel, choose_runners, finds, list_shapes
from lab.shared import line_charts
from pipelines.evaluate.evaluation import Result, TestObject
from pipelines.evaluate.report.sections import Table
from pipelines.evaluate.workbench import Workbench
from pipelines.shared import charts
from pipelines.shared.text_tables import number
from render.shared.seeds import spread_evenly

SCENES = 3  # per shape
COLUMNS = 3  # methods shown; all are in the table
Shown = dict[str, tuple[TestObject, list[tuple[str, Result]]]]
"""By scene: its object, and the results of the methods by their names."""


def make(bench: Workbench) -> Panel:
    """Evaluate and draw."""
    runners = choose_runners(bench, lambda method: finds(method, "direction_mae"),
                             "lights", "a method that finds the lights; add sdps or pf14")  # fmt: skip
    wanted, folder = bench.merltest()
    drawings, rows, values = [], [], {}
    for shape in list_shapes(wanted):
        chosen = spread_evenly([scene for scene in wanted if scene.shape == shape], min(SCENES, bench.config.pictures))
        panels: Shown = {}
        objects = (((scene, item), item) for scene, item in bench.objects(chosen, folder, bench.config))
        for (scene, item), runner, result in bench.evaluation.run(objects, runners, len(chosen), f"lights, {shape}"):
            name = runner.method.name
            panels.setdefault(scene.material, (item, []))[1].append((name, result))
            angle, gain = (result.scores.get(metric) for metric in ("direction_mae", "intensity_error"))
            rows.append((shape, scene.material, name, number(angle), number(gain)))
            values[f"{scene.id} | {name}"] = {"direction_mae": angle, "intensity_error": gain}
        caption = f"{shape.capitalize()}: lights as (x, y) on the unit disc, coloured by intensity over the highest."
        drawings.append((f"lights-{shape}", caption, _chart(panels)))
    text = (
        f"Light directions of the set {bench.config.lights} as points (x, y), x to the right and y up, coloured by "
        "intensity divided by the highest. Estimated lights are joined to the true ones by grey lines. Up to "
        f"{SCENES} scenes per shape, spread evenly over the materials; at most {COLUMNS} methods are drawn."
    )
    note = "Directions: mean angular error in degrees. Intensities: mean relative error after one least-squares scale."
    header = ("shape", "material", "method", "directions", "intensities")
    table = Table(title="Errors of the lights shown", header=header, rows=tuple(rows), note=note)
    return Panel("Light distributions, true and estimated", text, tuple(drawings), (table,), values)


def _chart(panels: Shown) -> Figure:
    """Draw a row per material: the true lights, then those of each method."""
    columns = 1 + min(COLUMNS, *(len(found) for _, found in panels.values()))
    figure = charts.new_figure(2.5 * columns + 0.6, 2.75 * len(panels))
    grid = figure.subplots(len(panels), columns, squeeze=False)
    for line, (material, (item, found)) in zip(grid, panels.items(), strict=True):
        assert item.intensities is not None, item.name
        points = charts.light_disc(line[0], item.true_directions, item.intensities)
        line[0].set_title(f"{material}\ntrue lights", fontsize=8)
        for axes, (name, result) in zip(line[1:], found, strict=False):
            if len(result.light_directions) == 0:
                axes.axis("off")
                axes.text(0.5, 0.5, "no estimate", ha="center", fontsize=8, color="0.4", transform=axes.transAxes)
            else:
                gains = result.intensities if len(result.intensities) else np.ones(len(result.light_directions))
                charts.light_disc(axes, result.light_directions, gains, item.light_directions)
            angle = result.scores.get("direction_mae")
            about = "refused" if angle is None else f"{angle:.1f}° off"
            axes.set_title(f"{line_charts.shorten(name)}\n{about}", fontsize=8)
    figure.colorbar(points, ax=grid, shrink=0.6, label="intensity / highest", aspect=30)
    return figure
