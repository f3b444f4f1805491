"""`sdps regenerate`: scenes, photographs and Mitsuba scenes."""

import json

import numpy as np
import pytest
import yaml
from command_line import TINY, fails

from pipelines.cli import main
from render.records.manifest import read_manifest
from render.records.shards import file_hash, read_shard
from sdps.photos import reading


def test_regenerate_writes_scenes_and_reuses_them(capsys, tmp_path):
    own = tmp_path / "grey.yaml"
    assert main(["materials"]) == 0
    from render.materials.model import lambertian
    from render.shared.config import to_plain

    plain = {k: v.tolist() if isinstance(v, np.ndarray) else v for k, v in to_plain(lambertian(0.5)).items()}
    own.write_text(yaml.safe_dump(plain | {"name": "grey"}))
    lights = tmp_path / "mine.txt"
    lights.write_text("0 0 1\n0.5 0 1\n0 -0.5 2\n")
    out = tmp_path / "scenes"
    argv = ["regenerate", "--shapes", "sphere", "--materials", f"chrome,{own}", "--materials", "lambertian:0.5",
            "--lights", str(lights), "--out", str(out), *TINY]  # fmt: skip
    assert main(argv) == 0
    manifest = read_manifest(out, "test")
    assert [scene.id for scene in manifest] == ["sphere-chrome", "sphere-grey", "sphere-lambertian-0.5"]
    shards = [read_shard(out / scene.file, scene) for scene in manifest]
    np.testing.assert_array_equal(shards[1].images, shards[2].images)  # a YAML of lambertian:0.5 is lambertian:0.5
    assert {"sdps", "mitsuba", "drjit", "numpy", "OpenEXR", "variant"} <= shards[0].provenance.keys()
    assert (out / "preview.png").stat().st_size > 1000
    hashes = [file_hash(out / scene.file) for scene in manifest]
    assert main(argv) == 0
    assert "0 rendered now" in capsys.readouterr().out
    assert [file_hash(out / scene.file) for scene in manifest] == hashes
    assert "holds another plan" in fails(capsys, *argv, "--set", "test.seed=1")


def test_regenerate_takes_a_perspective_camera_and_near_lights(capsys, tmp_path):
    argv = ["regenerate", "--shapes", "sphere", "--materials", "lambertian:0.5", "--lights", "near-uniform:3", *TINY]
    out = ["--out", str(tmp_path / "scenes")]
    assert main([*argv, *out, "--camera-distance", "3", "--light-distance", "2.5"]) == 0
    (scene,) = read_manifest(tmp_path / "scenes")
    assert scene.view.camera_distance == 3 and scene.light_distances == (2.5,) * 3
    shard = read_shard(tmp_path / "scenes" / scene.file, scene)
    np.testing.assert_allclose(np.linalg.norm(shard.light_positions, axis=1), 2.5, rtol=1e-5)
    capsys.readouterr()
    assert "move it out" in fails(capsys, *argv, *out, "--light-distance", "0.5")
    assert "give a larger distance" in fails(capsys, *argv, *out, "--camera-distance", "0.5")


def test_regenerate_saves_scenes_for_stock_mitsuba(capsys, tmp_path):
    argv = ["regenerate", "--shapes", "sphere", "--materials", "stripes:3:lambertian:0.9+chrome,lambertian:0.5",
            "--lights", "near-uniform:2", "--out", str(tmp_path), *TINY]  # fmt: skip
    assert main(argv) == 0
    assert not (tmp_path / "mitsuba").exists()
    assert main([*argv, "--mitsuba"]) == 0
    assert "0 rendered now" in (text := capsys.readouterr().out) and "2 scenes for stock Mitsuba" in text
    saved = tmp_path / "mitsuba"
    ids = [scene.id for scene in read_manifest(tmp_path)]
    assert sorted(path.name for path in saved.iterdir()) == sorted(ids)
    files = {id: sorted(path.name for path in (saved / id).iterdir()) for id in ids}
    plain = ["README.txt", "lights.txt", "object.ply", "scene.xml"]
    assert files == {
        "sphere-stripes-3-lambertian-0.9--chrome": sorted([*plain, "material1.bsdf"]),
        "sphere-lambertian-0.5": plain,
    }
    (saved / ids[0] / "scene.xml").unlink()
    assert "holds other files" in fails(capsys, *argv, "--mitsuba")


