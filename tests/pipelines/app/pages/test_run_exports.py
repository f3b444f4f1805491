"""What can be taken away from a run in the app: every export of the command, made when asked for."""

import io
import json
import zipfile
from pathlib import Path

import numpy as np
import photo_folders as folders
import pytest
from app_server import Client, serving
from saved_results import save_result
from sdps_scenes import hemisphere_lights

from pipelines.app.pages.run_exports import export, list_exports
from render.shared.errors import InputError
from sdps.core.geometry import Camera
from sdps.surface.exports.registry import EXPORTS


@pytest.fixture
def place(tmp_path: Path) -> Path:
    """A set of photographs with two runs: refined and seen by a pinhole, and neither."""
    save_result(tmp_path / "runs" / "1" / "files", camera=Camera(150.0))
    save_result(tmp_path / "runs" / "2" / "files", albedo=False)
    return tmp_path


def test_the_list_is_that_of_the_command() -> None:
    rows = list_exports()
    assert [f"{row['who']}: {row['what']}" for row in rows] == [export.about for export in EXPORTS.values()]
    assert {row["name"] for row in rows} == {*EXPORTS}


def test_one_file_is_a_file_and_several_are_a_zip(place: Path) -> None:
    for name, export_ in EXPORTS.items():
        if export_.from_pictures:
            continue
        made = export(str(place), 1, name)
        path = place / "runs" / "1" / made["file"]
        assert made["name"] == path.name
        if path.suffix == ".zip":
            with zipfile.ZipFile(path) as opened:
                assert len(opened.namelist()) > 1 and opened.testzip() is None
        else:
            assert path.stat().st_size
        before = path.stat().st_mtime_ns
        assert export(str(place), 1, name) == made and path.stat().st_mtime_ns == before


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("gltf", 'nothing was refined, so how it shines is not known; find the surface again with "Refine"'),
        ("meshroom", 'the camera was taken for orthographic; find the surface again with "Focal length"'),
        ("../lp", "unknown export"),
        ("lp,height", "export lp, height: one at a time; ask for each"),
    ],
)
def test_what_is_missing_is_said_in_one_line_and_nothing_stays(place: Path, name: str, said: str) -> None:
    with pytest.raises(InputError) as error:
        export(str(place), 2, name)
    assert said in str(error.value) and "--" not in str(error.value) and str(place) not in str(error.value)
    assert {path.name for path in (place / "runs" / "2").iterdir()} == {"files"}


def test_an_export_over_http(tmp_path: Path) -> None:
    pytest.importorskip("starlette", reason="needs pip install sdps[app]")
    images, mask = folders.matte(lights := hemisphere_lights(8, np.random.default_rng(0)), size=40)
    folder = folders.write_folder(tmp_path / "hills", images, mask, bits=8)
    with serving(tmp_path) as address:
        client = Client(address)
        path = client.new_set(folder)
        asked = {"method": "factorisation", "pixel_size": "0.5", "gamma": "srgb"}
        shown = client.wait(client.post(f"{path}/start/infer", asked))["result"]
        assert [row["name"] for row in shown["exports"]] == [*EXPORTS]

        def get(name: str) -> zipfile.ZipFile:
            job = client.wait(client.post(f"{path}/start/export", {"run": 1, "name": name}))
            assert job["state"] == "done", job["message"]
            return zipfile.ZipFile(io.BytesIO(client.get(f"{path}/files/runs/1/{job['result']['file']}")))

        about = json.loads(get("ptm").read("ptm.json"))
        assert about["of"] == "photographs" and about["lights"] == len(lights)
        assert json.loads(get("height").read("height.json"))["unit"] == "mm"
        for run in (2, "1/../1", None, "9" * 200):
            body = json.dumps({"run": run, "name": "lp"}).encode()
            status, said = client.send("POST", f"{path}/start/export", body)
            assert status == 400 and "that run was removed" in json.loads(said)["message"]
