"""Pages and cards from Jinja2 templates, `*.html.j2` and `*.md.j2`, which lie next to the code that fills them."""

import html
import re
from collections.abc import Iterable, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any

from jinja2 import Environment, FileSystemLoader, StrictUndefined, select_autoescape

from render.shared.config import to_yaml

_CODE = re.compile(r"(`[^`]*`)")


def fill(template: Path, **values: Any) -> str:
    """Return the text of a template.

    In HTML every value is escaped. In Markdown none is: text from outside takes the filter `inline`, or stands in a
    `table`.

    Args:
        template: The template's file.
        values: What it asks for, all of it.

    Raises:
        jinja2.UndefinedError: the template asks for a value that is not given.
    """
    return _environment(template.parent).get_template(template.name).render(values)


@cache
def _environment(folder: Path) -> Environment:
    environment = Environment(
        loader=FileSystemLoader(folder), autoescape=select_autoescape(["html.j2"], default=False),
        undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True, keep_trailing_newline=True,
    )  # fmt: skip
    environment.filters |= {"inline": inline, "commas": "{:,}".format, "spelled": spell, "yaml": to_yaml}
    environment.globals["table"] = markdown_table
    return environment


def inline(value: Any) -> str:
    """Escape what is not Markdown for one line or one cell of a table; code in backticks stays code."""
    parts = _CODE.split(str(value).replace("\n", " ").replace("|", "\\|"))
    return "".join(part if number % 2 else html.escape(part, quote=False) for number, part in enumerate(parts))


def markdown_table(header: Sequence[str], rows: Iterable[Sequence[Any]]) -> str:
    """Lay out a table as Markdown, its cells escaped, without a line end after the last row."""
    lines = ["| " + " | ".join(header) + " |", "|" + "---|" * len(header)]
    return "\n".join([*lines, *("| " + " | ".join(map(inline, row)) + " |" for row in rows)])


def spell(counts: Mapping[Any, int]) -> str:
    """Spell counts of scenes: the value alone when there is one, else each with its number."""
    if len(counts) == 1:
        return str(next(iter(counts)))
    return ", ".join(f"{value} ({count:,} scenes)" for value, count in counts.items())
