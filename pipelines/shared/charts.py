"""Charts of lights and counts, as matplotlib axes or as inline SVG for pages.

The ink of the SVG is the page's, so that it suits light, dark and print.
"""

import html
import io
import re
from collections.abc import Sequence
from typing import Any, cast

import numpy as np
from matplotlib import colormaps, rc_context
from matplotlib.axes import Axes
from matplotlib.collections import PathCollection
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.patches import Circle
from matplotlib.ticker import MaxNLocator

_INK, _FILL = "#010203", "#040506"  # replaced by CSS colours
_PAGE_STYLE: Any = {
    "svg.fonttype": "none", "svg.hashsalt": "sdps", "font.size": 8, "font.family": "sans-serif",
    "text.color": _INK, "axes.edgecolor": _INK, "axes.labelcolor": _INK, "xtick.color": _INK, "ytick.color": _INK,
    "axes.spines.top": False, "axes.spines.right": False, "figure.facecolor": "none", "axes.facecolor": "none",
    "axes.linewidth": 0.6, "xtick.major.width": 0.6, "ytick.major.width": 0.6,
}  # fmt: skip
_NO_METADATA = dict.fromkeys(("Creator", "Date", "Format", "Type"))
SCATTER_LIMIT = 1500  # points; beyond, a 2-D histogram
BARS = 20


def new_figure(width: float, height: float) -> Figure:
    """Return an empty figure (inches) that fits its contents."""
    return Figure(figsize=(width, height), layout="constrained")


def light_disc(
    axes: Axes, directions: np.ndarray, intensities: np.ndarray, truth: np.ndarray | None = None
) -> PathCollection:
    """Show lights as the paper does: (x, y) on the unit disc, coloured by intensity over the highest.

    Args:
        axes: Where.
        directions: (L, 3).
        intensities: (L,).
        truth: (L, 3) true directions, joined to the others by thin lines.
    """
    axes.add_patch(Circle((0, 0), 1, fill=False, color="0.6", lw=0.8))
    axes.plot([-1, 1], [0, 0], color="0.92", lw=0.6, zorder=0)
    axes.plot([0, 0], [-1, 1], color="0.92", lw=0.6, zorder=0)
    if truth is not None:
        pairs = np.stack([truth, directions])  # (2, L, 3)
        axes.plot(pairs[..., 0], pairs[..., 1], color="0.55", lw=0.6, zorder=1)
    shades = intensities / max(float(intensities.max()), 1e-12)
    points = axes.scatter(
        directions[:, 0], directions[:, 1], c=shades, s=16, cmap="viridis", vmin=0, vmax=1, edgecolors="0.2",
        linewidths=0.3, zorder=2,
    )  # fmt: skip
    axes.set(xlim=(-1.06, 1.06), ylim=(-1.06, 1.06), aspect="equal", xticks=[], yticks=[])
    axes.axis("off")
    return points


def _svg(figure: Figure, title: str) -> str:
    """Return the figure as an inline SVG element with a title, as wide as its container."""
    buffer = io.StringIO()
    figure.savefig(buffer, format="svg", transparent=True, metadata=_NO_METADATA)
    text = buffer.getvalue()
    text = re.sub(r' (width|height)="[^"]*pt"', "", text[text.index("<svg") :], count=2)
    text = text.replace("<svg", f'<svg role="img" aria-label="{html.escape(title)}"', 1)
    return text.replace(_INK, "currentColor").replace(_FILL, "var(--accent)")


def histogram(
    values: Sequence[float] | np.ndarray, title: str, *, log: bool = False, bounds: tuple[float, float] | None = None
) -> str:
    """Plot a histogram of at least one value; `log` spaces the bins by factors and drops what is not positive."""
    array = np.asarray(values, np.float64)
    with rc_context(_PAGE_STYLE):
        figure = new_figure(3.6, 2.3)
        axes = figure.add_subplot()
        if log:
            array = array[array > 0]
            low, high = (array.min(), array.max()) if len(array) else (0.1, 1.0)
            bins = np.geomspace(low / 1.1, high * 1.1, 25)
            axes.set_xscale("log")
        else:
            low, high = bounds or (array.min(), array.max())
            bins = np.linspace(low, high if high > low else low + 1, 31)
        axes.hist(array, bins=bins.tolist(), color=_FILL)
        axes.set(xlabel=title, ylabel="number")
        cast(MaxNLocator, axes.yaxis.get_major_locator()).set_params(integer=True)
        return _svg(figure, title)


