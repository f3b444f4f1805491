"""Tables as aligned text, and the figures in them."""

import math
from collections.abc import Collection, Sequence


def render_text(title: str, header: Sequence[str], rows: Sequence[Sequence[str]], left: Collection[int] = (0,)) -> str:
    """Lay out a table with aligned columns under its title; columns in `left` are set flush left."""
    widths = [max(len(line[column]) for line in [header, *rows]) for column in range(len(header))]
    lines = [
        "  ".join(
            cell.ljust(width) if column in left else cell.rjust(width)
            for column, (cell, width) in enumerate(zip(line, widths, strict=True))
        ).rstrip()
        for line in [header, *rows]
    ]
    return "\n".join([title, *lines]) + "\n"


def number(value: float | None, digits: int | None = None) -> str:
    """Write a figure, by default with two decimals from 1 up and three below; a dash for None and NaN."""
    if value is None or math.isnan(value):
        return "-"
    return f"{value:.{digits or (2 if value >= 1 else 3)}f}"
