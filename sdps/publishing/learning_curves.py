"""Learning curves of a run from their `metrics.jsonl`."""

import math
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from render.shared.errors import InputError
from render.shared.files import atomic_path, parse_json, read_text

Rows = list[dict[str, float]]

_STYLE: Any = {
    "font.size": 10, "axes.spines.right": False, "axes.grid": True, "grid.alpha": 0.3, "legend.frameon": False,
    "legend.fontsize": 8.5, "axes.titlesize": 10,
}  # fmt: skip
_DPI = 100
_WIDTH = 10.0  # inches, so 1,000 pixels
_SMOOTHED = 0.05  # share of a curve's points that one smoothed point averages
_UNITS = {"mae": "degrees", "error": "relative error", "loss": "loss", "rate": "learning rate", "second": "images/s"}


class _Panel(NamedTuple):
    """What one plot shows."""

    title: str
    unit: str
    names: list[str]


def read_metrics(path: str | Path) -> Rows:
    """Read a `metrics.jsonl`, one dict per line, each with its `step`; a half-written last line is passed over.

    Raises:
        InputError: missing or empty file, or a line that does not hold metrics.
    """
    rows: Rows = []
    lines = read_text(path).splitlines()
    for number, line in enumerate(lines, start=1):
        try:
            row = parse_json(line)
        except ValueError as error:
            if number == len(lines):  # the run is being written, or was killed at it
                break
            raise InputError(f"{path}: line {number} is not JSON ({error}); train this run again") from error
        if not isinstance(row, dict) or not isinstance(row.get("step"), int):
            raise InputError(f"{path}: line {number} has no step, so it does not hold metrics; train this run again")
        rows.append({key: value for key, value in row.items() if isinstance(value, int | float)})
    if not rows:
        raise InputError(f"{path}: holds no metrics yet; wait for the first line or train longer")
    return rows


def write_curves(metrics_file: str | Path, picture: str | Path) -> None:
    """Draw the learning curves of a run: loss, validation errors, learning rate and speed over steps and hours.

    Args:
        metrics_file: The run's `metrics.jsonl`.
        picture: PNG to write, 1,000 pixels wide.

    Raises:
        InputError: no metrics there, or an unwritable disk.
    """
    rows = read_metrics(metrics_file)
    panels = _panels(rows)
    if not panels:
        raise InputError(f"{metrics_file}: holds steps but no figures to plot; train this run again")
    columns = min(2, len(panels))
    high = math.ceil(len(panels) / columns)
    with rc_context(_STYLE):
        figure = Figure(figsize=(_WIDTH, 3.1 * high), dpi=_DPI, layout="constrained")
        for number, panel in enumerate(panels):
            axes = figure.add_subplot(high, columns, number + 1)
            _draw(axes, rows, panel)
            _hours_above(axes, rows, label=number < columns)
        with atomic_path(picture) as temporary:
            figure.savefig(temporary)


def metric_figure(runs: Mapping[str, Rows], value: str, title: str) -> Figure:
    """Return a small chart of one metric of several runs, against minutes where every run recorded its time."""
    with rc_context(_STYLE):
        figure = Figure(figsize=(4.6, 2.6), dpi=_DPI, layout="constrained")
        axes = figure.add_subplot()
        _draw_runs(axes, runs, value, "minutes" if all(map(_has_times, runs.values())) else "step")
        axes.set_ylabel(title)
        if len(runs) > 1:
            axes.legend()
    return figure


