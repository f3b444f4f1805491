"""Templates: what is escaped, what is refused, and that an installed package has them."""

import tomllib
from pathlib import Path

import pytest
from jinja2 import UndefinedError

from render.shared.templates import fill, inline, markdown_table, spell

ROOT = Path(__file__).resolve().parents[3]


def test_html_escapes_every_value_and_markdown_what_is_inline(tmp_path: Path) -> None:
    for suffix in ("html", "md"):
        (tmp_path / f"page.{suffix}.j2").write_text("{{ name }} {{ name | inline }}\n{% if name %}\nyes\n{% endif %}\n")
    html = fill(tmp_path / "page.html.j2", name="<b>&|")
    assert html.startswith("&lt;b&gt;&amp;| ") and html.endswith("\nyes\n")
    assert fill(tmp_path / "page.md.j2", name="<b>&|") == "<b>&| &lt;b&gt;&amp;\\|\nyes\n"


def test_a_value_that_is_not_given_is_refused(tmp_path: Path) -> None:
    (tmp_path / "page.md.j2").write_text("{{ name }}")
    with pytest.raises(UndefinedError, match="'name' is undefined"):
        fill(tmp_path / "page.md.j2", names="x")


def test_cells_break_no_table() -> None:
    table = markdown_table(("a", "b"), [("x|y", "1 < 2\n& more"), ("`shards/<id>.exr`", 3)])
    assert table == "| a | b |\n|---|---|\n| x\\|y | 1 &lt; 2 &amp; more |\n| `shards/<id>.exr` | 3 |"
    assert inline("`a|b` <c>") == "`a\\|b` &lt;c&gt;"


def test_counts_are_spelled() -> None:
    assert spell({64: 100}) == "64" and spell({64: 1000, 32: 2}) == "64 (1,000 scenes), 32 (2 scenes)"


def test_every_template_is_packaged() -> None:
    patterns = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]["package-data"]
    found = [path for package in ("render", "sdps", "pipelines") for path in (ROOT / package).rglob("*.j2")]
    assert len(found) >= 5
    assert all("**/*.j2" in patterns[path.relative_to(ROOT).parts[0]] for path in found)
    assert not [path for package in ("render", "sdps", "pipelines") for path in (ROOT / package).rglob("*.html")]
