"""Photographs in the layout of the University of Washington's set: reader, lights from the sphere, comparison."""

import json
import shutil
from pathlib import Path

import classical_scenes as scenes
import numpy as np
import pytest
from PIL import Image

from pipelines import cli
from pipelines.evaluate.benchmarks import uw_photos
from render.shared.errors import InputError
from sdps.core.metrics import angle_degrees

LIGHTS = scenes.lights(8, 3, 0.7)


def write_set(folder: Path, name: str, images: np.ndarray, mask: np.ndarray) -> None:
    """Write images (L, H, W, 3) from 0 to 1 as 8-bit TGA, in a larger black frame."""
    (folder / name).mkdir(parents=True)
    pad = ((6, 9), (11, 3))
    Image.fromarray(np.pad(mask, pad)).convert("RGB").save(folder / name / f"{name}.mask.tga")
    for number, image in enumerate(images):
        values = np.pad((np.clip(image, 0, 1) * 255 + 0.5).astype(np.uint8), (*pad, (0, 0)))
        Image.fromarray(values).save(folder / name / f"{name}.{number}.tga")


@pytest.fixture(scope="module")
def photos(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with a hill, a chrome sphere under the same lights, and lights.txt."""
    folder = tmp_path_factory.mktemp("photos")
    normals, mask = scenes.hills(80)
    write_set(folder, "hill", scenes.lambertian(normals, mask, LIGHTS, albedo=0.9).images, mask)
    normals, mask = scenes.sphere(160)
    mirrored = 2.0 * normals[..., 2:] * normals - np.array([0.0, 0.0, 1.0])
    gleam = (np.einsum("hwc,lc->lhw", mirrored, LIGHTS) > np.cos(np.radians(4.0))) * mask
    write_set(folder, "chrome", np.repeat(gleam[..., None], 3, -1).astype(float), mask)
    lines = [str(len(LIGHTS)), *(" ".join(f"{value:.7f}" for value in row) for row in LIGHTS)]
    (folder / "lights.txt").write_text("\n".join(lines) + "\n")
    return folder


def test_reads_an_object_cropped_and_linear(photos: Path) -> None:
    assert uw_photos.list_objects(photos) == ["hill"]
    read = uw_photos.read_photos(photos, "hill", LIGHTS)
    images = read.load().open()
    normals, mask = scenes.hills(80)
    assert read.mask.sum() == mask.sum()
    assert images.shape == (8, *read.mask.shape, 3)
    truth = scenes.lambertian(normals, mask, LIGHTS, albedo=0.9).images[:, mask]
    np.testing.assert_allclose(images[:, read.mask], np.clip(truth, 0, 1), atol=0.6 / 255)
    with pytest.raises(InputError, match="8 images but 7 lights"):
        uw_photos.read_photos(photos, "hill", LIGHTS[1:])


def test_lights_come_from_the_sphere_or_the_file(photos: Path) -> None:
    assert angle_degrees(uw_photos.read_lights(photos, "chrome"), LIGHTS).max() < 1.0
    assert angle_degrees(uw_photos.read_lights(photos, "file"), LIGHTS).max() < 1e-3
    np.testing.assert_array_equal(uw_photos.read_lights(photos), uw_photos.read_lights(photos, "chrome"))


def test_the_command_compares_and_leaves_files(
    photos: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    argv = ["evaluate", "uw", str(photos), "--methods", "pf14,factorisation", "--out", str(tmp_path)]
    assert cli.main(argv) == 0
    output = capsys.readouterr().out
    assert "pf14" in output
    assert "hill" in output
    result = json.loads((tmp_path / "results.json").read_text())
    figures = result["objects"]["hill"]["methods"]
    assert set(figures) == {"pf14", "factorisation"}
    assert figures["pf14"]["normal_mae"] < 3.0
    assert figures["pf14"]["candidates"] > 0
    assert result["lights"] == "chrome"
    with Image.open(tmp_path / "hill.png") as picture:
        assert min(picture.size) > 300


def test_a_method_that_refuses_is_a_dash(
    photos: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    from sdps.classical import registry

    def refuse(name: str, *args: object, **options: object) -> object:
        if name == "pf14":
            raise InputError("no pixel is brightest")
        return run(name, *args, **options)

    run = registry.run
    monkeypatch.setattr(registry, "run", refuse)
    assert cli.main(["evaluate", "uw", str(photos), "--methods", "pf14", "--out", str(tmp_path)]) == 0
    assert " - " in capsys.readouterr().out.replace("\n", " ")
    figures = json.loads((tmp_path / "results.json").read_text())["objects"]["hill"]["methods"]
    assert figures == {"pf14": {"failed": "no pixel is brightest"}}


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (["--objects", "dog"], "unknown object"),
        (["--methods", "pf15"], "unknown model or method"),
        (["--reference", "pf14"], "choose a calibrated method"),
    ],
)
def test_bad_names_are_one_line(
    photos: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], flags: list[str], message: str
) -> None:
    assert cli.main(["evaluate", "uw", str(photos), *flags, "--out", str(tmp_path)]) == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1


def test_bad_folders_are_one_line(photos: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such folder"):
        uw_photos.list_objects(tmp_path / "nowhere")
    with pytest.raises(InputError, match="no photographs"):
        uw_photos.list_objects(tmp_path)
    copy = tmp_path / "copy"
    shutil.copytree(photos, copy)
    (copy / "hill" / "hill.3.tga").write_bytes(b"no picture")
    with pytest.raises(InputError, match=r"hill\.3\.tga: damaged or not a picture"):
        uw_photos.read_photos(copy, "hill", LIGHTS).load().open()
    (copy / "hill" / "hill.3.tga").unlink()
    with pytest.raises(InputError, match="without gaps"):
        uw_photos.read_photos(copy, "hill", LIGHTS)
    (copy / "lights.txt").write_text("8\n0 0 1\n")
    with pytest.raises(InputError, match="want a count"):
        uw_photos.read_lights(copy, "file")
    (copy / "lights.txt").write_text("one\n")
    with pytest.raises(InputError, match="not all numbers"):
        uw_photos.read_lights(copy, "file")
    shutil.rmtree(copy / "chrome")
    (copy / "lights.txt").unlink()
    with pytest.raises(InputError, match="neither a chrome sphere"):
        uw_photos.read_lights(copy)