def test_regenerate_saves_photographs_that_infer_reads(capsys, tmp_path):
    argv = ["regenerate", "--shapes", "sphere", "--materials", "lambertian:0.5", "--lights", "grid:6", "--photographs",
            "--out", str(tmp_path), *TINY, "--set"]  # fmt: skip
    calm = "jpeg_quality: [95, 95], black_error: [0, 0], ambient: [0, 0], field_angle: [0, 0], blur: [0, 0]"
    for jpeg, bits, suffix in ((0, 8, "png"), (0, 12, "png"), (1, 12, "jpg")):
        assert main([*argv, f"test.sensor={{jpeg: {jpeg}, bits: [{bits}], {calm}}}"]) == 0
        saved = tmp_path / "photographs" / "sphere-lambertian-0.5"
        assert len(list(saved.glob(f"0*.{suffix}"))) == len(list(saved.glob("0*"))) == 6
        photos = reading.load(saved, lights="folder")
        assert photos.gamma == ("srgb" if jpeg else "linear") and photos.bits == (8 if bits == 8 or jpeg else 16)
        camera = json.loads((saved / "camera.json").read_text())
        shard = read_shard(tmp_path / "shards" / "sphere-lambertian-0.5.exr")
        expected = shard.images[:, shard.mask].astype(float) * camera["exposure"] * 2 ** camera["stops"]
        found = photos[0:6][:, shard.mask]
        seen = (expected > 0.1) & (expected < 0.9)
        assert np.median(found[seen] / expected[seen]) == pytest.approx(1, abs=0.03)
        assert photos.light_directions == pytest.approx(shard.light_directions, abs=1e-5)
    assert "2 scenes" not in capsys.readouterr().out
    assert "sensor.bits" in fails(capsys, *argv, "test.sensor={bits: [9]}")


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (["--materials", "chrom"], "did you mean 'chrome'"),
        (["--materials", "lambertian:1.5"], "albedo"),
        (["--shapes", "spere"], "did you mean 'sphere'"),
        (["--shapes", "blobby:x"], "seed"),
        (["--lights", "merl"], "did you mean 'merltest'"),
        (["--lights", "merltest,diligent"], "one light set"),
        (["--lights", "biased:many"], "number of lights"),
        (["--set", "test.size=30"], "size must be a multiple of 4"),
        (["--set", "test.sise=32"], "did you mean 'test.size'"),
    ],
)
def test_regenerate_errors_leave_nothing_behind(capsys, tmp_path, flags, message):
    out = tmp_path / "scenes"
    base = {"--shapes": "sphere", "--materials": "chrome"} | dict(zip(flags[::2], flags[1::2], strict=True))
    assert message in fails(capsys, "regenerate", "--out", str(out), *(word for pair in base.items() for word in pair))
    assert not out.exists()


def test_regenerate_refuses_bad_files(capsys, tmp_path):
    empty = tmp_path / "empty.obj"
    empty.write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\n")
    low = tmp_path / "low.txt"
    low.write_text("0 0 1\n0 1 -0.1\n")
    out = ["--out", str(tmp_path / "x")]
    assert "empty.obj" in fails(capsys, "regenerate", "--shapes", str(empty), "--materials", "chrome", *out)
    line = fails(capsys, "regenerate", "--shapes", "sphere", "--materials", "chrome", "--lights", str(low), *out)
    assert "light 2 is below the horizon" in line
    blocked = tmp_path / "file"
    blocked.write_text("")
    line = fails(capsys, "regenerate", "--shapes", "sphere", "--materials", "chrome", "--out", str(blocked / "x"))
    assert "cannot be written" in line
