"""The arrows between the packages and the size limits, checked on the syntax trees."""

import ast
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
PACKAGES = ("render", "sdps", "pipelines")
PLAIN = ("shards", "errors", "config", "files", "seeds", "manifest", "progress", "exchange.images", "exchange.tables")
SHARED = {f"render.{name}" for name in PLAIN}
MODULES = [path for package in PACKAGES for path in sorted((ROOT / package).rglob("*.py"))]


def imports(path: Path) -> Iterator[str]:
    """Yield every module a file imports, at the top or inside functions, `from package import module` included."""
    package = path.relative_to(ROOT).with_suffix("").parts
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = [*package[: len(package) - node.level], *([node.module] if node.module else [])]
            module = ".".join(base) if node.level else node.module or ""
            yield module
            yield from (f"{module}.{alias.name}" for alias in node.names)


def is_module(name: str) -> bool:
    path = ROOT.joinpath(*name.split("."))
    return path.with_suffix(".py").is_file() or (path / "__init__.py").is_file()


def test_there_is_something_to_check():
    assert len(MODULES) > 30


@pytest.mark.parametrize("path", MODULES, ids=lambda path: str(path.relative_to(ROOT)))
def test_arrows(path):
    package = path.relative_to(ROOT).parts[0]
    names = set(imports(path))
    roots = {name.split(".")[0] for name in names}
    if package == "render":
        assert not roots & {"torch", "sdps", "pipelines"}
    elif package == "sdps":
        assert not roots & {"mitsuba", "drjit", "pipelines"}
        of_render = {name for name in names if name.split(".")[0] == "render" and is_module(name)}
        assert of_render - {"render"} <= SHARED


@pytest.mark.parametrize("path", MODULES, ids=lambda path: str(path.relative_to(ROOT)))
def test_sizes(path):
    text = path.read_text(encoding="utf-8")
    assert len(text.splitlines()) <= 500
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            assert node.end_lineno - node.lineno < 100, node.name


@pytest.mark.parametrize("name", ["render", *sorted(SHARED)])
def test_shared_modules_load_neither_mitsuba_nor_torch(name):
    code = f"import sys, {name}; sys.exit(bool({{'mitsuba', 'drjit', 'torch'}} & set(sys.modules)))"
    assert subprocess.run([sys.executable, "-c", code], cwd=ROOT, check=False).returncode == 0


def test_the_learning_side_loads_no_renderer():
    code = "import sys, sdps.training, sdps.inference; sys.exit(bool({'mitsuba', 'drjit'} & set(sys.modules)))"
    assert subprocess.run([sys.executable, "-c", code], cwd=ROOT, check=False).returncode == 0
