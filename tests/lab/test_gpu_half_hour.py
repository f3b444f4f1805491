"""The script for a borrowed GPU machine, with a Python that notes what it is asked to run instead of running it."""

import os
import re
import shutil
import subprocess
import sys
import tarfile
from importlib.metadata import requires
from importlib.util import find_spec
from pathlib import Path

import pytest

from pipelines import cli
from pipelines.shared import presets

ROOT = Path(__file__).resolve().parents[2]
SCRIPTS = ("gpu_half_hour.sh", "gpu_pack.sh")
pytestmark = pytest.mark.skipif(
    any(shutil.which(name) is None for name in ("bash", "timeout", "make", "git")), reason="needs Linux's usual tools"
)
NOTING = """#!/bin/sh
case "$1 $2" in
  "-m pipelines.cli")
    { echo "$SDPS_VARIANT"; shift 2; for word; do echo "$word" | tr '\\n' ' '; echo; done; } > "$NOTES.$$"
    grep -qx 'train ' "$NOTES.$$" && exit 0
    while [ "$1" != --out ]; do shift; done
    mkdir -p "$2/data" && touch "$2/data/manifest.jsonl" "$2/data/config.yaml" "$WORK/mix/data/shards/$$.exr" ;;
  "-m pytest") echo "$*" ;;
  *) exec PYTHON "$@" ;;
esac
"""


def run(folder: Path, *words: str, **environment: str) -> subprocess.CompletedProcess:
    command = ["bash", str(folder / "lab" / "gpu_half_hour.sh"), *words]
    return subprocess.run(
        command, env=os.environ | environment, capture_output=True, text=True, timeout=100, check=False
    )


@pytest.fixture
def checkout(tmp_path: Path) -> Path:
    """A folder with the scripts, and in .gpu the archives that `pack` makes, of other content."""
    folder = tmp_path / "checkout"
    (folder / "lab").mkdir(parents=True)
    for name in SCRIPTS:
        shutil.copy(ROOT / "lab" / name, folder / "lab")
    for name in ("Makefile", "pyproject.toml", "constraints.txt", "requirements.lock"):
        shutil.copy(ROOT / name, folder)
    for name in ("render", "sdps", "pipelines", "assets/weights"):
        (folder / name).mkdir(parents=True)
        (folder / name / "file").touch()
    (folder / ".gitignore").write_text(".gpu/\n")
    subprocess.run(["git", "init", "-q"], cwd=folder, check=True)
    (folder / ".gpu").mkdir()
    for name, size in (("site", 6_000_000), ("llvm", 1000)):
        (tmp_path / "content").write_bytes(os.urandom(size))
        with tarfile.open(folder / ".gpu" / f"{name}.tar.xz", "w:xz", preset=0) as archive:
            archive.add(tmp_path / "content", "content")
    return folder


@pytest.mark.parametrize("name", SCRIPTS)
def test_the_scripts_parse(name):
    subprocess.run(["bash", "-n", str(ROOT / "lab" / name)], check=True)


def test_help_names_every_subcommand():
    said = run(ROOT, "--help")
    assert said.returncode == 0 and all(
        f"gpu_half_hour.sh {word} " in said.stdout for word in ("pack", "loads", "probe", "go", "test", "try")
    )
    assert run(ROOT, "pakc").returncode == 2


def test_what_is_packed_is_what_the_project_uses():
    text = (ROOT / "lab" / "gpu_pack.sh").read_text()
    needed = " ".join(requires("sdps") or ()).lower()
    (missing,) = re.findall(r"MISSING='(.*)'", text)
    assert all(name in needed for name in missing.split())
    found = find_spec("mitsuba")  # not imported: the variant is chosen elsewhere
    assert found is not None and found.origin is not None
    plugins = [name for part in re.findall(r"PLUGINS\+?='(.*)'", text) for name in part.split("|") if name]
    there = {path.stem for path in (Path(found.origin).parent / "plugins").iterdir()}
    assert len(plugins) > 20 and there.issuperset(plugins)
    for path in re.findall(r"assets/[\w/-]+\.safetensors", text):
        assert (ROOT / path).is_file()


def test_a_half_hour_is_loaded_rendered_trained_and_tested(checkout: Path, tmp_path: Path) -> None:
    loads = run(checkout, "loads", CALL_BYTES=str(5_700_000))
    assert loads.returncode == 0, loads.stderr
    assert sorted(path.name for path in checkout.glob(".gpu/*/*")) == ["llvm.00of1", "site.00of2", "site.01of2"]
    assert [f'carry [".gpu/{load}"]' in loads.stdout for load in (1, 2, 3)] == [True, True, False]

    python = tmp_path / "python"
    python.write_text(NOTING.replace("PYTHON", sys.executable))
    python.chmod(0o755)
    places = {name: str(tmp_path / name.lower()) for name in ("WORK", "OUT", "NOTES")}
    later = (checkout / ".gpu" / "2").rename(tmp_path / "later")  # a call brings one load
    first = run(checkout, "go", PYTHON=str(python), **places)
    assert first.returncode == 0 and "the next load" in first.stdout, first.stderr
    shutil.rmtree(checkout / ".gpu")
    shutil.copytree(later, checkout / ".gpu" / "2")
    second = run(checkout, "go", "60", PYTHON=str(python), ENOUGH="1", ROUNDS="2", VARIANT="llvm_ad_rgb", **places)
    assert second.returncode == 0 and "all done" in second.stdout, second.stderr
    assert (Path(places["WORK"]) / "site" / "content").stat().st_size == 6_000_000
    tested = run(checkout, "test", PYTHON=str(python), **places)
    assert "tests/test_gpu.py" in tested.stdout, tested.stderr

    commands = [[line.strip() for line in path.read_text().splitlines()] for path in tmp_path.glob("notes.*")]
    assert {variant for variant, command, *_ in commands if command == "render-data"} == {"llvm_ad_rgb"}
    assert sorted(command for _, command, *_ in commands) == ["render-data"] * 4 + ["train"] * 2
    for _, *words in commands:
        args = cli.build_parser([words[0]]).parse_args(words)
        preset = presets.load(args.preset, args.overrides)
        if words[0] == "train":
            assert preset.run(args.models).config.minutes == 20 and preset.run(args.models).config.resident
