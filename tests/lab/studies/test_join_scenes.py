"""lab/studies/join_scenes.py: the finished scenes of several folders as one."""

import os
from dataclasses import replace
from pathlib import Path

import pytest

from lab.studies import join_scenes
from render.records.manifest import SceneSpec, View, read_manifest, write_manifest
from sdps.data.scene_store import list_finished


def plan(folder: Path, names: list[str], finished: list[str]) -> Path:
    """Write a data folder whose finished shards hold the folder's name."""
    shared = {"split": "train", "shape": "sphere", "material": "nylon", "view": View(), "lights": ((0.0, 0.0, 1.0),)}
    (folder / "shards").mkdir(parents=True)
    write_manifest(folder, [SceneSpec(id=name, seed=0, size=16, spp=1, bounces=0, **shared) for name in names])
    for name in finished:
        (folder / "shards" / f"{name}.exr").write_text(folder.name)
    return folder


def test_finished_scenes_of_both_are_joined_in_order_and_again_with_the_same_result(tmp_path):
    first, second = plan(tmp_path / "a", ["s0", "s1"], ["s1"]), plan(tmp_path / "b", ["s2"], ["s2"])
    for _ in range(2):
        assert join_scenes.main([str(first), str(second), "--out", str(tmp_path / "out")]) == 0
    assert [scene.id for scene in read_manifest(tmp_path / "out")] == ["s1", "s2"]
    assert [scene.id for scene in list_finished(tmp_path / "out", "train")] == ["s1", "s2"]
    assert (tmp_path / "out" / "shards" / "s2.exr").read_text() == "b"


def test_shards_are_copied_where_links_are_refused(tmp_path, monkeypatch):
    def refuse(*_: object) -> None:
        raise OSError("no links here")

    monkeypatch.setattr(os, "link", refuse)
    folder = plan(tmp_path / "a", ["s0"], ["s0"])
    assert join_scenes.join([folder], tmp_path / "out") == 1
    assert [path.name for path in (tmp_path / "out" / "shards").iterdir()] == ["s0.exr"]


@pytest.mark.parametrize(("names", "finished", "about"), [(["s0"], ["s0"], "data.prefix"), (["s1"], [], "")])
def test_names_met_twice_are_refused_unless_they_are_not_rendered(tmp_path, capsys, names, finished, about):
    folders = [plan(tmp_path / "a", ["s0"], ["s0"]), plan(tmp_path / "b", names, finished)]
    code = join_scenes.main([*map(str, folders), "--out", str(tmp_path / "out")])
    assert code == (2 if about else 0)
    assert about in capsys.readouterr().err
    assert (tmp_path / "out" / "manifest.jsonl").exists() == (not about)


def test_folders_without_a_finished_scene_are_refused(tmp_path, capsys):
    folder = plan(tmp_path / "a", ["s0"], [])
    assert join_scenes.main([str(folder), "--out", str(tmp_path / "out")]) == 2
    assert "no finished scene" in capsys.readouterr().err


def test_of_scenes_of_one_name_the_first_may_be_kept(tmp_path):
    folders = [plan(tmp_path / "a", ["s0"], ["s0"]), plan(tmp_path / "b", ["s0", "s1"], ["s0", "s1"])]
    assert join_scenes.main([*map(str, folders), "--out", str(tmp_path / "out"), "--first"]) == 0
    assert [scene.id for scene in read_manifest(tmp_path / "out")] == ["s0", "s1"]
    assert (tmp_path / "out" / "shards" / "s0.exr").read_text() == "a"


def test_a_folder_gives_so_many_training_scenes_and_all_its_validation_scenes(tmp_path, capsys):
    first, second = (
        plan(tmp_path / "a", ["s0", "s1", "s2", "s3"], ["s0", "s1", "s3"]),
        plan(tmp_path / "b", ["t0"], ["t0"]),
    )
    write_manifest(second, [replace(scene, split="val") for scene in read_manifest(second)])
    out = ["--out", str(tmp_path / "out")]
    assert join_scenes.main([str(first), str(second), *out, "--train", "2", "0"]) == 0
    assert [scene.id for scene in read_manifest(tmp_path / "out")] == ["s0", "s1", "t0"]
    for wrong, about in ((["4", "0"], "3 finished training scenes"), (["1"], "each of 2 folders")):
        assert join_scenes.main([str(first), str(second), *out, "--train", *wrong]) == 2
        assert about in capsys.readouterr().err