def _draw_runs(axes: Axes, runs: Mapping[str, Rows], value: str, against: str) -> None:
    """Plot a metric of runs against `step`, `hours` or `minutes`; runs without a clock only against steps."""
    for place, (name, rows) in enumerate(runs.items()):
        places, values = series(rows, value)
        if against != "step":
            if not _has_times(rows):
                continue
            places = _hours(rows, places) * (60 if against == "minutes" else 1)
        marker = "o" if value.startswith("val_") else None
        # Beyond the ten colours of the cycle, another line.
        axes.plot(places, values, lw=1.3, color=f"C{place % 10}", label=name, ls=("-", "--", ":")[place // 10 % 3],
                  marker=marker, ms=3)  # fmt: skip
    axes.set(xlabel="optimiser step" if against == "step" else f"{against} of training", ylim=_from_zero(axes),
             xlim=(0, None))  # fmt: skip
    unit = _unit(value)
    axes.set_ylabel(_spoken(value) if unit == "loss" else f"{_spoken(value)}, {unit}")


def _panels(rows: Rows) -> list[_Panel]:
    """Return the plots that a run's metrics give, each with names of one unit."""
    names = list(dict.fromkeys(key for row in rows for key in row))
    validated = [name for name in names if name.startswith("val_")]
    losses = [name for name in names if name not in validated and (name == "loss" or name.endswith("_loss"))]
    candidates = [
        _Panel("training loss", "loss", losses),
        _Panel("validation, angles", "degrees", [name for name in validated if "_mae" in name]),
        _Panel("validation, intensities", "relative error", [name for name in validated if "_error" in name]),
        _Panel("validation loss", "loss", [name for name in validated if name.endswith("loss")]),
        _Panel("learning rate", "learning rate", [name for name in names if name == "learning_rate"]),
        _Panel("speed", "images/s", [name for name in names if name == "images_per_second"]),
    ]
    return [panel for panel in candidates if any(series(rows, name)[0].size for name in panel.names)]


def _draw(axes: Axes, rows: Rows, panel: _Panel) -> None:
    """Plot a panel's curves; training losses raw behind their running mean, validation with its points marked."""
    for place, name in enumerate(panel.names):
        steps, values = series(rows, name)
        label = _spoken(name.removeprefix("val_"))
        if panel.title == "training loss":
            axes.plot(steps, values, lw=0.6, alpha=0.35, color=f"C{place}")
            axes.plot(steps, _smooth(values), lw=1.5, color=f"C{place}", label=label)
        else:
            marks: dict[str, Any] = {"marker": "o", "ms": 3} if name.startswith("val_") or len(steps) < 2 else {}
            axes.plot(steps, values, lw=1.3, color=f"C{place}", label=label, **marks)
    axes.set(title=panel.title, xlabel="optimiser step", ylabel=panel.unit)
    if panel.title == "learning rate":
        axes.yaxis.set_major_formatter("{x:.2g}")
    axes.set_xlim(0, max(row["step"] for row in rows))
    if panel.unit != "loss":
        axes.set_ylim(*_from_zero(axes))
    if len(panel.names) > 1 or panel.title.startswith("validation"):
        axes.legend()


def _from_zero(axes: Axes) -> tuple[float, float]:
    """Return limits that include zero, so that heights compare as lengths."""
    low, high = axes.dataLim.intervaly
    return 1.07 * min(low, 0.0), 1.07 * max(high, 0.0) or 1.0


def _hours_above(axes: Axes, rows: Rows, *, label: bool) -> None:
    """Add an axis of hours above, where the run's time is known."""
    if not _has_times(rows):
        axes.spines["top"].set_visible(False)
        return
    above = axes.secondary_xaxis("top", functions=(partial(_hours, rows), partial(_hours, rows, inverse=True)))
    if label:
        above.set_xlabel("hours of training", fontsize=8.5)
    above.tick_params(labelsize=8)


def _has_times(rows: Rows) -> bool:
    return len(_clock(rows)[0]) > 1


def _clock(rows: Rows) -> tuple[np.ndarray, np.ndarray]:
    """Return steps and the hours at which they were taken, both strictly rising, from (0, 0)."""
    pairs = [(0.0, 0.0)]
    for row in rows:
        hours = row.get("seconds", 0.0) / 3600.0
        if row["step"] > pairs[-1][0] and hours > pairs[-1][1]:
            pairs.append((float(row["step"]), hours))
    steps, hours = np.array(pairs).T
    return steps, hours


def _hours(rows: Rows, places: np.ndarray, *, inverse: bool = False) -> np.ndarray:
    """Return the hours of steps, or the steps of hours; beyond the record at the mean speed."""
    known, wanted = _clock(rows)
    if inverse:
        known, wanted = wanted, known
    places = np.asarray(places, np.float64)
    slope = wanted[-1] / known[-1]
    inside = np.interp(places, known, wanted)
    return inside + slope * (np.minimum(places, 0.0) + np.maximum(places - known[-1], 0.0))


def series(rows: Rows, name: str) -> tuple[np.ndarray, np.ndarray]:
    """Return the steps at which a metric was recorded as a finite number, and its values, each (N,)."""
    pairs = [(row["step"], row[name]) for row in rows if name in row and math.isfinite(row[name])]
    return np.array([step for step, _ in pairs], np.float64), np.array([value for _, value in pairs], np.float64)


def _smooth(values: np.ndarray) -> np.ndarray:
    """Return the running mean over a window about each point, cut off at the ends."""
    half = max(1, round(_SMOOTHED * len(values) / 2))
    sums, counts = (np.convolve(each, np.ones(2 * half + 1))[half:-half] for each in (values, np.ones_like(values)))
    return sums / counts


def _unit(name: str) -> str:
    """Return the unit of a metric by its name."""
    return next((unit for part, unit in _UNITS.items() if part in name.split("_")), "value")


def _spoken(name: str) -> str:
    return name.replace("val_", "validation ").replace("_", " ").replace("mae", "MAE")
