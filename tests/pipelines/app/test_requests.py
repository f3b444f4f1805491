"""Requests that are odd, and what an answer's status says; and what must not hold up the server."""

import http.client
import io
import json
import os
import shutil
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import photo_folders as folders
import pytest
from app_data import write_run
from app_server import Client, application
from PIL import Image

from pipelines.app.common import uploads
from render.shared.errors import InputError
from sdps.photos.picture_file import SUFFIXES

LIMITS = {"files": 20, "bytes": 4_000_000, "pixels": 200_000}
LONG = "x" * 3000


@pytest.fixture(scope="module")
def served(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[str, Any]]:
    pytest.importorskip("starlette", reason="needs pip install sdps[app]")
    pytest.importorskip("uvicorn", reason="needs pip install sdps[app]")
    folder = tmp_path_factory.mktemp("root")
    write_run(folder / "run")
    with application(folder, **LIMITS) as place:
        yield place


@pytest.fixture
def client(served: tuple[str, Any]) -> Client:
    return Client(served[0])


@pytest.mark.parametrize(
    "path",
    [
        "SET/files/%00", f"SET/files/{LONG}", "SET/files/photos", "SET/files/photos/%00.png", "SET/files/%ff",
        f"SET/runs/{'9' * 5000}/pixel", "SET/runs/1/pixel", "SET/runs/-1/download", "SET/runs/x/download",
        "/photographs/sets/%00/files/a", f"/photographs/sets/{LONG}/files/a", "/photographs/sets/studio/files/a",
        f"/jobs/{'9' * 5000}", "/jobs/-1", "/jobs/x", "/studio/files/%00", f"/studio/files/{LONG}",
        "/data/scenes?folder=%00", f"/data/scenes?folder={LONG}", "/data/scene?folder=.&id=x", "/data/scene",
        "/data/scene?folder=run/data&id=%00", "/data/curves?folder=%00", f"/data/files/{LONG}",
        "/data/picture?folder=run&section=%00&file=a.png", f"/data/picture?folder=run&section={LONG}&file=a.png",
        "/data/sections?folder=%ff", f"/{LONG}", "/%00", "/static/%00", "/%ff%fe",
    ],
)  # fmt: skip
def test_odd_names_and_numbers_are_no_fault_of_the_server(client: Client, path: str) -> None:
    status, _ = client.send("GET", path.replace("SET", client.new_set()))
    assert 400 <= status < 500


@pytest.mark.parametrize("name", ["%E5%83%8F" * 120 + ".png", "x" * 400 + ".png", "%F0%9F%97%BF" * 80 + ".png"])
def test_long_names_are_shortened_to_what_a_disk_takes(client: Client, name: str) -> None:
    path, body = client.new_set(), _png()
    assert client.send("PUT", f"{path}/uploads/{name}", body) == (200, b'{"files":1}')


def _png() -> bytes:
    written = io.BytesIO()
    Image.new("L", (8, 8), 200).save(written, "png")
    return written.getvalue()


def test_head_is_answered_as_get_is(client: Client, served: tuple[str, Any]) -> None:
    connection = http.client.HTTPConnection(served[0].removeprefix("http://"), timeout=30)
    connection.request("HEAD", "/photographs")
    answer = connection.getresponse()
    answer.read()
    assert answer.status == 200
    connection.close()


