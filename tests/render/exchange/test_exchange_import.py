"""Imported trees: round trips through shards, DiLiGenT's conventions, unusable input, and training on the result."""

import os
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from exchange_support import LIGHTS, SCENES, SIZE
from scipy.io import savemat
from sdps_scenes import hemisphere_lights, shade, sphere_normals

from pipelines.cli import main
from render.exchange.export import ExportOptions, export
from render.exchange.ingest import ImportOptions, ingest
from render.records.manifest import read_manifest
from render.records.shards import Shard, is_whole, read_shard
from render.shared.errors import InputError
from sdps.classical.least_squares import least_squares
from sdps.core.metrics import normal_mae
from sdps.training.stages import LightingStage
from sdps.training.trainer import train
from sdps.training.training_config import LightingTraining


@pytest.fixture(scope="module")
def trees(data, tmp_path_factory) -> dict[str, Path]:
    """Return trees with other options than the default, read-only by convention."""
    root = tmp_path_factory.mktemp("trees")
    export(data, root / "psfcn", ExportOptions(layout="psfcn", exposure=0.5), read_manifest(data))
    export(data, root / "diligent", ExportOptions(layout="diligent", intensities="seed"), read_manifest(data))
    return {layout: root / layout for layout in ("psfcn", "diligent")}


def shards(folder: Path) -> list[Shard]:
    return [read_shard(folder / scene.file, scene) for scene in read_manifest(folder)]


def angles(first: Shard, second: Shard) -> np.ndarray:
    cosine = (first.normals.astype(np.float64) * second.normals)[first.mask].sum(-1)
    return np.degrees(np.arccos(np.clip(cosine, -1, 1)))


def test_psfcn_round_trip(data, trees, tmp_path):
    report = ingest(trees["psfcn"], tmp_path, ImportOptions(layout="psfcn"))
    assert (report.written, report.kept, report.suspicions) == (len(SCENES), 0, {})
    assert [scene.split for scene in report.scenes] == [split for _, split, *_ in SCENES]
    first = report.scenes[0]
    assert (first.id, first.shape, first.material) == (
        "blobby-00001-v0_blue-fabric", "imported:blobby-00001-v0", "imported:blue-fabric",
    )  # fmt: skip
    assert (first.spp, first.bounces, first.size) == (0, 0, SIZE)
    for before, after in zip(shards(data), shards(tmp_path), strict=True):
        clipped = np.minimum(before.images.astype(np.float32), 2.0)  # full scale at exposure 0.5
        np.testing.assert_allclose(after.images.astype(np.float32), clipped, atol=1.0 / 255 + 1e-3)
        np.testing.assert_array_equal(after.mask, before.mask)
        np.testing.assert_allclose(after.light_directions, before.light_directions, atol=1e-6)
        assert angles(before, after).max() < 0.4
        assert np.abs(np.linalg.norm(after.normals[after.mask], axis=-1) - 1).max() < 1e-6
        assert not after.normals[~after.mask].any() and not after.depth.any()
        assert after.provenance["irradiance"] == "pi" and after.provenance["depth"] == "unknown, zeros"


def test_diligent_round_trip(data, trees, tmp_path):
    ingest(trees["diligent"], tmp_path, ImportOptions(layout="diligent"))
    for before, after in zip(shards(data), shards(tmp_path), strict=True):
        # 16 bits and half floats: absolute and relative steps; what `auto` clips (0.1 %) is lost.
        far = ~np.isclose(after.images.astype(np.float32), before.images.astype(np.float32), rtol=2e-3, atol=1e-4)
        assert far[:, before.mask].mean() <= 0.002
        np.testing.assert_allclose(after.normals, before.normals, atol=1e-6)
        np.testing.assert_array_equal(after.mask, before.mask)
        np.testing.assert_allclose(after.light_directions, before.light_directions, atol=1e-6)
        estimate = least_squares(after.images, after.mask, after.light_directions)
        expected = least_squares(before.images, before.mask, before.light_directions)
        assert normal_mae(estimate.normals, expected.normals, before.mask) < 0.1