def bars(counts: dict[str, int], title: str) -> str:
    """Plot named counts as horizontal bars, the first 20 of them (the most frequent, as they are sorted)."""
    items = list(counts.items())[:BARS]
    if len(counts) > BARS:
        title = f"{title} ({BARS} of {len(counts)})"
    names = [name if len(name) < 28 else f"{name[:26]}…" for name, _ in items]
    names = [name.replace("$", r"\$") for name in names]  # which would begin a formula
    with rc_context(_PAGE_STYLE):
        figure = new_figure(3.6, 0.55 + 0.17 * max(len(items), 3))
        axes = figure.add_subplot()
        shown = axes.barh(range(len(items)), [count for _, count in items], color=_FILL, height=0.7)
        axes.bar_label(shown, padding=2, fontsize=7)
        axes.set_yticks(range(len(items)), names)
        axes.set_ylim(len(items) - 0.5, -0.5)
        figure.supxlabel(title, fontsize="medium")  # below the names as well, where there is room
        axes.margins(x=0.12)
        cast(MaxNLocator, axes.xaxis.get_major_locator()).set_params(integer=True)
        return _svg(figure, title)


def light_disc_svg(directions: np.ndarray) -> str:
    """Plot unit directions (N, 3) on the disc of (x, y) seen from the camera; a 2-D histogram when there are many."""
    title = "light directions, x right and y up"
    many = len(directions) > SCATTER_LIMIT
    rings = "white" if many else _INK
    with rc_context(_PAGE_STYLE):
        figure = new_figure(3.6, 2.9)
        axes = figure.add_subplot()
        if many:
            cells = 21 if len(directions) < 20 * SCATTER_LIMIT else 41
            counts = np.histogram2d(directions[:, 0], directions[:, 1], bins=cells, range=[[-1, 1]] * 2)[0]
            image = axes.imshow(
                np.ma.masked_equal(counts.T, 0), origin="lower", extent=(-1, 1, -1, 1), interpolation="nearest",
                cmap=colormaps["viridis"].with_extremes(bad=(0, 0, 0, 0)), norm=LogNorm(1, max(counts.max(), 2)),
            )  # fmt: skip
            bar = figure.colorbar(image, shrink=0.8)
            bar.outline.set_visible(False)
            bar.set_label(f"lights per cell of {2 / cells:.2f}")
        else:
            axes.scatter(directions[:, 0], directions[:, 1], s=5, color=_FILL, linewidths=0, alpha=0.7)
        axes.add_patch(Circle((0, 0), 1, fill=False, color=_INK, lw=0.5, alpha=0.5))
        for elevation in (30, 60):
            radius = np.cos(np.radians(elevation))
            axes.add_patch(Circle((0, 0), radius, fill=False, color=rings, lw=0.6, alpha=0.6, ls=":"))
            axes.text(0, -radius, f"{elevation}°", fontsize=7, ha="center", va="bottom", color=rings)
        axes.set(
            xlim=(-1.04, 1.04), ylim=(-1.04, 1.04), aspect="equal", xlabel="x", ylabel="y",
            xticks=(-1, 0, 1), yticks=(-1, 0, 1),
        )  # fmt: skip
        return _svg(figure, title)


def elevations(directions: np.ndarray) -> np.ndarray:  # (N,)
    """Return the angles of the directions above the image plane in degrees; 90 is light from the camera."""
    return np.degrees(np.arcsin(np.clip(directions[:, 2], -1.0, 1.0)))
