"""Error of calibrated methods against the number of light classes (paper sec. 4.1 and its figure on discretisation).

With K_d bins each of azimuth and elevation, a light lies at most delta = 180 / (2 K_d) degrees in each angle from the
centre of its class. Every true light is replaced by the four directions at that distance in both angles; the error is
the worst of the four means, an upper bound of what discretisation costs.
"""

from collections.abc import Iterator
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from lab.figures.sweep import Panel, average, choose_runners, list_shapes, paper_row, sweep, vary
from lab.shared import line_charts
from pipelines.evaluate import published
from pipelines.evaluate.evaluation import TestObject
from pipelines.evaluate.report.sections import Table
from pipelines.evaluate.score_tables import Mean
from pipelines.evaluate.workbench import Workbench
from pipelines.shared import charts
from pipelines.shared.text_tables import number
from render.planning import light_sets
from render.records.manifest import SceneSpec
from sdps.core.lighting import LightClasses, azimuth_elevation, unit_direction
from sdps.core.metrics import angle_degrees
from sdps.methods.runner import Runner
from sdps.models.registry import TRUE_LIGHTS

BINS = (2, 4, 6, 10, 18, 30, 36, 60, 90, 180)
CORNERS = ((1, 1), (1, -1), (-1, 1), (-1, -1))
_EXACT = 0  # stands for an infinite number of bins
_INFINITY_AT = 360  # where the axis shows it


def half_bin(count: int) -> float:
    """Return delta, half the width of a class in degrees."""
    return 180.0 / (2 * count)


def deviate(directions: np.ndarray, count: int, corner: tuple[int, int]) -> np.ndarray:  # (L, 3) float32
    """Move lights by half a class in azimuth and in elevation.

    Angles are kept within +-(90 - delta) degrees, the range of class centres: no class lies nearer to the horizon or
    to a pole, so lights there deviate by less than delta.

    Args:
        directions: (L, 3).
        count: K_d, bins of each angle.
        corner: Signs of the two steps.
    """
    delta = half_bin(count)
    angles = azimuth_elevation(np.asarray(directions, np.float64))
    azimuth, elevation = (
        np.clip(angle + sign * delta, delta - 90.0, 90.0 - delta) for angle, sign in zip(angles, corner, strict=True)
    )
    return unit_direction(azimuth, elevation).astype(np.float32)


def centre_floor(directions: np.ndarray, count: int) -> float:
    """Return the mean angle in degrees between lights (L, 3) and the centres of their classes.

    It is what a perfect classifier scores: 1.86 degrees on the 96 DiLiGenT lights with 36 bins.
    """
    classes = LightClasses(directions=count)
    azimuth, elevation, intensity = classes.encode(np.asarray(directions, np.float64), np.ones(len(directions)))
    return float(angle_degrees(classes.decode(azimuth, elevation, intensity)[0], directions).mean())


def make(bench: Workbench) -> Panel:
    """Evaluate and draw."""
    runners = choose_runners(bench, lambda method: method.lighting == TRUE_LIGHTS,
                             "bins", "a method that is given the lights; add psfcn or least-squares")  # fmt: skip
    wanted, folder = bench.merltest()

    def variants(scene: SceneSpec, item: TestObject) -> Iterator[tuple[tuple[Any, ...], TestObject]]:
        for count in (_EXACT, *BINS):
            for place, variant in enumerate(_deviations(item, count)):
                yield (scene.shape, count, place), variant

    corners: dict[tuple[str, str, int], list[Mean]] = {}  # by method, shape, bins
    for (*key, _), results in sweep(bench, runners, (wanted, folder), variants, 4 * len(BINS) + 1, "bins").items():
        corners.setdefault(tuple(key), []).append(average(results)["normal_mae"])
    errors = {key: _worst(means) for key, means in corners.items()}
    shapes = list_shapes(wanted)
    directions = light_sets.load(bench.config.lights)
    text = (
        f"Normals of methods that are given the lights, on {len(wanted)} MERL-Test scenes of {len(directions)} lights "
        f"({bench.config.lights}). Every true light is replaced by each of the four directions half a class away in "
        "azimuth and in elevation, delta = 180/(2 K_d) degrees; shown is the worst of the four means over materials. "
        "Angles stay within the range of class centres, +-(90 - delta) degrees. Intensities are the true ones."
    )
    values = {
        f"{method} | {shape}": {"exact" if not k else str(k): errors[method, shape, k].plain() for k in (*BINS, _EXACT)}
        for method, shape in dict.fromkeys((m, s) for m, s, _ in errors)
    }
    chart = ("bins", "Upper bound of the normals' error by the number of bins K_d.", _chart(runners, shapes, errors))
    return Panel("Error against the number of light classes", text, (chart,),
                 (_table(runners, shapes, errors, directions),),
                 {"normal_mae": values, "class_centre_floor": {str(k): centre_floor(directions, k) for k in BINS}},
                )  # fmt: skip


