"""The page "Studio": what may be loaded, scenes of it, and files that repeat a scene."""

import io
import json
import os
import subprocess
import sys
import zipfile
from pathlib import Path

import numpy as np
import pytest
from app_server import Client, serving
from textures_support import write_maps

from pipelines.app.pages import studio_tasks
from pipelines.shared import presets
from render.records.shards import read_shard
from render.shared.errors import InputError

ROOT = Path(__file__).resolve().parents[4]


@pytest.fixture
def maps(tmp_path: Path) -> Path:
    """A folder of maps where uploads lie."""
    folder = tmp_path / studio_tasks.UPLOADS / "Test"
    folder.mkdir(parents=True)
    write_maps(folder)
    return folder


def test_a_folder_of_maps_is_a_material_and_no_shape(tmp_path: Path, maps: Path) -> None:
    place = tmp_path / "studio"
    place.mkdir()
    about = studio_tasks.render_scene(str(place), shape="sphere", material="Test", size=128)
    assert about["name"].endswith("Test") and (place / "basis.bin").stat().st_size == 60 * 128 * 128 * 3
    with pytest.raises(InputError, match="folder of maps"):
        studio_tasks.check_choice(place, shape="Test", material="chrome")


@pytest.mark.parametrize("material", [pytest.param("lambertian:0.8/0.3/0.1", marks=pytest.mark.slow), "Test"])
def test_what_is_kept_writes_the_same_shard_again(tmp_path: Path, maps: Path, material: str) -> None:
    place = tmp_path / "studio"
    place.mkdir()
    assert studio_tasks.pack_scene(str(place), shape="blobby:3", material=material, yaw=30, size=128) == "scene.zip"
    unpacked = tmp_path / "elsewhere"
    with zipfile.ZipFile(place / "scene.zip") as opened:
        opened.extractall(unpacked)
    first = read_shard(unpacked / "scene.exr")
    (unpacked / "scene.exr").unlink()
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    subprocess.run([sys.executable, "repeat.py"], cwd=unpacked, env=environment, check=True, capture_output=True)
    again = read_shard(unpacked / "scene.exr")
    np.testing.assert_array_equal(first.images, again.images)
    np.testing.assert_array_equal(first.normals, again.normals)
    assert first.images.shape == (60, 128, 128, 3) and first.mask.mean() > 0.2
    test = presets.load(str(unpacked / "scene.yaml")).test
    assert test.shapes == ("blobby:3",) and test.materials == (material if material != "Test" else "./Test",)


def archive(picture: Path, *names: str) -> bytes:
    """Return a ZIP with one picture under several names."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as opened:
        for name in names:
            opened.write(picture, name)
    return buffer.getvalue()


def test_uploads(tmp_path: Path, maps: Path) -> None:
    pytest.importorskip("starlette", reason="needs pip install sdps[app]")
    pytest.importorskip("uvicorn", reason="needs pip install sdps[app]")
    picture = next(maps.glob("*Color.png"))
    with serving(tmp_path / "root", files=20, bytes=400_000, pixels=20_000) as address:
        client = Client(address)
        for name, body, status, text in (
            ("Bricks.zip", archive(picture, "../../a_Color.png", "x/b_Roughness.png"), 200, "Bricks"),
            ("Bricks.zip", archive(picture, "a_Color.png"), 200, "Bricks"),  # in place of the first
            ("none.zip", archive(picture, "a.exe"), 400, "contains no pictures"),
            ("bad.zip", b"PK", 400, "cannot be unpacked"),
            ("big.zip", b"0" * 500_000, 400, "too large"),
            ("own.yaml", b"a: 1", 200, "own.yaml"),
            ("a.exe", b"", 400, "cannot be used here"),
        ):
            answered, found = client.send("PUT", f"/studio/uploads/{name}", body)
            said = json.loads(found)
            assert answered == status and text in said["name" if status == 200 else "message"], (name, said)
