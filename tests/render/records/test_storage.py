"""Data folders in object storage: what is written there, read back, cached, and done when the store refuses."""

import contextlib
import errno
import json
import os
import re
import shutil
import sys
import threading
import time
import urllib.request
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from data_folders import good_folder, scene_of, sphere_shard
from fsspec.implementations.local import LocalFileSystem
from object_store import BUCKET, ObjectStore, object_store
from pretend_renderer import pretend

from pipelines.cli import main
from render.checks.validate import validate
from render.records import manifest, mirror
from render.records.ledger import now, read_runs, survey
from render.records.manifest import read_manifest
from render.records.mirror import open_folder, publish, select_rendered, shard_path
from render.records.sending import WAITING
from render.records.shards import read_shard
from render.running.supervisor import RunOptions, render_supervised
from render.shared.errors import InputError
from render.shared.storage import Missing, Store, address
from sdps.data.scene_store import SceneStore

ONE = RunOptions(workers=1, keep_free=0)
SCENES = [replace(scene_of(sphere_shard()), id=f"a-{number}", seed=number) for number in range(6)]


@pytest.fixture(autouse=True)
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("SDPS_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache"


@pytest.fixture
def url(tmp_path: Path) -> str:
    """Return the address of an empty store whose objects are files: fsspec's driver for a disk."""
    return f"file://{tmp_path / 'store' / 'data'}"


@pytest.fixture(scope="module")
def server() -> Iterator[ObjectStore]:
    pytest.importorskip("moto.server", reason="the S3 server of sdps[storage-test] is missing")
    pytest.importorskip("s3fs", reason="the S3 driver of sdps[storage] is missing")
    with object_store() as store:
        yield store


@pytest.fixture
def s3(server: ObjectStore, monkeypatch: pytest.MonkeyPatch) -> ObjectStore:
    for name, value in server.environment.items():
        monkeypatch.setenv(name, value)
    return server


def render(url: str, options: RunOptions = ONE) -> list[str]:
    """Render pretended scenes into a store; return the ids rendered now."""
    with open_folder(url, purpose="run") as folder:
        manifest.claim(folder, SCENES)
        publish(folder)
        return [line["id"] for line in render_supervised(SCENES, folder, options, serve=pretend).lines]


def test_addresses_survive_paths_and_other_names_stay_folders() -> None:
    assert address("s3://bucket/run/") == address(Path("s3://bucket/run")) == "s3://bucket/run"
    assert [address(place) for place in ("out/data", "/out", r"C:\out", "C:/out", Path("a:b"))] == [None] * 5


def test_a_run_leaves_every_shard_and_one_line_of_each_in_the_store_and_nothing_here(
    url: str, tmp_path: Path, cache: Path
) -> None:
    store = tmp_path / "store" / "data"
    assert len(render(url)) == 6
    assert {path.stem for path in (store / "shards").iterdir()} == {scene.id for scene in SCENES}
    assert len(list((store / "log").iterdir())) == 1 and (store / "manifest.jsonl").is_file()
    assert not list(cache.rglob("*.exr")) and not list(cache.rglob(WAITING))
    assert render(url) == []
    shutil.rmtree(cache)  # another machine
    assert render(url) == []
    (store / "shards" / "a-3.exr").unlink()
    assert render(url) == ["a-3"]


def test_what_a_killed_run_left_here_is_sent_by_the_next(url: str, tmp_path: Path) -> None:
    with open_folder(url, purpose="run") as folder:
        manifest.claim(folder, SCENES)
        publish(folder)
        for number, scene in enumerate(SCENES[:3]):
            (folder / scene.file).parent.mkdir(exist_ok=True)
            (folder / scene.file).write_bytes(scene.digest().encode())
            line = {"id": scene.id, "spec": scene.digest(), "bytes": 64, "seconds": 1.0, "time": now()}
            with open(folder / WAITING, "a", encoding="utf-8") as handle:  # the third was torn off
                handle.write(json.dumps(line)[: None if number < 2 else 20] + ("\n" if number < 2 else ""))
    assert render(url) == ["a-2", "a-3", "a-4", "a-5"]
    with open_folder(url) as folder:
        assert sum(len(lines) for lines in read_runs(folder)) == 6
        assert len(survey(folder, read_manifest(folder)).done) == 6


def test_a_second_run_of_this_machine_is_refused_as_is_another_plan(url: str) -> None:
    with open_folder(url, purpose="run"), pytest.raises(InputError, match="another run on this machine"):
        render(url)
    render(url)
    with open_folder(url, purpose="run") as folder, pytest.raises(InputError, match="holds another plan"):
        manifest.claim(folder, SCENES[:2])


def filled(tmp_path: Path) -> tuple[str, list[manifest.SceneSpec]]:
    return f"file://{tmp_path / 'good'}", good_folder(tmp_path / "good")


def test_readers_see_in_a_store_what_lies_in_a_folder(tmp_path: Path) -> None:
    url, scenes = filled(tmp_path)
    here, there = SceneStore(tmp_path / "good", cache=True), validate(tmp_path / "good")
    with open_folder(url) as folder:
        assert select_rendered(folder, scenes) == scenes
        assert validate(folder).statistics == there.statistics and validate(folder, workers=2).sound
        away = SceneStore(folder, cache=True)
        for scene in [*scenes, *scenes]:  # decoded, then from the cache
            assert np.array_equal(away.load(scene).images[:], here.load(scene).images[:])


def test_the_cache_keeps_to_its_limit_and_forgets_what_was_written_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    url, scenes = filled(tmp_path)
    size = max((tmp_path / "good" / scene.file).stat().st_size for scene in scenes)
    monkeypatch.setattr(mirror, "_IN_USE", -1.0)
    with open_folder(url, cache_gb=2.5 * size / 1e9) as folder:
        for scene in scenes:
            read_shard(shard_path(folder, scene), scene)
            kept = [path.stat().st_size for path in (folder / "shards").iterdir()]
            assert sum(kept) <= 2.5 * size
        assert len(kept) == 2 or len(kept) == 3
    changed = tmp_path / "good" / scenes[-1].file
    changed.write_bytes(changed.read_bytes())
    os.utime(changed, (later := time.time() + 10, later))  # a clock may stand still for some milliseconds
    with open_folder(url) as folder:
        assert not (folder / scenes[-1].file).exists() and shard_path(folder, scenes[-1]).is_file()


def test_a_damaged_shard_is_named_by_its_address(tmp_path: Path) -> None:
    url, scenes = filled(tmp_path)
    path = tmp_path / "good" / scenes[1].file
    path.write_bytes(path.read_bytes()[:-10] + b"0123456789")
    with open_folder(url) as folder:
        assert len(survey(folder, scenes).done) == len(scenes) - 1
        with pytest.raises(InputError, match=rf"{url}/{scenes[1].file}: truncated or altered"):
            shard_path(folder, scenes[1])
        found = validate(folder).of("file")
    assert [finding.where for finding in found] == [scenes[1].id]


def test_a_full_store_is_waited_for_and_given_up_in_one_line(
    url: str, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    left, real = [2], LocalFileSystem.pipe_file

    def full(driver, path, data, **options):
        if "shards" in path and left[0]:
            left[0] -= 1
            raise OSError(errno.ENOSPC, "No space left")
        return real(driver, path, data, **options)

    monkeypatch.setattr(LocalFileSystem, "pipe_file", full)
    assert len(render(url)) == 6
    assert "cannot write it now ([Errno 28] No space left); trying again" in caplog.text
    left[0] = 1000
    shutil.rmtree(Path(url.removeprefix("file://")))
    monkeypatch.setenv("SDPS_STORAGE_WAIT", "0.5")
    with pytest.raises(InputError, match="what is finished is kept, run the same command again"):
        render(url)
    left[0] = 0
    assert len(render(url)) < 6  # those finished then are sent now


def test_what_waiting_does_not_mend_ends_in_one_line(url: str, monkeypatch: pytest.MonkeyPatch) -> None:
    def refused(*_: object, **__: object) -> None:
        raise PermissionError("The AWS Access Key Id you provided does not exist in our records.")

    monkeypatch.setattr(LocalFileSystem, "pipe_file", refused)
    with pytest.raises(InputError, match=r"manifest.jsonl: refused \(The AWS Access Key Id .*check the keys"):
        render(url)
    with pytest.raises(InputError, match="Protocol not known"):
        Store("nowhere://bucket")
    with pytest.raises(Missing):
        Store(url).read("none")


def test_commands_on_s3(s3: ObjectStore, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    good_folder(tmp_path / "good")
    place = f"s3://{BUCKET}/commands/data"
    for path in (tmp_path / "good").rglob("*.*"):
        Store(place).write(str(path.relative_to(tmp_path / "good")), path.read_bytes())
    assert main(["data", "status", place]) == 0
    assert f"{place}: 4 of 4 scenes done, 0 failed, 0 left" in capsys.readouterr().out
    assert main(["data", "validate", place]) == 0
    assert main(["data", "preview", place]) == main(["data", "card", place]) == 0
    assert {"validation.json", "preview.html", "DATASET_CARD.md", "checksums.txt"} <= set(s3.objects("commands/data"))
    assert main(["data", "export", place, "--layout", "unips", "--out", str(tmp_path / "tree")]) == 0
    capsys.readouterr()
    for wrong, said in (
        ("s3://none/data", "bucket does not exist"),
        (f"s3://{BUCKET}/none", "no manifest.jsonl there"),
    ):
        assert main(["data", "status", wrong]) == 2
        text = capsys.readouterr().err
        assert said in text and wrong in text and text.count("\n") == 1


@contextlib.contextmanager
def strict(s3: ObjectStore) -> Iterator[None]:
    """Let the server check keys, none of which it knows."""

    def allowed(requests: str) -> None:
        place = f"{s3.environment['AWS_ENDPOINT_URL']}/moto-api/reset-auth"
        urllib.request.urlopen(urllib.request.Request(place, requests.encode(), {"Content-Type": "text/plain"})).close()

    allowed("0")
    try:
        yield
    finally:
        allowed("inf")


def commands(place: str, out: Path) -> list[list[str]]:
    """Return every command that takes an address, with one to use."""
    train = ["train", "--preset", "smoke", "--out"]
    return [
        *(["data", verb, place] for verb in ("status", "validate", "preview", "card")),
        ["data", "export", place, "--layout", "unips", "--out", str(out / "tree")],
        ["data", "pack", place, "--out", str(out / "tars")],
        ["render-data", "--preset", "smoke", "--out", place],
        [*train, str(out / "trained"), "--data", place],
        [*train, place],
    ]  # fmt: skip


def test_wrong_keys_and_a_missing_bucket_end_every_command_in_one_line(
    s3: ObjectStore, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    missing, locked = "s3://no-such-bucket/run", f"s3://{BUCKET}/locked"
    for words in commands(missing, tmp_path):
        assert main(words) == 2, words
        text = capsys.readouterr().err
        assert re.match(rf"sdps: {missing}\S*: .*bucket does not exist", text) and text.count("\n") == 1, (words, text)
    with strict(s3):
        for words in commands(locked, tmp_path):
            assert main(words) == 2, words
            text = capsys.readouterr().err
            assert re.match(rf"sdps: {locked}\S*: refused \(.*check the keys", text), (words, text)
            assert text.count("\n") == 1, text
    assert not any((tmp_path / name).exists() for name in ("tree", "tars", "trained"))


@pytest.mark.parametrize(("scheme", "package"), [("gs", "gcsfs"), ("az", "adlfs"), ("s3", "s3fs")])
def test_a_missing_driver_is_one_line(
    scheme: str, package: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    registry = pytest.importorskip("fsspec.registry")
    monkeypatch.setitem(sys.modules, package, None)  # as if it were not installed
    monkeypatch.delitem(registry._registry, scheme, raising=False)
    assert main(["data", "status", f"{scheme}://bucket/run"]) == 2
    text, install = capsys.readouterr().err, "sdps[storage]" if scheme == "s3" else package
    assert f"sdps: {scheme}://bucket/run: needs a driver: " in text and text.endswith(f"pip install '{install}'\n")
    assert text.count("\n") == 1


def test_commands_that_want_a_folder_refuse_an_address(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["regenerate", "--shapes", "sphere", "--out", f"s3://{BUCKET}/run"]) == 2
    assert f"s3://{BUCKET}/run: this command works in folders of this machine" in capsys.readouterr().err
    assert not Path("s3:").exists()


def test_a_server_that_goes_away_is_waited_for(s3: ObjectStore) -> None:
    store = Store(f"s3://{BUCKET}/away")
    store.write("a", b"1")
    s3.stop()
    back = threading.Timer(2.0, s3.start)
    back.start()
    store.write("a", b"2")
    back.join()
    assert store.read("a") == b"2" and not store.create("a", b"3") and store.create("b", b"3")


def test_a_web_server_is_read_by_its_checksums(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from functools import partial
    from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer

    pytest.importorskip("aiohttp", reason="the web driver, which s3fs brings, is missing")
    scenes = good_folder(tmp_path / "good")
    monkeypatch.setattr(SimpleHTTPRequestHandler, "log_message", lambda *_: None)
    with ThreadingHTTPServer(("127.0.0.1", 0), partial(SimpleHTTPRequestHandler, directory=tmp_path)) as web:
        threading.Thread(target=web.serve_forever, daemon=True).start()
        url = f"http://127.0.0.1:{web.server_port}/good"
        with pytest.raises(InputError, match=r"no checksums\.txt there"), open_folder(url):
            pass
        assert main(["data", "card", str(tmp_path / "good")]) == 0
        with open_folder(url) as folder:
            assert select_rendered(folder, scenes) == scenes and validate(folder).sound
        web.shutdown()
