"""The arrows between packages and folders, names and sizes, checked on the syntax trees.

`FOLDERS` is the house's plan: a folder may import from those before it, and from nothing after it.
"""

import ast
import re
import subprocess
import sys
from collections import Counter
from collections.abc import Iterator
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
FOLDERS = [
    *(f"render.{name}" for name in (
        "shared", "shared.imaging", "records", "backend", "shapes.geometry", "shapes.files",
        "shapes.sculpture", "shapes", "materials.textures", "materials", "materials.kernels.textures",
        "materials.kernels", "materials.fit", "planning", "kernel", "running", "checks", "publishing",
        "exchange.layouts", "exchange",
    )),
    "render",
    *(f"sdps.{name}" for name in (
        "core", "data", "data.resident", "models", "training", "publishing", "inference", "refinement.shape",
        "refinement", "refinement.surroundings", "classical.common", "classical", "methods.fusion", "methods",
        "photos.light_files", "photos.pictures", "photos.pictures.decoding", "photos.pictures.sources",
        "photos.analysis.balls", "photos.analysis", "photos", "surface", "surface.gloss", "surface.exports",
    )),
    "sdps",
    *(f"pipelines.{name}" for name in (
        "shared", "shared.cluster", "rendering", "data", "train", "evaluate.report", "evaluate", "evaluate.benchmarks",
    )),
    "pipelines", "pipelines.app.common", "pipelines.app.pages", "pipelines.app",
    "lab.shared", "lab.bench", "lab.figures", "lab.studies", "lab.releases", "lab",
]  # fmt: skip
RANK = {folder: place for place, folder in enumerate(FOLDERS)}
PACKAGES = ("render", "sdps", "pipelines", "lab")
LIGHT = ("render.shared", "render.shared.imaging", "render.records")
"""Folders of `render` that `sdps` may use; they load neither mitsuba nor torch."""
MAY_RECUR = {"__init__.py", "api.py", "registry.py", "plan.py", "validate.py", "relight.py"}
"""A registry is one in every folder that has one, and `api` is what a package offers from its root. A command in
`pipelines/data` has the name of what it does, and so have the modules that do it."""
ENTRIES = 12
LONGER = {"sdps.refinement.fused._one_pixel": 80}  # one loop, compiled whole
"""Functions that may have more than 50 lines, and how many."""


def modules() -> dict[str, Path]:
    found = {}
    for package in PACKAGES:
        for path in sorted((ROOT / package).rglob("*.py")):
            parts = path.relative_to(ROOT).with_suffix("").parts
            found[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path
    return found


MODULES = modules()


def folder_of(name: str) -> str:
    return name if MODULES[name].name == "__init__.py" else name.rpartition(".")[0]


def imports(path: Path) -> Iterator[str]:
    """Yield what a file imports, at the top, inside functions or for types: modules of the house, roots of others."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from (alias.name if alias.name in MODULES else alias.name.split(".")[0] for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: imports name their package"
            for name in (f"{node.module}.{alias.name}" for alias in node.names):
                if name in MODULES:
                    yield name
                else:
                    yield node.module if node.module in MODULES else node.module.split(".")[0]


IMPORTS = {name: set(imports(path)) - {name} for name, path in MODULES.items()}


def test_every_folder_has_its_place():
    assert {folder_of(name) for name in MODULES} == set(FOLDERS)


@pytest.mark.parametrize("name", MODULES)
def test_arrows(name):
    others = {wanted.split(".")[0] for wanted in IMPORTS[name]}
    own = folder_of(name)
    if own.split(".")[0] == "render":
        assert not others & {"torch", "sdps", "pipelines"}
    elif own.split(".")[0] == "sdps":
        assert not others & {"mitsuba", "drjit", "pipelines"}
        of_render = {folder_of(wanted) for wanted in IMPORTS[name] if wanted in MODULES and wanted.startswith("render")}
        assert of_render <= {*LIGHT}
    for wanted in IMPORTS[name] & MODULES.keys():
        assert RANK[folder_of(wanted)] <= RANK[own], f"{own} may not import from {folder_of(wanted)} ({wanted})"


def test_one_place_imports_mitsuba_and_drjit():
    """Both start threads when they are imported, which must wait until the libLLVM is named: `render.backend.jit`."""
    assert {name for name in MODULES if IMPORTS[name] & {"mitsuba", "drjit"}} == {"render.backend.variant"}
    for path in ROOT.glob("tests/**/*.py"):
        found = re.findall(r"^(?:import|from) (?:mitsuba|drjit)\b", path.read_text(encoding="utf-8"), re.M)
        assert len(found) == (path.name == "test_mitsuba_scene.py"), path  # a script for a process of its own


def test_no_circles():
    try:
        TopologicalSorter({name: IMPORTS[name] & MODULES.keys() for name in MODULES}).prepare()
    except CycleError as error:
        pytest.fail(" -> ".join(error.args[1]))


COVERED = {"lab.shared", "render.exchange.layouts", "render.shapes.sculpture", "sdps.classical.common"}
"""Folders whose code is tested with that of the folder above, or with what uses it."""


@pytest.mark.parametrize("folder", FOLDERS)
def test_tests_lie_where_the_code_lies(folder):
    place = ROOT.joinpath("tests", *folder.split("."))
    assert any(place.rglob("test_*.py")) != (folder in COVERED), folder


def test_no_folder_is_crowded():
    for folder in {path.parent for path in MODULES.values()}:
        entries = {path.name for path in folder.iterdir() if not path.name.startswith("__")} - {"py.typed"}
        assert len(entries) <= ENTRIES or folder.name == "studies", f"{folder.relative_to(ROOT)}: {sorted(entries)}"


def test_file_names_do_not_recur():
    counts = Counter(path.name for path in MODULES.values() if path.parent.name != "studies")
    assert {name for name, count in counts.items() if count > 1} <= MAY_RECUR


@pytest.mark.parametrize("name", MODULES)
def test_sizes(name):
    text = MODULES[name].read_text(encoding="utf-8")
    assert len(text.splitlines()) <= 500
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            lines = node.end_lineno - node.lineno + 1
            assert lines <= LONGER.get(f"{name}.{node.name}", 50), f"{name}.{node.name}: {lines} lines"


@pytest.mark.parametrize("name", [name for name in MODULES if folder_of(name) in LIGHT])
def test_what_both_sides_use_loads_neither_mitsuba_nor_torch(name):
    code = f"import sys, {name}; sys.exit(bool({{'mitsuba', 'drjit', 'torch'}} & set(sys.modules)))"
    assert subprocess.run([sys.executable, "-c", code], cwd=ROOT, check=False).returncode == 0


def test_the_learning_side_loads_no_renderer():
    code = (
        "import sys, sdps.training.trainer, sdps.inference.estimator\n"
        "sys.exit(bool({'mitsuba', 'drjit'} & set(sys.modules)))"
    )
    assert subprocess.run([sys.executable, "-c", code], cwd=ROOT, check=False).returncode == 0
