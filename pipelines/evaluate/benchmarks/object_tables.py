"""Tables with a column per object: ours, then the published rows, each with its source."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from importlib import resources

import numpy as np

from pipelines.evaluate.evaluation import Result
from pipelines.evaluate.report.sections import Table
from render.shared.config import read_yaml

OURS, REFUSED = "ours", "refused"
PUBLISHED = "published/real_benchmarks.yaml"

Results = Mapping[str, Mapping[str, Result]]
"""By method, then object."""


@dataclass(frozen=True)
class PublishedRow:
    """A row of a published table.

    Attributes:
        method: The method.
        source: Where the figures were printed.
        average: The printed average; None where none was.
        figures: By object; empty where only the average is known.
    """

    method: str
    source: str
    average: float | None
    figures: dict[str, float]


@cache
def published_rows(benchmark: str, quantity: str) -> tuple[PublishedRow, ...]:
    """Return the rows of a benchmark (`diligent`, ...) for `directions`, `intensities` or `normals`."""
    table = read_yaml(str(resources.files("assets") / PUBLISHED))[benchmark]
    return tuple(
        PublishedRow(method, source, average, dict(zip(table["objects"], figures, strict=True)) if figures else {})
        for method, source, average, *figures in table.get(quantity, ())
    )


def object_table(
    title: str,
    results: Results,
    metric: str,
    *,
    present: Sequence[str],
    known: Sequence[str],
    published: Sequence[PublishedRow],
    digits: int,
    note: str = "",
) -> Table:
    """Return a table of one metric.

    The last columns are the mean over the objects that are present, so that rows can be compared, and the mean over all
    objects of the benchmark. Without any of the benchmark's own objects there are no published rows.

    Args:
        title: Caption.
        results: Ours; methods that never have the metric get no row unless they refused an object.
        metric: Name of the score.
        present: Objects of this evaluation.
        known: Objects of the benchmark, in its order.
        published: Published rows.
        digits: Decimals.
        note: A sentence below the table.
    """
    official = any(name in known for name in present)
    columns = [*(known if official else ()), *(name for name in present if name not in known)]
    entries: list[tuple[str, str, dict[str, float], float | None, Sequence[str]]] = [
        (name, OURS, {key: one.scores[metric] for key, one in found.items() if metric in one.scores}, None,
         [key for key, one in found.items() if one.reason])
        for name, found in results.items()
        if any(metric in result.scores or result.reason for result in found.values())
    ]  # fmt: skip
    ours = len(entries)
    entries += [(one.method, one.source, one.figures, one.average, ()) for one in published] if official else []
    rows = []
    for name, source, figures, printed, refused in entries:
        cells = [REFUSED if column in refused else _figure(figures.get(column), digits) for column in columns]
        means = [_mean(figures, present)]
        means += [_mean(figures, known) if printed is None else printed] if official else []
        rows.append((name, source, *cells, *(_figure(mean, digits) for mean in means)))
    last = [f"mean of {len(present)}" if len(present) > 1 else "this object"]
    last += [f"all {len(known)}"] if official else []
    header, theirs = ("method", "source", *columns, *last), tuple(range(ours, len(rows)))
    return Table(title=title, header=header, rows=tuple(rows), published=theirs, note=note)


def _mean(figures: Mapping[str, float], names: Sequence[str]) -> float | None:
    """Return the mean over objects, None where one has no figure."""
    return float(np.mean([figures[name] for name in names])) if all(name in figures for name in names) else None


def _figure(value: float | None, digits: int) -> str:
    return "-" if value is None else f"{value:.{digits}f}"
