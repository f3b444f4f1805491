"""Line charts of methods: colours that colour-blind readers and printers can distinguish, names next to the lines."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes

COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#E69F00", "#000000")  # Okabe & Ito
MARKERS = ("o", "s", "^", "D", "v", "P", "X")
PUBLISHED = "0.55"
LINE_STYLES = ("-", "--", ":", "-.")


def colour(number: int) -> str:
    """Return the colour of the method of this number."""
    return COLOURS[number % len(COLOURS)]


def marker(number: int) -> str:
    """Return the marker of the method of this number."""
    return MARKERS[number % len(MARKERS)]


def shorten(name: str) -> str:
    """Return a method's name as charts show it: without the members of a combination that has a name."""
    before, bracket, _ = name.partition(" (")
    shipped = " (shipped)"
    return before + (shipped if bracket and name.endswith(shipped) else "")


Values = Sequence[float] | np.ndarray


class LineChart:
    """Lines of methods with their names next to the ends, published figures in grey.

    Args:
        axes: Where they are drawn.
    """

    def __init__(self, axes: Axes) -> None:
        self.axes = axes
        self._ends: list[tuple[str, float, str]] = []

    def line(self, number: int, name: str, x: Values, y: Values, **style: Any) -> None:
        """Draw the line of the method of this number."""
        self.axes.plot(x, y, color=colour(number), **{"marker": marker(number), "ms": 4, **style})
        self.end(name, y, colour(number))

    def point(self, name: str, x: float, y: float | None) -> None:
        """Draw a published figure, if there is one."""
        if y is not None:
            self.axes.plot([x], [y], color=PUBLISHED, marker="D", ms=6, ls="", mfc="none", zorder=5)
            self.end(name, [y], PUBLISHED)

    def end(self, name: str, y: Values, shade: str) -> None:
        """Write a name next to the last figure of a line."""
        self._ends.append((name, next((value for value in reversed(y) if np.isfinite(value)), np.nan), shade))

    def ticks(self, x: Sequence[float], names: Sequence[str], base: float = 10.0) -> None:
        """Make x logarithmic, with these ticks."""
        self.axes.set_xscale("log", base=base)
        self.axes.set_xticks(x, names, fontsize=8)
        self.axes.minorticks_off()

    def finish(self, gap: float = 0.06) -> None:
        """Let y begin at 0, and write the names, at least `gap` heights of the axes apart."""
        self.axes.set_ylim(bottom=0)
        tidy(self.axes)
        label_ends(self.axes, self._ends, gap)


def tidy(axes: Axes) -> None:
    """Take away what carries no information, and add a light grid."""
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(axis="y", color="0.9", lw=0.6)
    axes.set_axisbelow(True)


def label_ends(axes: Axes, lines: Sequence[tuple[str, float, str]], gap: float = 0.06) -> None:
    """Write names next to the right ends of lines, moved apart where they would overlap.

    Args:
        axes: The axes, with final limits and scale.
        lines: (name, y of the line's end, colour).
        gap: Least distance of two names, in heights of the axes.
    """
    lines = [line for line in lines if np.isfinite(line[1])]
    to_axes = axes.transData + axes.transAxes.inverted()
    x = axes.get_xlim()[1]
    places = [float(to_axes.transform((x, y))[1]) for _, y, _ in lines]
    order = np.argsort(places)
    spread = np.array(places)[order]
    for _ in range(200):  # neighbours that are too close give way to each other in equal parts
        lacking = np.maximum(gap - np.diff(spread), 0.0)
        if not (lacking > 1e-4).any():
            break
        spread[:-1] -= lacking / 2
        spread[1:] += lacking / 2
    spread += max(0.0, 0.02 - spread[0]) if len(spread) else 0.0
    for place, number in zip(spread, order, strict=True):
        name, _, shade = lines[number]
        moved = abs(place - places[number]) > 0.01
        arrow = (
            {"arrowstyle": "-", "color": shade, "lw": 0.5, "shrinkA": 1, "shrinkB": 0, "relpos": (0, 0.5)}
            if moved
            else None
        )
        axes.annotate(
            name, (1.0, places[number]), (1.03, place), xycoords="axes fraction", textcoords="axes fraction",
            color=shade, fontsize=8, va="center", arrowprops=arrow, annotation_clip=False,
        )  # fmt: skip
