"""Every example runs and writes what it says."""

import json
import os
import runpy
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image

import render

ROOT = Path(__file__).resolve().parent.parent


def command(name: str, *flags: object) -> str:
    """Run an example in a process of its own and return what it says."""
    words = [sys.executable, str(ROOT / "examples" / name), *map(str, flags)]
    environment = os.environ | {"PYTHONPATH": str(ROOT)}  # these packages, whichever are installed
    done = subprocess.run(words, cwd=ROOT, env=environment, check=False, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-2000:]
    return done.stdout


@pytest.fixture
def run(monkeypatch, capsys):
    """Return the function that does the same in this process, where everything is loaded."""

    def called(name: str, *flags: object) -> str:
        monkeypatch.setattr(sys, "argv", [name, *map(str, flags)])
        capsys.readouterr()
        runpy.run_path(str(ROOT / "examples" / name), run_name="__main__")
        return capsys.readouterr().out

    return called


def size_of(path: Path) -> tuple[int, int]:
    with Image.open(path) as picture:
        assert np.asarray(picture.convert("RGB")).std() > 1
        return picture.size


def test_render_a_scene(tmp_path):
    said = command("01_render_a_scene.py", "--out", tmp_path, "--size", 32, "--spp", 4)
    assert said.count("images (5, 32, 32, 3)") == 3
    assert size_of(tmp_path / "images.png") == (6 * 32, 3 * 32)
    for name in ("clay", "lacquer", "striped"):
        shard = render.read_shard(tmp_path / f"{name}.exr")
        assert shard.scene_id == name and shard.mask.mean() > 0.2
        from_left, from_right = shard.images[1:3].astype(np.float32)
        assert (from_left[:, :16] - from_right[:, :16]).mean() > 0 > (from_left[:, 16:] - from_right[:, 16:]).mean()
    assert (tmp_path / "lacquer.yaml").is_file()


def test_train(tmp_path, run):
    flags = ("--out", tmp_path, "--size", 32, "--shapes", 2, "--steps", 2, "--method", "pf14")
    said = run("02_train.py", *flags)
    assert said.count("step 2: loss") == 2
    for name in ("lcnet", "nenet"):
        assert (tmp_path / "models" / name / f"{name}.safetensors").is_file()
    assert "trained here: normal_mae" in said and "pf14, pretrained: normal_mae" in said
    assert size_of(tmp_path / "normals.png") == (4 * 32, 32)


@pytest.mark.parametrize("method", ["pf14", pytest.param("auto", marks=pytest.mark.slow)])
def test_photographs_to_mesh(tmp_path, run, method):
    said = run("03_photographs_to_mesh.py", "--out", tmp_path, "--size", 64, "--count", 12, "--method", method)
    assert "normal_mae" in said and len(list((tmp_path / "photographs").glob("0*.png"))) == 12
    assert size_of(tmp_path / "relit.png") == size_of(tmp_path / "normals.png") == (64, 64)
    faces = len(trimesh.load(tmp_path / "mesh.ply").faces)
    assert f"mesh of {faces} triangles" in said and faces > 300
    again = run("03_photographs_to_mesh.py", tmp_path / "photographs", "--out", tmp_path / "own", "--method", method)
    assert "normal_mae" not in again and (tmp_path / "own" / "mesh.ply").is_file()


@pytest.mark.parametrize("method", ["pf14", pytest.param("auto", marks=pytest.mark.slow)])
def test_the_notebook(method, capsys):
    """Its cells in order, smaller, without Jupyter."""
    notebook = json.loads((ROOT / "examples" / "04_scene_and_inference.ipynb").read_text())
    shown = []
    names = {"display": lambda *pictures: shown.extend(pictures)}
    for cell in notebook["cells"]:
        assert not cell.get("outputs"), "outputs do not belong into the repository"
        if cell["cell_type"] == "code":
            source = "".join(cell["source"]).replace('128, 32, 48, "auto"', f'32, 4, 12, "{method}"')
            exec(compile(source, "notebook", "exec"), names)
    assert "normal_mae: " in capsys.readouterr().out
    assert [picture.size for picture in shown] == [(96, 96)] * 4
