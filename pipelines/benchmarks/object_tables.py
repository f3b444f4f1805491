"""Tables with a column per object: ours, then the published rows, each with its source."""

from collections.abc import Mapping, Sequence

import numpy as np

from pipelines.benchmarks.published_real import PublishedRow
from pipelines.evaluate.evaluation import Result
from pipelines.report.sections import Table

OURS = "ours"
REFUSED = "refused"

Results = Mapping[str, Mapping[str, Result]]
"""By method, then object."""


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

    def means(figures: Mapping[str, float], printed: float | None) -> list[str]:
        whole = _mean(figures, known) if printed is None else printed
        return [_figure(_mean(figures, present), digits), *([_figure(whole, digits)] if official else [])]

    ours = [
        [name, OURS, *_cells(found, metric, columns, digits), *means(_scores(found, metric), None)]
        for name, found in results.items()
        if any(metric in result.scores or result.reason for result in found.values())
    ]
    theirs = [
        [
            row.method,
            row.source,
            *(_figure(row.figures.get(name), digits) for name in columns),
            *means(row.figures, row.average),
        ]
        for row in (published if official else ())
    ]
    here = f"mean of {len(present)}" if len(present) > 1 else "this object"
    header = ["method", "source", *columns, here, *([f"all {len(known)}"] if official else [])]
    return Table(
        title=title,
        header=tuple(header),
        rows=tuple(tuple(row) for row in [*ours, *theirs]),
        published=tuple(range(len(ours), len(ours) + len(theirs))),
        note=note,
    )


def _scores(found: Mapping[str, Result], metric: str) -> dict[str, float]:
    return {name: result.scores[metric] for name, result in found.items() if metric in result.scores}


def _cells(found: Mapping[str, Result], metric: str, columns: Sequence[str], digits: int) -> list[str]:
    scores = _scores(found, metric)
    return [REFUSED if name in found and found[name].reason else _figure(scores.get(name), digits) for name in columns]


def _mean(figures: Mapping[str, float], names: Sequence[str]) -> float | None:
    """Return the mean over objects, None where one has no figure."""
    return float(np.mean([figures[name] for name in names])) if all(name in figures for name in names) else None


def _figure(value: float | None, digits: int) -> str:
    return "-" if value is None else f"{value:.{digits}f}"
