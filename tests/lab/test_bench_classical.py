"""`python -m lab bench-classical`."""

import json

import pytest

from lab.bench import bench_classical
from lab.commands import main as lab_main


def test_bench_measures_each_method_in_its_own_process(tmp_path, capsys):
    arguments = ["--height", "40", "--width", "48", "--lights", "12", "--out", str(tmp_path)]
    assert lab_main(["bench-classical", *arguments, "--methods", "least-squares,factorisation"]) == 0
    found = json.loads((tmp_path / "bench_classical.json").read_text())["methods"]
    assert found["factorisation"]["peak_gib"] > 0 and found["least-squares"]["normal_mae"] < 20
    assert "times least squares" in capsys.readouterr().out


@pytest.mark.parametrize("arguments", [["--height", "8"], ["--lights", "3"]])
def test_bench_too_small(arguments, capsys):
    assert lab_main(["bench-classical", *arguments]) == 2
    assert "at least" in capsys.readouterr().err


def test_bench_shows_refusals_and_figures():
    found = {"sm10": {"error": "needs colour"}, "least-squares": {"error": "", "seconds": 2.0, "peak_gib": 1.0,
             "input_gib": 0.5, "pixels": 10, "normal_mae": 3.0}}  # fmt: skip
    text = bench_classical.table(found, bench_classical.BenchClassicalConfig())
    assert "needs colour" in text and "yes" in text
