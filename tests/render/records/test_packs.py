"""Packed sets: tars that do not depend on when and how often they were written, read back as the folder they hold."""

import json
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest
from sdps_scenes import write_data

from pipelines.cli import main
from render.checks.validate import validate
from render.records import mirror
from render.records.manifest import SceneSpec, read_manifest
from render.records.mirror import open_folder, select_rendered, shard_path
from render.records.packs import PACK, plan_tars
from render.shared.errors import InputError

pytest.importorskip("webdataset", reason="the tars' library, of sdps[storage], is missing")


@pytest.fixture(autouse=True)
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("SDPS_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("data")
    write_data(path, ("train",) * 8 + ("val",) * 3, lights=4, size=32)
    return path


def pack(folder: Path, out: Path, *more: str) -> dict[str, bytes]:
    """Pack into tars of about four scenes; return what is there then."""
    assert main(["data", "pack", str(folder), "--out", str(out), "--tar-mb", "0.08", *more]) == 0
    return content(out)


def content(out: Path) -> dict[str, bytes]:
    return {str(path.relative_to(out)): path.read_bytes() for path in sorted(out.rglob("*")) if path.is_file()}


def test_tars_are_bounded_the_same_each_time_and_go_on_where_they_were(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    whole = pack(folder, tmp_path / "a")
    tars = {name: len(data) for name, data in whole.items() if name.endswith(".tar")}
    assert len(tars) == 3 and max(tars.values()) <= 80_000
    assert {name.split("/")[1].split("-")[0] for name in tars} == {"train", "val"}
    assert whole["manifest.jsonl"] == (folder / "manifest.jsonl").read_bytes()
    lost = sorted(tars)[1]
    (tmp_path / "a" / lost).unlink()
    capsys.readouterr()
    assert pack(folder, tmp_path / "a") == whole
    assert f"in {len(tars)} tars, 1 written now, {len(tars) - 1} kept" in capsys.readouterr().out
    for other in ("--seed=1", "--tar-mb=0.2"):
        assert main(["data", "pack", str(folder), "--out", str(tmp_path / "a"), "--tar-mb", "0.08", other]) == 2
        assert "holds other scenes, or tars of another --tar-mb or --seed" in capsys.readouterr().err
    assert pack(folder, tmp_path / "b", "--seed", "1") != whole
    assert content(tmp_path / "a") == whole


def test_webdataset_reads_the_tars(folder: Path, tmp_path: Path) -> None:
    import webdataset

    names = [str(tmp_path / name) for name in pack(folder, tmp_path) if name.endswith(".tar")]
    samples = {sample["__key__"]: sample for sample in webdataset.WebDataset(names, shardshuffle=False)}
    for scene in read_manifest(folder):
        assert samples[scene.id]["exr"] == (folder / scene.file).read_bytes()
        assert json.loads(samples[scene.id]["json"])["id"] == scene.id


def test_a_packed_set_is_read_as_the_folder_it_holds(folder: Path, tmp_path: Path) -> None:
    pack(folder, tmp_path / "tars")
    scenes = read_manifest(folder)
    with open_folder(tmp_path / "tars") as place:
        assert select_rendered(place, scenes) == scenes
        assert validate(place).statistics == validate(folder).statistics
        for scene in scenes:
            assert shard_path(place, scene).read_bytes() == (folder / scene.file).read_bytes()
    with pytest.raises(InputError, match="holds a packed set, which is only read"):
        open_folder(tmp_path / "tars", purpose="run").__enter__()


def test_the_cache_keeps_to_its_limit(folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pack(folder, tmp_path / "tars")
    monkeypatch.setattr(mirror, "_IN_USE", -1.0)
    with open_folder(tmp_path / "tars", cache_gb=100e-6) as place:
        for scene in read_manifest(folder):
            assert shard_path(place, scene).is_file()
            assert sum(path.stat().st_size for path in (place / "shards").iterdir()) <= 100_000


@pytest.mark.parametrize("how", [slice(None, 3000), slice(None, -20_000), "altered"])
def test_a_damaged_tar_is_named(folder: Path, tmp_path: Path, how: slice | str) -> None:
    names = [name for name in pack(folder, tmp_path) if "train" in name]
    for name in names:
        data = (tmp_path / name).read_bytes()
        wrong = data[:9000] + b"0123456789" + data[9010:] if isinstance(how, str) else data[how]
        (tmp_path / name).write_bytes(wrong)
    with (
        open_folder(tmp_path) as place,
        pytest.raises(InputError, match=r"train-00000\d.tar: truncated or altered; remove"),
    ):
        shard_path(place, read_manifest(folder)[0])
    (tmp_path / names[0]).write_bytes(b"")
    (tmp_path / PACK).write_text("[]")
    with pytest.raises(InputError, match=r"pack\.json: not a list of tars"), open_folder(tmp_path) as place:
        select_rendered(place, read_manifest(folder))


def test_what_is_not_rendered_is_not_packed(folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_data(tmp_path / "data", ("train",) * 8 + ("val",) * 3, lights=4, size=32)
    (gone, torn) = (tmp_path / "data" / scene.file for scene in read_manifest(folder)[2:4])
    gone.unlink()
    command = ["data", "pack", str(tmp_path / "data"), "--out", str(tmp_path / "tars")]
    assert main(command) == 2
    assert "1 of 8 shards of split 'train' are missing" in capsys.readouterr().err
    data = torn.read_bytes()
    torn.write_bytes(data[:-10])
    assert main([*command, "--skip-missing"]) == 2
    assert "truncated or altered; `sdps render-data --verify` renders it again" in capsys.readouterr().err
    assert not list((tmp_path / "tars").rglob("*.tar"))
    torn.write_bytes(data)
    assert main([*command, "--skip-missing"]) == 0
    with open_folder(tmp_path / "tars") as place:
        assert len(select_rendered(place, read_manifest(place))) == 10


def test_scenes_of_a_shape_are_spread_over_the_tars(folder: Path) -> None:
    def scenes() -> Iterator[SceneSpec]:
        yield from (scene for scene in read_manifest(folder) if scene.split == "train")

    (first,) = {tuple(plan_tars(list(scenes()), [1000] * 8, 40_000, 0)["tars/train-000000.tar"]) for _ in range(2)}
    assert list(first) != [scene.id for scene in scenes()][: len(first)]


def test_a_packed_set_on_a_web_server_needs_no_listing(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from functools import partial
    from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer

    pytest.importorskip("aiohttp", reason="the web driver, which s3fs brings, is missing")
    pack(folder, tmp_path / "tars")
    monkeypatch.setattr(SimpleHTTPRequestHandler, "log_message", lambda *_: None)
    with ThreadingHTTPServer(("127.0.0.1", 0), partial(SimpleHTTPRequestHandler, directory=tmp_path)) as web:
        threading.Thread(target=web.serve_forever, daemon=True).start()
        with open_folder(f"http://127.0.0.1:{web.server_port}/tars") as place:
            scene = read_manifest(place)[0]
            assert shard_path(place, scene).read_bytes() == (folder / scene.file).read_bytes()
        web.shutdown()
