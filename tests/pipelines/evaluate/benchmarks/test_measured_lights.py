"""Gourd&Apple and Light Stage folders in their published layouts: frames, masks, which images, tables, refusals."""

import json
import logging
from pathlib import Path

import benchmark_folders as folders
import numpy as np
import pytest

from pipelines.evaluate.benchmarks import stacks
from pipelines.evaluate.benchmarks.lit_photographs import gourd_apple_objects, light_stage_objects, pick_front
from pipelines.evaluate.published import read_published_rows
from render.shared.errors import InputError
from render.shared.images import write_png
from sdps.classical import registry
from sdps.core.metrics import normal_mae


@pytest.fixture
def apple(tmp_path) -> Path:
    return folders.write_gourd_apple(tmp_path / "GourdApple")


@pytest.fixture
def stage(tmp_path) -> Path:
    return folders.write_light_stage(tmp_path / "LightStage")


def normals_off(item) -> float:
    """Return the error of least squares under the lights as read: large if any axis is turned."""
    _, _, normals = folders.photographs(np.array([[0.0, 0.0, 1.0]]), np.ones((1, 3)))
    images = folders.whole(item.load())
    estimate = registry.run("least-squares", images, item.mask, item.light_directions, item.intensities)
    truth = np.zeros_like(estimate.normals)
    rows, columns = np.nonzero(item.mask)
    full_rows, full_columns = np.nonzero(normals[..., 2] > 0)
    truth[rows, columns] = normals[full_rows, full_columns]  # the crop keeps the object's shape
    return normal_mae(estimate.normals, truth, item.mask)


@pytest.mark.parametrize("quantity", ["directions", "intensities"])
@pytest.mark.parametrize("dataset", ["gourd-apple", "light-stage"])
def test_published_rows_average_to_what_was_printed(dataset, quantity):
    for row in read_published_rows(dataset, quantity):
        if row.figures:
            tolerance = 0.0011 if row.average < 1 else 0.011
            assert np.mean(list(row.figures.values())) == pytest.approx(row.average, abs=tolerance), row.method


@pytest.mark.parametrize("packed", [False, True])
def test_gourd_apple_is_read_in_its_frame(tmp_path, packed):
    root = folders.write_gourd_apple(tmp_path / "set", packed=packed)
    (item,) = gourd_apple_objects(root)
    assert item.name == "apple" and item.normals is None and len(item.light_directions) == 9
    assert normals_off(item) < 0.2
    assert not folders.whole(item.load())[:, ~item.mask].any()
    (alone,) = gourd_apple_objects(root / "apple")
    assert alone.digest == item.digest


def test_refined_or_measured_lights(apple):
    (refined,), (measured,) = gourd_apple_objects(apple), gourd_apple_objects(apple, refined=False)
    assert np.abs(refined.light_directions - measured.light_directions).max() > 0.05
    assert refined.digest != measured.digest


def test_light_stage_is_turned_and_what_is_behind_left_out(stage):
    (item,) = light_stage_objects(stage)
    assert len(item.light_directions) == 9 and (item.light_directions[:, 2] > 0).all()
    assert normals_off(item) < 1.0  # 8 bits
    brightest = folders.whole(item.load()).mean(-1)
    for light, image in zip(item.light_directions, brightest, strict=True):
        rows, columns = np.nonzero(image == image.max())
        centre = np.array(item.mask.shape) / 2 - 0.5
        assert light[0] * (columns.mean() - centre[1]) >= -1.0  # a light at +x brightens the right side
        assert light[1] * (rows.mean() - centre[0]) <= 1.0  # and one at +y the top
    (alone,) = light_stage_objects(stage / "plant_left")
    assert alone.digest == item.digest


def test_matte_of_either_polarity(stage):
    (dark,) = light_stage_objects(stage)
    path = stage / "plant_left" / "plant_left_matte.png"
    _, mask, _ = folders.photographs(np.array([[0.0, 0.0, 1.0]]), np.ones((1, 3)))
    write_png(path, mask.astype(np.uint8) * 255)
    (bright,) = light_stage_objects(stage)
    assert np.array_equal(dark.mask, bright.mask)


def test_packed_light_stage_takes_every_image(stage):
    directions = np.array([[0.0, 0.0, 1.0], [0.3, 0.0, 0.95]])
    images, _, _ = folders.photographs(directions, np.ones((2, 3)))
    np.save(stage / "plant_left" / "plant_left_uncalib.npy", np.concatenate(list(images), axis=2))
    folders.write_rows(stage / "light_directions.txt", -directions)
    folders.write_rows(stage / "light_intensities.txt", np.ones((2, 3)))
    (item,) = light_stage_objects(stage)
    assert len(item.load()) == 2 and np.allclose(item.light_directions[1], directions[1] / 0.99624, atol=1e-4)