def test_a_second_trip_changes_no_image(trees, tmp_path):
    ingest(trees["psfcn"], tmp_path / "one", ImportOptions(layout="psfcn"))
    options = ExportOptions(layout="psfcn", exposure=0.5)
    export(tmp_path / "one", tmp_path / "tree", options, read_manifest(tmp_path / "one"))
    ingest(tmp_path / "tree", tmp_path / "two", ImportOptions(layout="psfcn"))
    for one, two in zip(shards(tmp_path / "one"), shards(tmp_path / "two"), strict=True):
        np.testing.assert_array_equal(two.images, one.images)
        # Normals come to unit length in between, so a code may move by one.
        np.testing.assert_allclose(two.normals, one.normals, atol=1.01 / 127.5)


def object_folder(folder: Path, shape: tuple[int, int] = (20, 30), lights: int = 6) -> tuple[np.ndarray, np.ndarray]:
    """Write a DiLiGenT object as a camera would: not square, 16 bits, coloured light intensities, four decimals."""
    height, width = shape
    rng = np.random.default_rng(3)
    sphere, inside = sphere_normals(16, 0.9)
    normals, mask = np.zeros((height, width, 3)), np.zeros((height, width), bool)
    normals[2:18, 11:27], mask[2:18, 11:27] = sphere, inside
    directions = hemisphere_lights(lights, rng).astype(np.float64)
    intensities = rng.uniform(1, 3, (lights, 3)).round(4)
    images = shade(normals, directions.round(4), 0.3) * intensities[:, None, None]
    folder.mkdir(parents=True)
    for number, image in enumerate(images, start=1):
        cv2.imwrite(str(folder / f"{number:03d}.png"), np.rint(image[..., ::-1] * 65535).astype(np.uint16))
    (folder / "filenames.txt").write_text("".join(f"{number:03d}.png\n" for number in range(1, lights + 1)))
    np.savetxt(folder / "light_directions.txt", directions, "%.4f")
    np.savetxt(folder / "light_intensities.txt", intensities, "%.4f")
    cv2.imwrite(str(folder / "mask.png"), np.repeat(mask[..., None], 3, -1).astype(np.uint8) * 255)
    savemat(folder / "Normal_gt.mat", {"Normal_gt": normals})
    return normals, mask


def test_a_camera_folder(tmp_path):
    normals, mask = object_folder(tmp_path / "pmsData" / "catPNG")
    report = ingest(tmp_path / "pmsData", tmp_path / "out", ImportOptions(layout="diligent"))
    (scene,), (shard,) = report.scenes, shards(tmp_path / "out")
    assert (scene.id, scene.split, scene.size, scene.resolution) == ("cat", "test", (20, 30), (20, 30))
    assert shard.provenance["irradiance"].startswith("relative") and shard.provenance["source_bits"] == 16
    expected = shade(normals, shard.light_directions, 0.3)
    np.testing.assert_allclose(shard.images.astype(np.float32), expected, atol=4e-4)
    np.testing.assert_allclose(np.linalg.norm(shard.light_directions, axis=1), 1, atol=1e-6)
    estimate = least_squares(shard.images, shard.mask, shard.light_directions)
    lit = mask & (expected.min((0, 3)) > 0)
    assert normal_mae(estimate.normals, shard.normals, lit) < 0.1
    # The sphere's left edge looks to the left, its top edge up: x right, y up.
    rows, columns = np.nonzero(shard.mask)
    assert shard.normals[rows[columns.argmin()], columns.min(), 0] < -0.8
    assert shard.normals[rows.min(), columns[rows.argmin()], 1] > 0.8


@pytest.mark.parametrize("margin", [0, 3, 40])
def test_cropping(tmp_path, margin):
    object_folder(tmp_path / "catPNG")
    for out, crop in (("whole", None), ("cropped", margin)):
        ingest(tmp_path / "catPNG", tmp_path / out, ImportOptions(layout="diligent", crop=crop))
    (whole,), (cropped,) = shards(tmp_path / "whole"), shards(tmp_path / "cropped")
    assert all(side % 4 == 0 for side in cropped.mask.shape)
    assert cropped.mask.sum() == whole.mask.sum()
    np.testing.assert_array_equal(cropped.normals[cropped.mask], whole.normals[whole.mask])
    np.testing.assert_array_equal(cropped.images[:, cropped.mask], whole.images[:, whole.mask])
    if margin == 40:  # larger than the image, whose width 30 is padded
        assert cropped.mask.shape == (20, 32) and not cropped.images[:, :, 30:].any()
    if margin == 0:
        assert cropped.mask.shape == (16, 16)