def _deviations(item: TestObject, count: int) -> list[TestObject]:
    """Return the object with its true lights, or with each of the four sets of deviated ones."""
    if count == _EXACT:
        return [item]
    lights = {corner: deviate(item.true_directions, count, corner) for corner in CORNERS}
    return [
        vary(item, f"K_d {count} {x:+d}{y:+d}", moved.tobytes(), light_directions=moved)
        for (x, y), moved in lights.items()
    ]


def _worst(corners: list[Mean]) -> Mean:
    """Return the largest mean; NaN, where nothing was scored, counts as least."""
    return max(corners, key=lambda item: item.value if np.isfinite(item.value) else -1.0)


def _find_published(runner: Runner, shape: str) -> float | None:
    """Return the paper's figure for true lights (row B0)."""
    return published.figures(published.NORMALS, "B0", shape)[0] if paper_row(runner.method) == "B0" else None


def _table(
    runners: list[Runner], shapes: tuple[str, ...], errors: dict[tuple[str, str, int], Mean], directions: np.ndarray
) -> Table:
    columns = [(runner, shape) for runner in runners for shape in shapes]
    rows = []
    for count in (*BINS, _EXACT):
        cells = [
            errors[r.method.name, s, count].cell(_find_published(r, s) if count == _EXACT else None) for r, s in columns
        ]
        angles = ["0", "0", "0"]
        if count:
            moved = max(angle_degrees(deviate(directions, count, c), directions).mean() for c in CORNERS)
            angles = [f"{half_bin(count):g}", number(float(moved)), number(centre_floor(directions, count))]
        rows.append((str(count) if count else "infinite", *angles, *cells))
    header = ("K_d", "delta", "moved by", "class centres", *(f"{r.method.name}, {s}" for r, s in columns))
    note = (
        "Degrees. Moved by: mean angle of the lights to the worst of the four directions. Class centres: mean angle to "
        "the centre of the true class, what a perfect classifier scores. Other columns: mean angular error of normals "
        "over mask pixels and materials, worst of four; in brackets the paper's."
    )
    return Table(title="Normals by number of light classes (upper bound)", header=header, rows=tuple(rows), note=note)


def _chart(runners: list[Runner], shapes: tuple[str, ...], errors: dict[tuple[str, str, int], Mean]) -> Figure:
    figure = charts.new_figure(8.0, 4.4)
    axes, x = figure.add_subplot(), [*BINS, _INFINITY_AT]
    chart = line_charts.LineChart(axes)
    for place, runner in enumerate(runners):
        for style, shape in enumerate(shapes):
            y = [errors[runner.method.name, shape, count].value for count in (*BINS, _EXACT)]
            axes.plot(x[:-1], y[:-1], color=line_charts.colour(place), ls=line_charts.LINE_STYLES[style % 4])
            chart.line(place, f"{line_charts.shorten(runner.method.name)}, {shape}", x, y, ls=":", lw=0.8)
            chart.point(f"PS-FCN, {shape}: published", x[-1], _find_published(runner, shape))
    axes.axvline(36, color="0.8", lw=0.8)
    chart.ticks(x, [*map(str, BINS), "∞"])
    axes.set(xlabel="bins of azimuth and of elevation, $K_d$ (∞: true lights)", xlim=(1.8, _INFINITY_AT * 1.08))
    axes.set(ylabel="normals, mean angular error (degrees),\nworst of four deviations")
    chart.finish()
    axes.text(36, axes.get_ylim()[1], "the paper's 36", fontsize=7, color="0.4", ha="center", va="bottom")
    return figure
