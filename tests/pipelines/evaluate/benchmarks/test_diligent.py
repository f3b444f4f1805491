"""DiLiGenT by folder: protocols, tables with published rows, resuming, on exports of our own and the real ball."""

import json
import os
import shutil
import zipfile
from pathlib import Path

import benchmark_folders as folders
import cv2
import numpy as np
import pytest
import torch

from pipelines.evaluate.benchmarks import suite
from pipelines.evaluate.benchmarks.diligent import OBJECTS, DiligentConfig, diligent_objects
from pipelines.evaluate.evaluation import Result
from pipelines.evaluate.published import read_published_rows
from pipelines.evaluate.report.sections import read_sections
from pipelines.evaluate.score_tables import object_table
from render.shared.config import to_plain
from render.shared.errors import InputError
from render.shared.images import read_image, write_png
from sdps.data.augment import Augmentation
from sdps.methods import select
from sdps.methods.parse import parse
from sdps.methods.pretrained import finder
from sdps.methods.runner import Runner
from sdps.models.checkpoint import TrainedModel, save_weights
from sdps.models.registry import create

DATA = os.environ.get("SDPS_SHARED_DATA")


@pytest.fixture(scope="module")
def tree(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return folders.write_diligent(tmp_path_factory.mktemp("diligent") / "set", ("bear", "ball", "cone"))


@pytest.fixture(scope="module")
def models(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder of a run with an untrained LCNet in it."""
    out = tmp_path_factory.mktemp("runs")
    torch.manual_seed(0)
    metadata = {"config": {"augmentation": to_plain(Augmentation())}}
    options = {"direction_classes": 36, "intensity_classes": 20}
    model = TrainedModel("lcnet", create("lcnet", **options).eval(), options, metadata)
    save_weights(out / "models" / "lcnet" / "lcnet.safetensors", model)
    return out


def scores(out: Path) -> dict:
    return json.loads((out / "diligent" / "results.json").read_text())


@pytest.mark.parametrize("quantity", ["directions", "intensities", "normals"])
def test_published_rows_are_whole_and_average_to_what_was_printed(quantity):
    for row in read_published_rows("diligent", quantity):
        assert set(row.figures) in (set(), set(OBJECTS)), row.method
        if row.figures:
            tolerance = 0.0011 if row.average < 1 else 0.06  # averages were printed from unrounded figures
            assert np.mean(list(row.figures.values())) == pytest.approx(row.average, abs=tolerance), row.method


def test_known_cells_of_the_paper():
    rows = {row.method: row for row in read_published_rows("diligent", "normals")}
    assert rows["SDPS-Net"].figures["harvest"] == 17.43 and rows["LINO-UniPS"].figures["reading"] == 6.67
    assert read_published_rows("diligent", "directions")[1].figures["goblet"] == 10.36


def test_exact_answers_tables_and_resuming(tree, models, tmp_path, capsys, monkeypatch):
    command = ("evaluate diligent", tree, "--out", tmp_path, "--models", models, "--bits", "16",
               "--methods", "least-squares,lcnet,lcnet+least-squares,constant")  # fmt: skip
    assert folders.run(*command) == 0
    text = capsys.readouterr().out
    results = scores(tmp_path)
    assert list(results["objects"]) == ["ball", "bear", "cone"]  # the benchmark's order, then others
    for name in results["objects"]:
        assert results["methods"]["least-squares, true lights"][name]["scores"]["normal_mae"] < 0.1
    assert results["weights"] == {"lcnet": str(models / "models/lcnet/lcnet.safetensors")}
    directions, _, normals = results["tables"].values()
    assert directions["header"][:4] == ["method", "source", "ball", "cat"]
    assert directions["header"][-2:] == ["mean of 3", "all 10"]
    ours = [row[0] for row in directions["rows"] if row[1] == "ours"]
    # The lights of lcnet + least-squares are lcnet's; lights that are given have no score.
    assert ours == ["lcnet", "constant predictor"]
    assert next(row[0] for row in normals["rows"] if row[1] == "ours") == "least-squares, true lights"
    by_name = {row[0]: dict(zip(normals["header"], row, strict=True)) for row in normals["rows"]}
    assert by_name["SDPS-Net"]["ball"] == "2.77" and by_name["SDPS-Net"]["mean of 3"] == "-"
    assert by_name["least-squares, true lights"]["cat"] == "-"
    assert by_name["PX-Net, true lights"]["all 10"] == "6.33"
    assert "16 bits" in text and "bear with all 96 images" in text and "SDPS-Net, CVPR 2019" in text
    ((folder, section),) = read_sections(tmp_path)
    assert len(section.strips) == 3 and (folder / section.strips[0].pictures[0].file).is_file()
    assert [picture.caption.split(",")[0] for picture in section.strips[0].pictures][:2] == ["input", "true normals"]

    def refuse(*_, **__):
        raise AssertionError("a method ran again")

    monkeypatch.setattr(Runner, "estimate", refuse)
    assert folders.run(*command) == 0
    assert scores(tmp_path)["methods"] == results["methods"]
    with pytest.raises(AssertionError):  # other bits are other images
        folders.run(*command[:-3], "8", *command[-2:])


def test_eight_bits_are_the_high_byte(tree):
    low, high = (diligent_objects(tree, DiligentConfig(bits=bits))[0] for bits in (8, 16))
    path = tree / "pmsData" / "ballPNG" / "001.png"
    pixels = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    assert pixels.dtype == np.uint16
    assert low.load()[0:1].max() == np.float32((pixels // 256).max() / 255)
    assert high.load()[0:1].max() == pytest.approx(pixels.max() / 65535)
    assert 0 < np.abs(folders.whole(low.load()) - folders.whole(high.load())).max() < 2 / 255
    assert low.digest != high.digest


def test_crop_and_mask(tree):
    item = diligent_objects(tree, DiligentConfig(margin=3))[0]
    full = read_image(tree / "pmsData/ballPNG/mask.png", channels=None) > 0
    assert item.mask.sum() == full.sum()
    assert all(side % 4 == 0 for side in item.mask.shape) and item.mask.shape[0] < full.shape[0]
    images = folders.whole(item.load())
    assert images.shape == (folders.LIGHTS, *item.mask.shape, 3) and not images[:, ~item.mask].any()
    assert item.intensities.shape == (folders.LIGHTS, 3)


def test_bear_may_lose_its_first_images(tree):
    objects = [{item.name: item for item in diligent_objects(tree, DiligentConfig(bear=count))} for count in (96, 76)]
    every, fewer = objects
    assert len(fewer["bear"].light_directions) == folders.LIGHTS - 20
    assert np.array_equal(every["bear"].light_directions[20:], fewer["bear"].light_directions)
    assert np.array_equal(folders.whole(every["bear"].load())[20:], folders.whole(fewer["bear"].load()))
    assert len(fewer["ball"].light_directions) == folders.LIGHTS
    assert fewer["bear"].digest != every["bear"].digest and fewer["ball"].digest == every["ball"].digest


def test_a_few_images_of_each_object_are_drawn_the_same_every_time(tree):
    every = next(item for item in diligent_objects(tree, DiligentConfig()) if item.name == "bear")
    few, again = (next(item for item in diligent_objects(tree, DiligentConfig(images=5)) if item.name == "bear")
                  for _ in range(2))  # fmt: skip
    place = [every.true_directions.tolist().index(light) for light in few.true_directions.tolist()]
    assert len(place) == 5 and place == sorted(place) and place != list(range(5))
    assert np.array_equal(folders.whole(few.load()), folders.whole(every.load())[place])
    assert few.digest == again.digest != every.digest


def test_more_images_than_there_are_is_refused(tree):
    with pytest.raises(InputError, match="--images wants 1000"):
        diligent_objects(tree, DiligentConfig(images=1000))


@pytest.mark.parametrize("where", ["pmsData", "pmsData/conePNG", "."])
def test_any_of_the_folders_is_taken(tree, where):
    assert "cone" in {item.name for item in diligent_objects(tree / where, DiligentConfig())}


def test_foreign_objects_alone_have_no_published_rows():
    found = {"ours": {"cone": Result({"normal_mae": 1.0})}}
    table = object_table("t", found, "normal_mae", present=["cone"], known=OBJECTS, digits=2,
                         published=read_published_rows("diligent", "normals"))  # fmt: skip
    assert table.header == ("method", "source", "cone", "this object") and len(table.rows) == 1


def test_a_refusal_is_shown():
    found = {"m": {"ball": Result({}, reason="too few"), "cat": Result({"normal_mae": 2.0})}}
    table = object_table("t", found, "normal_mae", present=["ball", "cat"], known=OBJECTS, digits=2, published=())
    assert table.rows[0][2:4] == ("refused", "2.00") and table.rows[0][-2:] == ("-", "-")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--methods", "pf-14"], "did you mean 'pf14'"),
        (["--methods", "lcnet+pf14"], "finds the lights itself"),
        (["--methods", "lcnet+"], "LIGHTS\\+NORMALS"),
        (["--methods", "true"], "which normals"),
        (["--methods", "nenet-reg"], "train"),
        (["--objects", "bal"], "did you mean 'ball'"),
        (["--models", "nowhere"], "no trained weights"),
    ],
)
def test_bad_flags_are_one_line(tree, models, tmp_path, arguments, message):
    given = [] if "--models" in arguments else ["--models", models]
    with pytest.raises(InputError, match=message) as error:
        folders.run("evaluate diligent", tree, "--out", tmp_path / "out", *given, *arguments)
    assert "\n" not in str(error.value) and not (tmp_path / "out").exists()


def break_missing(folder: Path) -> None:
    (folder / "003.png").unlink()


def break_lights(folder: Path) -> None:
    (folder / "light_directions.txt").write_text("0 0 1\n")


def break_size(folder: Path) -> None:
    write_png(folder / "002.png", np.zeros((8, 8, 3), np.uint16))


def break_depth(folder: Path) -> None:
    write_png(folder / "002.png", np.zeros((folders.SIZE, folders.SIZE, 3), np.uint8))


@pytest.mark.parametrize(
    ("harm", "message"),
    [
        (break_missing, "003.png"),
        (break_lights, "1 rows for"),
        (break_size, "8x8"),
        (break_depth, "--bits 8"),
        (shutil.rmtree, "."),
    ],
)
def test_bad_folders_are_one_line(tree, tmp_path, harm, message):
    copy = tmp_path / "ballPNG"
    shutil.copytree(tree / "pmsData" / "ballPNG", copy)
    harm(copy)
    with pytest.raises(InputError, match=message) as error:
        folders.run("evaluate diligent", copy, "--bits", "16", "--methods", "least-squares", "--out", tmp_path / "out")
    assert "\n" not in str(error.value) and not (tmp_path / "out" / "diligent" / "results.json").exists()


def test_expressions(models):
    assert parse("least-squares", finder(None)).lighting == "true"
    assert parse("pf14", finder(None)).lighting == ""
    both = parse("lcnet + least-squares", finder(models))
    assert (both.lighting, both.normals) == ("lcnet", "least-squares")
    alone = parse("lcnet", finder(models))
    assert (alone.lighting, alone.normals, alone.name) == ("lcnet", "", "lcnet")
    learned, classic = (select.select_methods([kind], models) for kind in ("learned", "classical"))
    assert all(method.models() or "true lights" in method.name for method in learned)
    assert not any(method.models() for method in classic)
    names = [method.name for method in select.every_method(models)]
    assert set(names) == {method.name for method in (*learned, *classic)}
    assert len(set(names)) == len(names) and {"lcnet", "lcnet + least-squares", "pf14", "constant predictor"} <= set(
        names
    )
    assert select.runs_folder(models / "models") == models.resolve()


def test_lights_over_eight_views_have_a_row_of_their_own(models):
    learned = {method.name: method for method in select.select_methods(["learned"], models)}
    views = learned["lcnet-soft (shipped), 8 views"]
    assert (views.normals, views.light_views) == ("", 8)
    assert list(suite.drop_repeated_lights(learned, list(learned.values())))[:2] == ["lcnet", "lcnet (shipped)"]
    kept = suite.drop_repeated_lights(learned, list(learned.values()))
    assert views.name in kept and not any("+" in name for name in kept)  # whose lights are a network's alone
    few = select.select_methods(["shipped:lcnet-soft", "shipped:sdps-plus"], models)
    assert len(suite.drop_repeated_lights({method.name: method for method in few}, few)) == 2  # one view, eight views


@pytest.mark.skipif(not DATA, reason="SDPS_SHARED_DATA names no folder with diligent_ball.zip")
def test_the_real_ball(tmp_path):
    """4.17 degrees: the benchmark's own baseline with all 96 images at 16 bits."""
    with zipfile.ZipFile(Path(DATA) / "diligent_ball.zip") as archive:
        archive.extractall(tmp_path)
    errors = {}
    for bits in (8, 16):
        out = tmp_path / str(bits)
        folders.run("evaluate diligent", tmp_path, "--methods", "least-squares", "--bits", bits, "--out", out)
        errors[bits] = scores(out)["methods"]["least-squares, true lights"]["ball"]["scores"]["normal_mae"]
    assert errors[16] == pytest.approx(4.17, abs=0.02)
    assert errors[8] == pytest.approx(4.49, abs=0.05)  # the low byte is cut off, not rounded
    assert scores(out)["objects"]["ball"]["images"] == 96


def test_a_focal_length_goes_with_the_cropped_pictures(tree: Path) -> None:
    plain, seen = (diligent_objects(tree, DiligentConfig(focal=focal))[0] for focal in (0.0, 3772.0))
    assert plain.camera is None and plain.digest != seen.digest
    picture = cv2.imread(str(tree / "pmsData" / "ballPNG" / "mask.png"), cv2.IMREAD_GRAYSCALE)
    whole, (rows, columns), inside = picture.shape, np.nonzero(picture), np.nonzero(seen.mask)
    assert seen.camera.focal == 3772.0  # the middle of the whole picture, where the part has it
    assert seen.camera.principal == pytest.approx(
        ((whole[1] - 1) / 2 - columns.min() + inside[1].min(), (whole[0] - 1) / 2 - rows.min() + inside[0].min())
    )
    with pytest.raises(InputError, match="focal must be a length in pixels"):
        DiligentConfig(focal=-1.0)
