"""`sdps data relight`: trees of mixed light, resumed, recorded and refused."""

import json

import cv2
import numpy as np
import pytest
from stage_scenes import write_stage

from pipelines.cli import main
from render.exchange.tree_check import check_tree
from render.records.manifest import read_manifest
from render.records.shards import read_shard
from render.shared.images import read_image


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    path = tmp_path_factory.mktemp("stage")
    write_stage(path)
    return path


def fails(capsys, *argv: str) -> str:
    assert main(["data", "relight", *argv]) == 2
    lines = [line for line in capsys.readouterr().err.splitlines() if line.startswith("sdps: ")]
    assert len(lines) == 1
    return lines[0]


def test_a_constant_environment_makes_the_images_it_must(capsys, folder, tmp_path):
    """A white sphere under radiance 1 from above the horizon is (1 + n_z) / 2 bright."""
    alone = ["--directional", "0", "--lamp", "0", "--area", "0", "--environment", "1", "--environments", "constant"]
    argv = ["data", "relight", str(folder), "--out", str(tmp_path / "tree"), "--images", "3", "--exposure", "1.6",
            *alone]  # fmt: skip
    assert main(argv) == 0
    text = capsys.readouterr().out
    assert "2 scenes of 3 images as unips, 2 written now" in text
    assert check_tree(tmp_path / "tree", "unips", shards=folder).violations == []
    assert "constant:0: 50% of its light comes from behind" in text
    scene = read_manifest(folder)[0]
    shard = read_shard(folder / scene.file, scene)
    place = tmp_path / "tree" / "sphere-0.data"
    assert sorted(path.name for path in place.iterdir()) == sorted(
        ["L000.png", "L001.png", "L002.png", "mask.png", "Normal_gt.png", "scene.json"]
    )
    image = read_image(place / "L001.png")[shard.mask] / 65535 / 1.6
    expected = (1 + shard.normals[shard.mask][:, 2:]) / 2 / 2  # weights sum to 1 where the hemisphere's have 2
    np.testing.assert_allclose(image, np.repeat(expected, 3, 1), rtol=0.02)
    record = json.loads((place / "scene.json").read_text())
    assert len(record["lighting"]) == 3 and record["lighting"][0]["lights"][0]["map"].startswith("constant:")
    assert "light_directions" not in record
    assert main(argv) == 0 and "0 written now, 2 kept" in capsys.readouterr().out
    assert main([*argv, "--check"]) == 0
    assert "2 samples of 3 lights; every rule of its loaders holds" in capsys.readouterr().out
    (place / "mask.png").unlink()
    assert main([*argv, "--check"]) == 1 and "mask.png: no such picture" in capsys.readouterr().out
    assert "mixed was" in fails(capsys, *argv[2:], "--seed", "1")


def test_the_same_seed_gives_the_same_files_and_other_scenes_other_light(folder, tmp_path):
    for name, seed in (("a", "0"), ("b", "0"), ("c", "1")):
        assert (
            main(["data", "relight", str(folder), "--out", str(tmp_path / name), "--images", "2", "--seed", seed]) == 0
        )
    first, again, other = (
        [(tmp_path / name / f"sphere-{number}.data" / "L000.png").read_bytes() for number in range(2)] for name in "abc"
    )
    assert first == again and first != other and first[0] != first[1]


def test_mistakes_end_in_one_line(capsys, folder, tmp_path):
    out = ["--out", str(tmp_path / "tree")]
    write_stage(tmp_path / "few", lights=64, scenes=1)
    assert "64 lights are too few to mix light from, 128 are needed" in fails(capsys, str(tmp_path / "few"), *out)
    assert not (tmp_path / "tree").exists()
    bad = np.ones((8, 16, 3), np.float32)
    cv2.imwrite(str(tmp_path / "square.hdr"), bad[:, :8])
    assert "twice as wide as high" in fails(capsys, str(folder), *out, "--environments", str(tmp_path / "square.hdr"))
    assert "no such environment map" in fails(capsys, str(folder), *out, "--environments", str(tmp_path / "no.exr"))
    assert "did you mean 'studio'" in fails(capsys, str(folder), *out, "--environments", "studo")
    assert "take unips" in fails(capsys, str(folder), *out, "--layout", "diligent")
    assert "images must be at least 1" in fails(capsys, str(folder), *out, "--images", "0")
    assert "environment must be in [0, 1]" in fails(capsys, str(folder), *out, "--environment", "2")
    assert "no manifest.jsonl there" in fails(capsys, str(tmp_path / "none"), *out)
    assert not (tmp_path / "tree").exists()
