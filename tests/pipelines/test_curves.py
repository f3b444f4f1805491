"""`sdps curves`, and the law behind its predictions."""

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from pipelines import cli
from render.shared.errors import InputError
from sdps.publishing.extrapolation import PowerLaw, fit_power_law, predicted_range


def write_run(folder: Path, law: PowerLaw, noise: float = 0.0) -> Path:
    folder.mkdir(parents=True)
    steps = np.arange(500, 8500, 500)
    scatter = 1.0 + noise * np.random.default_rng(0).standard_normal(len(steps))
    rows = [{"step": int(k), "val_normal_mae": float(v)} for k, v in zip(steps, law.at(steps) * scatter, strict=True)]
    (folder / "metrics.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    return folder


def test_a_power_law_is_found_again() -> None:
    law, steps = PowerLaw(3.0, 300.0, 0.6), np.arange(500, 16000, 500)
    found = fit_power_law(steps, law.at(steps))
    np.testing.assert_allclose(found.at(np.array([1e3, 1e5])), law.at(np.array([1e3, 1e5])), rtol=0.02)
    values = law.at(steps) * (1.0 + 0.02 * np.random.default_rng(1).standard_normal(len(steps)))
    low, middle, high = predicted_range(steps, values, 1e5, fits=50)
    assert low < law.at(1e5) < high and 0.7 * law.at(1e5) < middle < 1.3 * law.at(1e5)


def test_too_few_points_are_refused() -> None:
    with pytest.raises(InputError, match="at least 5 positive points, got 3"):
        fit_power_law(np.array([1, 2, 3]), np.array([3.0, 2.0, 1.0]))


def test_the_command_draws_and_predicts(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    runs = [
        write_run(tmp_path / name, PowerLaw(floor, 300.0, 0.6), 0.01) for name, floor in (("one", 2.0), ("two", 4.0))
    ]
    picture = tmp_path / "curves.png"
    common = [*map(str, runs), "--value", "val_normal_mae", "--picture", str(picture)]
    assert cli.main(["curves", *common]) == 0
    text = capsys.readouterr().out
    assert "one" in text and "two" in text and "8000" in text and "fit" not in text
    assert cli.main(["curves", *common, "--between", "1000:8000", "--at", "100000"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert "at 100,000" in lines[1] and "step^-" in lines[2]
    assert Image.open(picture).width == 1000


def test_mistakes_are_one_line(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    run = str(write_run(tmp_path / "one", PowerLaw(2.0, 300.0, 0.6)))
    for flags, message in (
        (["--between", "many"], "--between takes two steps"),
        (["--value", "val_normals_mae"], "did you mean 'val_normal_mae'"),
    ):
        assert cli.main(["curves", run, "--picture", str(tmp_path / "x.png"), "--value", "val_normal_mae", *flags]) == 2
        assert message in capsys.readouterr().err
    assert cli.main(["curves", run, run, "--value", "val_normal_mae"]) == 2
    assert "given twice" in capsys.readouterr().err
