"""What evaluations do with scores: means over objects, tables as text, results.json and a section of the report."""

import sys
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from pipelines.evaluate.report.sections import SectionWriter, Table
from pipelines.shared.text_tables import number, render_text
from render.shared.config import to_plain
from render.shared.files import write_json
from sdps.methods.runner import Runner


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
        """Write it with the published figure in brackets, and what failed."""
        text = number(self.value) if np.isfinite(self.value) else "-"
        text += f" ({number(published)})" if published is not None else ""
        return text + (f" [{self.failed} of {self.count} failed]" if self.failed and self.failed < self.count else "")

    def plain(self) -> float | None:
        """Return the value, None where there is none, for JSON."""
        return float(self.value) if np.isfinite(self.value) else None


def mean(scores: Iterable[Mapping[str, float]], metric: str) -> Mean:
    """Average a metric over the objects that were scored."""
    scores = list(scores)
    values = [item[metric] for item in scores if metric in item]
    return Mean(float(np.mean(values)) if values else float("nan"), len(scores) - len(values), len(scores))


def tables_text(tables: Sequence[Table], left: Collection[int] = (0,)) -> str:
    """Lay out tables for the terminal; columns in `left` are set flush left."""
    return "".join(render_text(f"\n{table.title}", table.header, table.rows, left) for table in tables)


def weights_of(runners: Iterable[Runner]) -> dict[str, str]:
    """Return the weights files of methods by the names of their models."""
    return {name: str(file) for runner in runners for name, file in runner.files.items()}


def publish(writer: SectionWriter, out: Path, file: Path, values: dict[str, Any], left: Collection[int] = (0,),
            said: str = "") -> None:  # fmt: skip
    """Write a section of the report and results.json, and print the tables with what their numbers are.

    Args:
        writer: The section: its text is the definition of the numbers in its tables.
        out: Folder of the report.
        file: Gets the definition, the values and the tables as JSON.
        values: What else belongs to the results.
        left: Columns that are set flush left in the terminal.
        said: What is printed after the tables.
    """
    section = writer.section
    tables = {table.title: to_plain(table) for table in section.tables}
    write_json(file, {"definition": section.text, **values, "tables": tables})
    writer.write(out)
    sys.stdout.write(f"{tables_text(section.tables, left)}{said}\n{section.text}\n{file}\n")
