"""The one writer of tables: cells, means over objects, our rows above published ones, results.json and the report."""

import sys
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from pipelines.evaluate.evaluation import Found
from pipelines.evaluate.published import PublishedRow
from pipelines.evaluate.report.sections import SectionWriter, Table
from pipelines.shared.text_tables import number, render_text
from render.shared.config import to_plain
from render.shared.files import write_json
from sdps.methods.runner import Runner

OURS, REFUSED = "ours", "refused"


def cell(value: float | str | None, published: float | None = None, digits: int | None = None) -> str:
    """Write a figure, a dash where there is none, or what stands in its place, with the published one in brackets."""
    text = value if isinstance(value, str) else number(value, digits)
    return text if published is None else f"{text} ({number(published, digits)})"


@dataclass(frozen=True)
class Mean:
    """A mean over objects.

    Attributes:
        value: The mean over those that were scored; NaN where none was.
        failed: Objects the method refused.
        count: Objects.
    """

    value: float
    failed: int
    count: int

    def cell(self, published: float | None = None) -> str:
        """Write it with the published figure in brackets, and how many objects failed."""
        some = 0 < self.failed < self.count
        return cell(self.value, published) + (f" [{self.failed} of {self.count} failed]" if some else "")

    def plain(self) -> float | None:
        """Return the value, None where there is none, for JSON."""
        return None if np.isnan(self.value) else self.value


def mean(scores: Iterable[Mapping[str, float]], metric: str) -> Mean:
    """Average a metric over the objects that were scored."""
    scores = list(scores)
    values = [item[metric] for item in scores if metric in item]
    return Mean(float(np.mean(values)) if values else float("nan"), len(scores) - len(values), len(scores))


def tables_text(tables: Sequence[Table], left: Collection[int] = (0,)) -> str:
    """Lay out tables for the terminal; columns in `left` are set flush left."""
    return "".join(render_text(f"\n{table.title}", table.header, table.rows, left) for table in tables)


def object_table(
    title: str,
    results: Found,
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
        cells = [REFUSED if column in refused else number(figures.get(column), digits) for column in columns]
        means = [mean_of_all(figures, present)]
        means += [mean_of_all(figures, known) if printed is None else printed] if official else []
        rows.append((name, source, *cells, *(number(mean, digits) for mean in means)))
    last = [f"mean of {len(present)}" if len(present) > 1 else "this object"]
    last += [f"all {len(known)}"] if official else []
    header, theirs = ("method", "source", *columns, *last), tuple(range(ours, len(rows)))
    return Table(title=title, header=header, rows=tuple(rows), published=theirs, note=note)


def mean_of_all(figures: Mapping[str, float], names: Sequence[str]) -> float | None:
    """Return the mean over objects, None where one has no figure."""
    return float(np.mean([figures[name] for name in names])) if all(name in figures for name in names) else None


def weights_of(runners: Iterable[Runner]) -> dict[str, str]:
    """Return the weights files of methods by the names of their models."""
    return {name: str(file) for runner in runners for name, file in runner.files.items()}


def publish(writer: SectionWriter, out: Path, file: Path, values: dict[str, Any], left: Collection[int] = (0,),
            footer: str = "") -> None:  # fmt: skip
    """Write a section of the report and results.json, and print the tables with what their numbers are.

    Args:
        writer: The section: its text is the definition of the numbers in its tables.
        out: Folder of the report.
        file: Gets the definition, the values and the tables as JSON.
        values: What else belongs to the results.
        left: Columns that are set flush left in the terminal.
        footer: What is printed after the tables.
    """
    section = writer.section
    tables = {table.title: to_plain(table) for table in section.tables}
    write_json(file, {"definition": section.text, **values, "tables": tables})
    writer.write(out)
    sys.stdout.write(f"{tables_text(section.tables, left)}{footer}\n{section.text}\n{file}\n")
