"""README, CONTRIBUTING and the pages of docs/: links, names of files, modules and commands, checked on the text."""

import ast
import re
import subprocess
import sys
from collections.abc import Iterable, Iterator
from functools import cache
from importlib import util
from pathlib import Path

import pytest
import yaml

from lab.commands import COMMANDS as IN_LAB
from pipelines.cli import COMMANDS, Group

ROOT = Path(__file__).resolve().parent.parent
DOCS = ROOT / "docs"
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", ROOT / "CHANGELOG.md", *sorted(DOCS.rglob("*.md"))]
PACKAGES = ("render", "sdps", "pipelines", "lab")
TOPS = (*PACKAGES, "assets", "tests", "docs")
NAMES = {path.name for top in (*PACKAGES, "tests") for path in (ROOT / top).rglob("*.py")} | {"run_model.py"}
"""Python files of the project, and one of SDPS-Net's code."""
README_WORDS = 900
GUIDE_WORDS = 25_000
STUDY_WORDS = 8_000
ENTRIES = 12

LINK = re.compile(r"!?\[[^\]]*\]\(([^)\s]+)\)")
FENCE = re.compile(r"^```(\w*)[^\n]*\n(.*?)^```", re.MULTILINE | re.DOTALL)
SPAN = re.compile(r"`([^`\n]+)`")
PATH = re.compile(rf"(?:{'|'.join(TOPS)})/[\w./-]+")
DOTTED = re.compile(rf"(?<![\w/.-])(?:{'|'.join(PACKAGES)})(?:\.\w+)+")
SDPS = re.compile(r"(?:^|[\s;`(])(?<!from )(?<!import )sdps ([a-z][a-z-]*)(?: ([a-z][a-z-]*))?")
LAB = re.compile(r"python -m lab ([a-z][a-z-]*)")
FLAG = re.compile(r"(?<![\w-])--[a-z][a-z-]*")
MAKE = re.compile(r"(?:^|[\s;`(])make ([a-z][a-z-]*)")

by_page = pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))


def commands_shown(text: str) -> Iterator[str]:
    """Yield what stands in code: fenced or indented lines without their comments, and spans."""
    for _, block in FENCE.findall(text):
        yield from (re.sub(r"(^|\s)#.*", "", line) for line in block.splitlines())
    rest = FENCE.sub("", text)
    yield from (re.sub(r"\s#.*", "", line) for line in rest.splitlines() if line.startswith("    "))
    yield from SPAN.findall(rest)


def anchors(page: Path) -> set[str]:
    """Return the anchors of a page's headings, as mkdocs makes them."""
    text = FENCE.sub("", page.read_text(encoding="utf-8"))
    found = set()
    for heading in re.findall(r"^#+ (.*)$", text, re.MULTILINE):
        plain = re.sub(r"[^\w\s-]", "", heading.replace("`", "")).strip().lower()
        found.add(re.sub(r"[-\s]+", "-", plain))
    return found


@cache
def names(path: Path) -> set[str]:
    """Return what a module or the body of a class defines or imports at its top level, classes' members as `A.b`."""
    found = set()
    body = ast.parse(path.read_text(encoding="utf-8")).body
    for node in [*body, *(part for block in body if isinstance(block, ast.If) for part in block.body + block.orelse)]:
        found |= _bound(node)
        if isinstance(node, ast.ClassDef):
            found |= {f"{node.name}.{name}" for part in node.body for name in _bound(part)}
    return found


def _bound(node: ast.stmt) -> set[str]:
    if isinstance(node, ast.FunctionDef | ast.ClassDef | ast.AsyncFunctionDef):
        return {node.name}
    if isinstance(node, ast.Import | ast.ImportFrom):
        return {alias.asname or alias.name for alias in node.names}
    targets = node.targets if isinstance(node, ast.Assign) else [getattr(node, "target", None)]
    parts = (part for target in targets if target is not None for part in ast.walk(target))
    return {part.id for part in parts if isinstance(part, ast.Name)}


@cache
def flags() -> set[str]:
    """Return the flags of all commands together; those made of a configuration's fields stand in the promised ones."""
    code = "".join(
        path.read_text(encoding="utf-8") for top in ("pipelines", "lab") for path in (ROOT / top).rglob("*.py")
    )
    code += (ROOT / "tests" / "support" / "interface.json").read_text(encoding="utf-8")
    either = re.findall(r'"--([a-z][a-z-]*)",\s*action=argparse.BooleanOptionalAction', code)
    return {*re.findall(r'"(--[a-z][a-z-]*)"', code), *(f"--no-{name}" for name in either), "--help"}


def resolves(dotted: str) -> bool:
    """Return whether a dotted name is a module, a folder, or something a module defines."""
    parts = dotted.split(".")
    for end in range(len(parts), 0, -1):
        place = ROOT.joinpath(*parts[:end])
        rest = ".".join(parts[end:])
        file = place.with_suffix(".py") if place.with_suffix(".py").is_file() else place / "__init__.py"
        if file.is_file():
            return not rest or rest in names(file)
    return False


