"""The page "Data and runs" over HTTP: it shows what lies in its folder, and nothing else."""

import json
from pathlib import Path

import pytest
from app_data import write_run
from app_server import Client, serving


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory):
    pytest.importorskip("starlette", reason="needs pip install sdps[app]")
    pytest.importorskip("uvicorn", reason="needs pip install sdps[app]")
    folder = tmp_path_factory.mktemp("root")
    write_run(folder / "out" / "run")
    (folder / "secret").mkdir()
    with serving(folder / "out") as address:
        yield folder / "out", Client(address, "data")


def test_folders_scenes_curves_and_results(place: tuple[Path, Client]) -> None:
    _, client = place
    rows = json.loads(client.get("/data/list"))["rows"]
    assert {(row["folder"], row["kind"]) for row in rows} == {("run/data", "data"), ("run", "run")}
    scenes = json.loads(client.get("/data/scenes?folder=run/data"))
    assert [row["state"] for row in scenes] == ["rendered", "rendered", "failed"]
    assert scenes[2]["reason"] == "out of memory"
    shown = json.loads(client.get(f"/data/scene?folder=run/data&id={scenes[0]['id']}"))
    assert shown["picture"].startswith("data:image/jpeg") and shown["radiance"] > 0
    curves = json.loads(client.get("/data/curves?folder=run"))
    assert curves["lcnet"]["loss"] == [[1, 2.0], [2, 1.0]]
    (section,) = json.loads(client.get("/data/sections?folder=run"))
    assert client.get(f"/data/picture?folder=run&section={section['name']}&file=000.png").startswith(b"\x89PNG")


def test_curves_of_a_training_that_diverged_are_sent_without_what_cannot_be_drawn(place: tuple[Path, Client]) -> None:
    folder, client = place
    rows = ['{"step": 1, "loss": 2.0}', '{"step": 2, "loss": NaN}', '{"step": 3, "loss": "x", "val_\\ud800": 1}']
    metrics = folder / "other" / "models" / "x" / "metrics.jsonl"
    metrics.parent.mkdir(parents=True)
    metrics.write_text("\n".join(rows) + "\n")
    assert json.loads(client.get("/data/curves?folder=other")) == {"x": {"loss": [[1, 2.0]]}}


def test_a_scene_under_the_lamp(place: tuple[Path, Client]) -> None:
    _, client = place
    (scene, *_) = json.loads(client.get("/data/scenes?folder=run/data"))
    job = client.wait(client.post(f"/data/start?folder=run/data&id={scene['id']}"))
    about = job["result"]
    assert job["state"] == "done" and len(about["lights"]) == scene["lights"]
    assert len(client.get("/data/files/basis.bin")) == len(about["lights"]) * about["width"] * about["height"] * 3


def test_two_tabs_have_a_scene_each_and_the_oldest_of_many_goes(place: tuple[Path, Client]) -> None:
    _, client = place
    scenes = json.loads(client.get("/data/scenes?folder=run/data"))[:2]

    def show(tab: str, scene: dict) -> bytes:
        job = client.wait(client.post(f"/data/start?folder=run/data&id={scene['id']}&tab={tab}"))
        assert job["state"] == "done", job
        return client.get(f"/data/files/basis.bin?tab={tab}")

    first, second = (show(tab, scene) for tab, scene in zip("ab", scenes, strict=True))
    assert first != second and client.get("/data/files/basis.bin?tab=a") == first
    for number in range(8):
        show(f"c{number}", scenes[0])
    found = [client.send("GET", f"/data/files/basis.bin?tab={tab}")[0] for tab in ("a", "b", "c0", "c7")]
    assert found == [404, 404, 200, 200]
    assert client.send("GET", "/data/files/basis.bin?tab=../x")[0] == 400


@pytest.mark.parametrize("folder", ["..", "../secret", "/etc", "run/../../secret", "none"])
def test_nothing_outside_the_folder(place: tuple[Path, Client], folder: str) -> None:
    _, client = place
    for path in ("scenes", "curves", "sections"):
        assert client.send("GET", f"/data/{path}?folder={folder}")[0] == 400
    assert client.send("GET", "/data/picture?folder=run&section=..&file=../data/manifest.jsonl")[0] == 404
    assert client.send("GET", "/data/scene?folder=run/data&id=../../x")[0] == 400
