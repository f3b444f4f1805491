"""The whole line at the smallest scale: render, train, evaluate."""

import json
import re

import numpy as np
import pytest
from command_line import fails

from pipelines.cli import main
from pipelines.shared import presets
from render.planning import light_sets


def test_the_whole_line_at_smoke_scale(capsys, tmp_path):
    fewer = ("lighting.steps=2", "normals.steps=2", "test.lights=near-uniform:12", "test.materials=[chrome]")
    flags = ["--preset", "smoke", "--out", str(tmp_path), *(word for item in fewer for word in ("--set", item))]
    for command in ("render-data", "train", "eval-merltest"):
        assert main([command, *flags]) == 0, capsys.readouterr().err
    text = capsys.readouterr().out
    assert "Table A, lighting estimation" in text and "constant predictor" in text
    results = json.loads((tmp_path / "eval" / "results.json").read_text())
    assert len(results["scenes"]) == 2
    lights = light_sets.load("near-uniform:12")
    for scene in results["scenes"]:
        constant = scene["scores"]["constant predictor"]
        assert constant["direction_mae"] == pytest.approx(np.degrees(np.arccos(lights[:, 2])).mean(), abs=0.1)
        assert scene["scores"]["least-squares, true lights"]["normal_mae"] < 35
        assert 0 < scene["scores"]["lcnet + nenet"]["normal_mae"] < 90
    page = (tmp_path / "report.html").read_text()
    assert page.count("data:image/png;base64,") >= 2 * 6
    assert not re.search(r"(src|href)=\"(?!data:|#)", page)  # self-contained
    for folder in ("data", "models/lcnet", "models/nenet", "merltest", "eval"):
        assert presets.load(str(tmp_path / folder / "config.yaml")).name == "smoke"
    for name in ("lcnet.safetensors", "lcnet-best.safetensors", "curves.png", "MODEL_CARD.md"):
        assert (tmp_path / "models" / "lcnet" / name).stat().st_size > 100
    evaluate_combinations(capsys, flags, tmp_path)


def evaluate_combinations(capsys, flags, out):
    """Train two more models in the folder of the line above, and combine what is there."""
    assert main(["train", *flags, "--models", "psfcn,cnnps", "--set", "pixels.steps=1"]) == 0
    assert "psfcn: 2 steps" in (text := capsys.readouterr().out) and "cnnps: 1 steps" in text
    flags = [*flags, "--set", "test.rotations=1"]
    combinations = {
        "lcnet + psfcn": ["--lighting", "lcnet", "--normals", "psfcn"],
        "lcnet + cnnps": ["--lighting", "lcnet", "--normals", "cnnps"],
        "cnnps, true lights": ["--normals", "cnnps"],
        "lcnet + nenet, true intensities": ["--normals", "sdps", "--intensities", "true"],
        "lcnet + least-squares": ["--lighting", "lcnet", "--normals", "least-squares"],
    }
    for name, words in combinations.items():
        assert main(["evaluate", "merltest", *flags, *words]) == 0
        assert name in capsys.readouterr().out
    scores = json.loads((out / "eval" / "results.json").read_text())["scenes"][0]["scores"]
    assert "direction_mae" not in scores["least-squares, true lights"]  # what was given is not scored
    assert "did you mean 'psfcn'" in fails(
        capsys, "evaluate", "merltest", *flags, "--lighting", "lcnet", "--normals", "psfnc"
    )
    line = fails(capsys, "evaluate", "merltest", *flags, "--normals", "sdps-reg")
    assert "no such weights; train them with `sdps train --models" in line