@by_page
def test_links_lead_somewhere(page):
    for target in LINK.findall(FENCE.sub("", page.read_text(encoding="utf-8"))):
        if re.match(r"[a-z]+:", target):
            continue
        name, _, anchor = target.partition("#")
        file = (page.parent / name).resolve() if name else page
        assert file.is_file(), f"{page.name}: {target}"
        assert page.parent == ROOT or file.is_relative_to(DOCS), f"{page.name}: {target} leaves the site"
        if anchor:
            assert anchor in anchors(file), f"{page.name}: {target}; there are {sorted(anchors(file))}"


@by_page
def test_files_and_modules_named_are_there(page):
    if page.name == "CHANGELOG.md":  # names what is gone
        return
    text = page.read_text(encoding="utf-8")
    for shown in commands_shown(text):
        for path in PATH.findall(shown):
            assert "*" in shown or (ROOT / path.rstrip("./")).exists(), f"{page.name}: {path}"
        for name in re.findall(r"^\w+\.py$", shown):
            assert name in NAMES, f"{page.name}: {name}"
        for dotted in DOTTED.findall(shown):
            if dotted.rpartition(".")[2] not in ("safetensors", "md", "json", "toml"):
                assert resolves(dotted), f"{page.name}: {dotted}"
    for language, block in FENCE.findall(text):
        if language == "python":
            for node in ast.walk(ast.parse(block)):
                if isinstance(node, ast.ImportFrom) and node.module.split(".")[0] in PACKAGES:
                    for alias in node.names:
                        assert resolves(f"{node.module}.{alias.name}"), f"{page.name}: {ast.unparse(node)}"


@by_page
def test_commands_shown_are_there(page):
    targets = set(re.findall(r"^([a-z][a-z -]*):(?!=)", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE))
    targets = {name for line in targets for name in line.split()}
    for shown in commands_shown(page.read_text(encoding="utf-8")):
        for name, second in SDPS.findall(shown):
            assert name in COMMANDS, f"{page.name}: sdps {name}"
            if isinstance(COMMANDS[name], Group) and second:
                assert second in COMMANDS[name].commands, f"{page.name}: sdps {name} {second}"
            assert set(FLAG.findall(shown)) <= flags(), f"{page.name}: {shown}"
        for name in LAB.findall(shown):
            assert name in IN_LAB, f"{page.name}: python -m lab {name}"
        for name in MAKE.findall(shown):
            assert name in targets, f"{page.name}: make {name}"


def word_count(pages: Iterable[Path]) -> int:
    """Count what stands between blanks in these pages, tables and commands included."""
    return sum(len(page.read_text(encoding="utf-8").split()) for page in pages)


def test_the_docs_stay_small():
    readme = ROOT / "README.md"
    studies = set((DOCS / "studies").glob("*.md"))
    assert word_count([readme]) <= README_WORDS
    assert word_count([readme, *set(DOCS.rglob("*.md")) - studies]) <= GUIDE_WORDS
    assert word_count(studies) <= STUDY_WORDS


def test_every_picture_is_shown():
    shown = "".join(page.read_text(encoding="utf-8") for page in [ROOT / "README.md", *DOCS.rglob("*.md")])
    pictures = [path.name for path in (DOCS / "images").iterdir() if path.suffix in (".jpg", ".png", ".svg")]
    assert [name for name in pictures if f"images/{name})" not in shown] == []


def test_every_page_is_in_the_navigation_and_no_folder_is_crowded():
    class Loader(yaml.SafeLoader):
        """Reads mkdocs.yml, whose Python tags are of no interest here."""

    Loader.add_multi_constructor("tag:yaml.org,2002:python/", lambda loader, suffix, node: suffix)
    config = yaml.load((ROOT / "mkdocs.yml").read_text(encoding="utf-8"), Loader)

    def pages(entry) -> Iterator[str]:
        if isinstance(entry, str):
            yield entry
        else:
            for part in entry.values() if isinstance(entry, dict) else entry:
                yield from pages(part)

    listed = list(pages(config["nav"]))
    assert sorted(listed) == sorted(str(page.relative_to(DOCS)) for page in DOCS.rglob("*.md"))
    for folder in {page.parent for page in DOCS.rglob("*.md")}:
        assert len(list(folder.iterdir())) <= ENTRIES, folder.name


@pytest.mark.slow
@pytest.mark.skipif(util.find_spec("mkdocs") is None, reason="make docs installs mkdocs")
def test_the_site_builds(tmp_path):
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(tmp_path / "site")]
    subprocess.run(command, cwd=ROOT, check=True)
    page = (tmp_path / "site" / "index.html").read_text(encoding="utf-8")
    assert not re.search(r"<(script|link|img)[^>]*https?:", page), "pages fetch something from elsewhere"