def test_normals_from_text_or_picture_when_there_is_no_mat(trees, tmp_path):
    exact = shards_of(trees["diligent"], tmp_path / "mat")
    for missing, tolerance in ((["Normal_gt.mat"], 1e-6), (["Normal_gt.mat", "normal.txt"], 0.01)):
        tree = tmp_path / f"without-{len(missing)}"
        shutil.copytree(trees["diligent"], tree)
        for name in missing:
            for path in tree.rglob(name):
                path.unlink()
        for shard, expected in zip(shards_of(tree, tree / "out"), exact, strict=True):
            np.testing.assert_allclose(shard.normals, expected.normals, atol=tolerance)


def shards_of(tree: Path, out: Path) -> list[Shard]:
    ingest(tree, out, ImportOptions(layout="diligent"))
    return shards(out)


def test_y_down_is_noticed_and_turned(tmp_path, capsys):
    folder = tmp_path / "catPNG"
    normals, _ = object_folder(folder)
    savemat(folder / "Normal_gt.mat", {"Normal_gt": normals * [1, -1, 1]})
    np.savetxt(folder / "light_directions.txt", np.loadtxt(folder / "light_directions.txt") * [1, -1, 1], "%.4f")
    command = ["data", "import", str(folder), "--layout", "diligent", "--out"]
    assert main([*command, str(tmp_path / "wrong")]) == 0
    told = capsys.readouterr().out
    assert "cat: normals point into the object along the silhouette in y" in told and "--y-down" in told
    assert main([*command, str(tmp_path / "wrong")]) == 0 and "--y-down" in capsys.readouterr().out  # told again
    assert "silhouette" in shards(tmp_path / "wrong")[0].provenance["frame_check"]
    assert main([*command, str(tmp_path / "right"), "--y-down"]) == 0
    assert "silhouette" not in capsys.readouterr().out
    (shard,) = shards(tmp_path / "right")
    np.testing.assert_allclose(shard.normals, normals, atol=1e-6)
    assert shard.provenance["frame_check"] == "passed" and "source: y down" in shard.provenance["frame"]


def test_import_goes_on_and_refuses_other_folders(trees, tmp_path):
    options = ImportOptions(layout="psfcn")
    ingest(trees["psfcn"], tmp_path / "out", options)
    scenes = read_manifest(tmp_path / "out")
    assert all(is_whole(tmp_path / "out" / scene.file, scene) for scene in scenes)
    (tmp_path / "out" / scenes[1].file).unlink()
    report = ingest(trees["psfcn"], tmp_path / "out", options)
    assert (report.written, report.kept) == (1, len(scenes) - 1)
    with pytest.raises(InputError, match=r"manifest\.jsonl: holds other scenes"):
        ingest(trees["psfcn"], tmp_path / "out", ImportOptions(layout="psfcn", limit=2))
    (tmp_path / "foreign").mkdir()
    (tmp_path / "foreign" / "x").touch()
    with pytest.raises(InputError, match="foreign: is not empty"):
        ingest(trees["psfcn"], tmp_path / "foreign", options)


OBJECT = "pmsData/blobby-00001-v0-m0PNG"


def write(path: str, text: str):
    return lambda root: (root / path).write_text(text)