def test_another_number_of_front_lights_than_the_papers_is_logged(caplog):
    directions = np.tile([0.0, 0.0, 1.0], (253, 1))
    directions[:120, 2] = -1.0
    with caplog.at_level(logging.WARNING):
        assert len(pick_front(directions, 0.0)) == 133
        assert not caplog.records
        directions[120, 2] = -1.0
        pick_front(directions, 0.0)
    assert "132 of the 253 lights" in caplog.text


def test_gamma_and_size(stage):
    (plain,), (bent,) = light_stage_objects(stage), light_stage_objects(stage, gamma=2.2)
    assert np.allclose(folders.whole(plain.load()) ** 2.2, folders.whole(bent.load()), atol=1e-5)
    (small,) = light_stage_objects(stage, longest=32)
    assert max(small.mask.shape) == 32 and folders.whole(small.load()).shape[1:3] == small.mask.shape
    assert len({plain.digest, bent.digest, small.digest}) == 3


def test_large_stacks_stay_on_disk(stage, monkeypatch):
    (item,) = light_stage_objects(stage)
    images = item.load().open()
    assert isinstance(images, np.ndarray)
    monkeypatch.setattr(stacks, "_KEPT_BYTES", 10)
    assert item.load().open() is item.load() and np.array_equal(folders.whole(item.load()), images)
    (stage / "plant_left" / "plant_left_000.png").write_bytes(b"torn")
    with pytest.raises(InputError, match="plant_left_000"):
        item.load().open()


@pytest.mark.parametrize("dataset", ["gourd-apple", "light-stage"])
def test_tables_and_section(apple, stage, tmp_path, capsys, dataset):
    data = {"gourd-apple": apple, "light-stage": stage}[dataset]
    command = (f"evaluate {dataset}", data, "--methods", "factorisation,constant", "--out", tmp_path)
    assert folders.run(*command) == 0
    text = capsys.readouterr().out
    assert "LCNet" in text and "SDPS-Net, CVPR 2019" in text and "no true normals" in text.lower()
    results = json.loads((tmp_path / dataset / "results.json").read_text())
    directions, intensities = results["tables"].values()
    rows = {row[0]: dict(zip(directions["header"], row, strict=True)) for row in directions["rows"]}
    name = "apple" if dataset == "gourd-apple" else "plant_left"
    assert rows["LCNet"][name] == {"apple": "9.31", "plant_left": "16.06"}[name]
    expected = {"apple": "23.84", "plant_left": "17.10"}[name]  # mean angle of the lights to the view
    assert rows["constant predictor"][name] == expected
    assert intensities["rows"][-1][1] != "ours"
    assert (tmp_path / "report" / dataset / "section.json").is_file()


def drop_picture(root: Path) -> None:
    next(root.glob("*/*[0-9].*")).unlink()


def drop_lights(root: Path) -> None:
    for path in root.rglob("light_*.txt"):
        path.unlink()


def shorten_intensities(root: Path) -> None:
    for path in root.rglob("light_intensities*.txt"):
        path.write_text("1 1 1\n")


def damage_picture(root: Path) -> None:
    for path in root.glob("*/*[0-9].*"):
        path.write_bytes(b"not a picture")


def blacken_mask(root: Path) -> None:
    path = next(root.glob("*/*ma*.png"))
    write_png(path, np.zeros((62, 71), np.uint8))


@pytest.mark.parametrize("dataset", ["gourd-apple", "light-stage"])
@pytest.mark.parametrize("harm", [drop_picture, drop_lights, shorten_intensities, damage_picture, blacken_mask])
def test_bad_folders_are_one_line(apple, stage, tmp_path, dataset, harm):
    data = {"gourd-apple": apple, "light-stage": stage}[dataset]
    harm(data)
    with pytest.raises(InputError) as error:
        folders.run(f"evaluate {dataset}", data, "--methods", "factorisation", "--out", tmp_path / "o")
    assert "\n" not in str(error.value) and str(data) in str(error.value)
    assert not (tmp_path / "o" / dataset / "results.json").exists()


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (["--methods", "least-squares"], "given the lights"),
        (["--longest-side", "4"], "at least 16"),
        (["--gamma", "0"], "positive"),
        (["--least-z", "1"], "below 1"),
    ],
)
def test_bad_flags(stage, tmp_path, flags, message):
    with pytest.raises(InputError, match=message):
        folders.run("evaluate light-stage", stage, "--out", tmp_path, *flags)


def test_the_line_that_is_wrong_is_blamed(apple):
    path = next(apple.rglob("light_intensities_refined.txt"))
    rows = path.read_text().splitlines()
    path.write_text("\n\n" + "\n\n".join([*rows[:2], "1 0 1", *rows[3:]]))
    with pytest.raises(InputError, match=r"line 7 is not positive"):
        gourd_apple_objects(apple)
