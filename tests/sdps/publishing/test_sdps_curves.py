"""Learning curves: pictures from what a run leaves, and what is done with files that are not whole."""

import json
import threading
from pathlib import Path

import matplotlib
import numpy as np
import pytest
from PIL import Image

from render.shared.errors import InputError
from sdps.publishing import learning_curves


def write_metrics(path: Path, steps: int = 60, *, seconds: bool = True, metric: str = "val_normal_mae") -> Path:
    rng = np.random.default_rng(0)
    with open(path, "w", encoding="utf-8") as handle:
        for step in range(1, steps + 1):
            row = {"step": step, "loss": 2 / step + 0.1 * rng.random(), "azimuth_loss": 1 / step,
                   "images_per_second": 90 + rng.random(), "waiting_share": 0.01, "learning_rate": 1e-3}  # fmt: skip
            handle.write(json.dumps(row | ({"seconds": 30.0 * step} if seconds else {})) + "\n")
            if step % 20 == 0:
                errors = {metric: 40 / step, "val_intensity_error": 0.2, "val_loss": 1.0}
                handle.write(json.dumps({"step": step, **errors}) + "\n")
    return path


def test_curves_are_a_legible_picture(tmp_path: Path) -> None:
    learning_curves.write_curves(write_metrics(tmp_path / "metrics.jsonl"), tmp_path / "curves.png")
    with Image.open(tmp_path / "curves.png") as picture:
        assert picture.width == 1000
        assert picture.height > 600
        assert np.asarray(picture.convert("L")).std() > 5  # something is drawn
    assert [path.name for path in tmp_path.iterdir() if path.suffix == ".png"] == ["curves.png"]


def test_panels_have_one_unit_each(tmp_path: Path) -> None:
    rows = learning_curves.read_metrics(write_metrics(tmp_path / "metrics.jsonl"))
    panels = {panel.title: (panel.unit, panel.names) for panel in learning_curves._panels(rows)}
    assert panels["validation, angles"] == ("degrees", ["val_normal_mae"])
    assert panels["validation, intensities"] == ("relative error", ["val_intensity_error"])
    assert panels["training loss"] == ("loss", ["loss", "azimuth_loss"])
    assert set(panels) == {"training loss", "validation, angles", "validation, intensities", "validation loss",
                           "learning rate", "speed"}  # fmt: skip


def test_hours_follow_the_recorded_seconds(tmp_path: Path) -> None:
    rows = learning_curves.read_metrics(write_metrics(tmp_path / "metrics.jsonl"))
    steps = np.array([0.0, 12.0, 60.0, 120.0])
    hours = learning_curves._hours(rows, steps)
    np.testing.assert_allclose(hours, 30.0 * steps / 3600.0)
    np.testing.assert_allclose(learning_curves._hours(rows, hours, inverse=True), steps)


def test_a_run_without_times_or_validation_is_drawn(tmp_path: Path) -> None:
    path = tmp_path / "metrics.jsonl"
    path.write_text('{"step": 1, "loss": 2.0}\n{"step": 2, "loss": NaN}\n')
    learning_curves.write_curves(path, tmp_path / "curves.png")
    with Image.open(tmp_path / "curves.png") as picture:
        assert picture.width == 1000


def test_a_half_written_last_line_is_passed_over(tmp_path: Path) -> None:
    path = write_metrics(tmp_path / "metrics.jsonl", 5)
    whole = learning_curves.read_metrics(path)
    with open(path, "a", encoding="utf-8") as handle:
        handle.write('{"step": 6, "lo')
    assert learning_curves.read_metrics(path) == whole


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (None, "no such file"),
        ("", "no metrics yet"),
        ('{"step": 1, "lo', "no metrics yet"),
        ('{"loss": 1.0}\n', "line 1 has no step"),
        ('[1]\n{"step": 1}\n', "line 1 has no step"),
        ('{"step": 1\n{"step": 2}\n', "line 1 is not JSON"),
        ('{"step": 1}\n', "no figures to plot"),
    ],
)
def test_files_that_are_no_metrics_are_refused(tmp_path: Path, text: str | None, message: str) -> None:
    path = tmp_path / "metrics.jsonl"
    if text is not None:
        path.write_text(text)
    with pytest.raises(InputError, match=message) as caught:
        learning_curves.write_curves(path, tmp_path / "curves.png")
    assert "\n" not in str(caught.value)
    assert not (tmp_path / "curves.png").exists()


def test_nothing_global_is_left_behind(tmp_path: Path) -> None:
    before = dict(matplotlib.rcParams)
    path = write_metrics(tmp_path / "metrics.jsonl", 20)
    failed: list[Exception] = []

    def draw() -> None:
        try:
            learning_curves.write_curves(path, tmp_path / "curves.png")
        except Exception as error:
            failed.append(error)

    thread = threading.Thread(target=draw)  # no window system, no main thread needed
    thread.start()
    thread.join()
    assert not failed
    assert dict(matplotlib.rcParams) == before