def mat(**content: object):
    return lambda root: savemat(root / OBJECT / "Normal_gt.mat", content)


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda root: (root / OBJECT / "003.png").unlink(), r"003\.png: no such picture"),
        (lambda root: os.truncate(root / OBJECT / "003.png", 200), r"003\.png: damaged"),
        (write(f"{OBJECT}/003.png", "hello"), r"003\.png: damaged or not a picture"),
        (lambda root: (root / OBJECT / "mask.png").unlink(), r"mask\.png: no such picture"),
        (lambda root: (root / OBJECT / "light_intensities.txt").unlink(), r"light_intensities\.txt: no such file"),
        (write(f"{OBJECT}/light_intensities.txt", "1\n" * LIGHTS), r"1 column\(s\) where 3 are needed; repeat"),
        (write(f"{OBJECT}/light_intensities.txt", "1 1 0\n" * LIGHTS), r"line 1 is not positive"),
        (write(f"{OBJECT}/light_intensities.txt", "\n1 1 1\n\n" + "1 1 0\n" * (LIGHTS - 1)), r"line 4 is not positive"),
        (write(f"{OBJECT}/light_intensities.txt", "1 1 1e999\n" * LIGHTS), r"are not finite"),
        (write(f"{OBJECT}/light_directions.txt", "0 0 1\n" * 3), rf"3 rows for {LIGHTS} images; give one row"),
        (write(f"{OBJECT}/light_directions.txt", "0 0 2\n" * LIGHTS), r"light 1 has length 2\.0000; give unit vectors"),
        (write(f"{OBJECT}/light_directions.txt", "0 0 -1\n" * LIGHTS), r"light 1 is behind the object"),
        (write(f"{OBJECT}/filenames.txt", "00#.png\n" * LIGHTS), r"has a '#'"),
        (write("pmsData/objects.txt", "dragonPNG\n"), r"dragonPNG.*no such file"),
        (lambda root: cv2.imwrite(str(root / OBJECT / "mask.png"), np.full((8, 8), 255, np.uint8)),
         r"mask\.png: is 8x8, Normal_gt\.mat is 24x24 \(height x width\); give both one size"),
        (lambda root: cv2.imwrite(str(root / OBJECT / "mask.png"), np.zeros((SIZE, SIZE), np.uint8)),
         r"mask\.png: the mask is empty"),
        (lambda root: cv2.imwrite(str(root / OBJECT / "002.png"), np.zeros((8, 9, 3), np.uint16)),
         r"002\.png: is 8x9, the mask or normal map is 24x24"),
        (lambda root: cv2.imwrite(str(root / OBJECT / "002.png"), np.zeros((SIZE, SIZE), np.uint16)), "1 channel"),
        (write(f"{OBJECT}/Normal_gt.mat", "hello"), r"Normal_gt\.mat: damaged or not a MATLAB file"),
        (mat(normals=np.zeros((SIZE, SIZE, 3))), r"no variable Normal_gt \(it has: normals\)"),
        (mat(Normal_gt=np.zeros((SIZE, SIZE))), r"want height x width x 3"),
        (write(f"{OBJECT}/scene.json", '{"exposure": -1}'), r"scene\.json: exposure must be a positive number"),
    ],
)  # fmt: skip
def test_unusable_diligent_folders(trees, tmp_path, damage, message, capfd):
    shutil.copytree(trees["diligent"], tmp_path / "tree")
    damage(tmp_path / "tree")
    assert main(["data", "import", str(tmp_path / "tree"), "--layout", "diligent", "--out", str(tmp_path / "o")]) == 2
    *progress, error = capfd.readouterr().err.strip().splitlines()
    with pytest.raises(InputError, match=message):
        raise InputError(error)
    assert error.startswith(f"sdps: {tmp_path}") and not any("Traceback" in line for line in progress)


def test_unusable_psfcn_trees(trees, tmp_path):
    options = ImportOptions(layout="psfcn")
    with pytest.raises(InputError, match="no such folder"):
        ingest(tmp_path / "absent", tmp_path / "out", options)
    with pytest.raises(InputError, match=r"no train_mtrl\.txt or val_mtrl\.txt"):
        ingest(tmp_path, tmp_path / "out", options)
    for name in ("PS_Blobby_Dataset", "PS_Sculpture_Dataset"):
        shutil.copytree(trees["psfcn"], tmp_path / name)
    with pytest.raises(InputError, match=r"one tree itself.*\(which holds PS_Blobby_Dataset, PS_Sculpture_Dataset\)"):
        ingest(tmp_path, tmp_path / "out", options)
    (tmp_path / "PS_Blobby_Dataset" / "Images" / "blobby-00001-v0" / "blobby-00001-v0_normal.png").unlink()
    with pytest.raises(InputError, match=r"blobby-00001-v0_normal\.png: no such picture"):
        ingest(tmp_path / "PS_Blobby_Dataset", tmp_path / "out", options)
    with pytest.raises(InputError, match="unknown layout 'psfnc'; did you mean 'psfcn'"):
        ImportOptions(layout="psfnc")
    with pytest.raises(InputError, match="crop must be a margin"):
        ImportOptions(layout="psfcn", crop=-1)


def test_the_trainer_reads_imported_folders(tmp_path):
    for number in range(2):
        object_folder(tmp_path / "pmsData" / f"cat{number}PNG", (20, 30 + 2 * number))
    ingest(tmp_path, tmp_path / "data", ImportOptions(layout="diligent", split="train"))
    config = LightingTraining(
        steps=1, batch_scenes=2, images=2, workers=0, validation_scenes=0, precision="float32", log_every=1
    )
    result = train(LightingStage(config), tmp_path / "data", tmp_path / "lcnet")
    assert result.steps == 1 and result.weights["lcnet"].is_file()