def test_a_full_queue_is_not_the_visitors_mistake(
    client: Client, served: tuple[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    path = client.new_set()
    monkeypatch.setattr(served[1].state.jobs, "submit", lambda *_, **__: None)
    for start in (f"{path}/start/check", f"{path}/start/infer", "/studio/start/gallery"):
        status, said = client.send("POST", start, b"{}")
        assert status == 503 and "too many jobs" in json.loads(said)["message"]
    place = served[1].state.sessions.find(client.token).folder / path.split("/")[-1]
    assert not list((place / "runs").iterdir())  # a run that was not queued is none of the twenty


def test_runs_that_failed_leave_no_files(tmp_path: Path) -> None:
    from pipelines.app.pages import photo_tasks

    runs = tmp_path / "runs"
    for number, done in ((1, True), (2, False), (3, False), (5, False)):
        (runs / str(number) / "view").mkdir(parents=True)
        if done:
            (runs / str(number) / "view" / "view.json").write_text("{}")
    (tmp_path / "photos").mkdir()
    with pytest.raises(InputError):
        photo_tasks.infer(str(tmp_path), 4)
    assert {path.name for path in runs.iterdir()} <= {"1", "4", "5"}  # 5 waits for its turn


# ---- What may be uploaded ----


def test_what_may_be_uploaded_is_what_the_command_reads(client: Client) -> None:
    page = client.get("/photographs").decode()
    for suffix in SUFFIXES:
        assert uploads.clean_name(f"a{suffix.upper()}") == f"a{suffix.upper()}"
        assert f"{suffix}," in page
    assert uploads.list_kinds() in page
    with pytest.raises(InputError, match="cannot be used"):
        uploads.clean_name("a.gif")


@pytest.mark.parametrize("suffix", sorted(SUFFIXES))
@pytest.mark.parametrize("content", [".png", ".tif", ".jpg", ".exr", ".bmp", ".pgm", ".ppm", ".tga", ".webp"])
def test_the_size_is_that_of_the_content_whatever_the_name(tmp_path: Path, content: str, suffix: str) -> None:
    written = tmp_path / f"a{content}"
    if content in (".tga", ".webp"):
        Image.new("RGB", (50, 40)).save(written)
    else:
        folders.write(written, np.zeros((40, 50) if content == ".pgm" else (40, 50, 3)))
    path = written.rename(tmp_path / f"b{suffix}")
    if content not in SUFFIXES:
        pytest.skip("the command does not read it")
    assert uploads._read_size(path) == (50, 40)
    uploads.check_pixels(path, uploads.Limits(pixels=2000))
    with pytest.raises(InputError, match="50x40"):
        uploads.check_pixels(path, uploads.Limits(pixels=1999))


def test_the_largest_window_of_an_exr_counts(tmp_path: Path) -> None:
    """Pixels are put into the display window; and a second part may be larger than the first."""
    path = tmp_path / "a.exr"
    folders.write(path, np.zeros((40, 50, 3)))
    data = path.read_bytes()
    at = data.index(b"displayWindow") + len(b"displayWindow\0box2i\0") + 4
    path.write_bytes(data[:at] + np.array([0, 0, 99_999, 99_999], "<i4").tobytes() + data[at + 16 :])
    with pytest.raises(InputError, match="100000x100000"):
        uploads.check_pixels(path, uploads.Limits())


# ---- What must not hold up the server ----


def test_a_large_manifest_is_read_off_the_event_loop(
    client: Client, served: tuple[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    from pipelines.app.pages import data_routes

    read = data_routes.read_manifest
    scene = json.loads(client.get("/data/scenes?folder=run/data"))[0]["id"]

    for method, path in (("GET", "scene"), ("POST", "start")):
        begun, go, released = threading.Event(), threading.Event(), []

        def slow(folder: Path, begun: threading.Event = begun, go: threading.Event = go, found: list = released) -> Any:
            begun.set()
            found.append(go.wait(30))  # False: nothing else was answered meanwhile
            return read(folder)

        monkeypatch.setattr(data_routes, "read_manifest", slow)
        data_routes._index_manifest.cache_clear()
        asking = threading.Thread(target=client.send, args=(method, f"/data/{path}?folder=run/data&id={scene}"))
        asking.start()
        assert begun.wait(30)
        client.get("/static/icon.svg")
        go.set()
        asking.join()
        assert released[0]


def test_a_scene_that_was_rendered_again_is_shown_anew(tmp_path: Path, served: tuple[str, Any], client: Client) -> None:
    from pipelines.app.pages import data_routes

    root = served[1].state.folder
    shutil.copytree(root / "run", root / "again")
    one, *_ = json.loads(client.get("/data/scenes?folder=again/data"))
    shown = client.get(f"/data/scene?folder=again/data&id={one['id']}")
    path = next((root / "again" / "data").rglob(f"{one['id']}.exr"))
    time.sleep(0.01)
    os.utime(path)
    before = data_routes._draw_strip.cache_info().misses
    assert client.get(f"/data/scene?folder=again/data&id={one['id']}") == shown
    assert data_routes._draw_strip.cache_info().misses == before + 1
    shutil.rmtree(root / "again")


def test_a_folder_whose_name_is_no_text_hides_no_other(client: Client, served: tuple[str, Any]) -> None:
    root = served[1].state.folder
    odd = os.path.join(os.fsencode(root), b"\xff\xfe")
    os.mkdir(odd)
    (Path(os.fsdecode(odd)) / "report").mkdir()
    rows = json.loads(client.get("/data/list"))["rows"]
    assert {row["folder"] for row in rows} == {"run", "run/data"}


# ---- Sessions ----


def test_sessions_that_hold_nothing_end_first(tmp_path: Path) -> None:
    from pipelines.app.common.sessions import Sessions

    sessions = Sessions()
    worker = sessions.create()
    worker.make_place()
    looking = [sessions.create() for _ in range(10)]
    busy = sessions.create()
    busy.under_way["x"] += 1
    ended = []
    gone = sessions.expire(most=3, ended=ended.append)
    assert worker.folder.is_dir() and busy.folder.is_dir() and gone == ended
    assert {session.token for session in looking[:8]} <= set(gone) and sessions.find(worker.token) is worker
    assert sessions.expire(idle=-1.0) and sessions.find(busy.token) is busy
    sessions.close()


def test_sessions_do_not_grow_without_end_between_two_looks(monkeypatch: pytest.MonkeyPatch) -> None:
    from pipelines.app.common import sessions as module

    monkeypatch.setattr(module, "_AT_A_TIME", 20)
    sessions = module.Sessions()
    first = sessions.create()
    first.make_place()
    for _ in range(60):
        sessions.create()
    assert len(sessions._sessions) == 20 == len(list(sessions.folder.iterdir()))
    assert sessions.find(first.token) is first
    sessions.close()


def test_jobs_end_before_the_files_of_their_session_go(tmp_path: Path) -> None:
    from pipelines.app.common.sessions import Sessions

    sessions = Sessions()
    session = sessions.create()
    there = []
    sessions.expire(idle=-1.0, ended=lambda token: there.append(session.folder.is_dir()))
    assert there == [True] and not session.folder.exists()
    sessions.close()


def test_what_a_killed_server_left_is_removed_and_nothing_of_a_living_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("fcntl")
    from pipelines.app.common import sessions as module

    monkeypatch.setattr(module.tempfile, "tempdir", str(tmp_path))
    living = module.Sessions()
    names = {name: tmp_path / f"{module._PREFIX}{name}" for name in ("killed", "begins")}
    for folder in (*names.values(), tmp_path / "other"):
        (folder / "set").mkdir(parents=True)
    for folder in (living.folder, names["killed"], tmp_path / "other"):
        os.utime(folder, (0, 0))
    second = module.Sessions()
    there = {living.folder, second.folder, names["begins"], tmp_path / "other"}
    assert {*tmp_path.iterdir()} == there
    living.close()
    second.close()
    assert {*tmp_path.iterdir()} == there - {living.folder, second.folder}
