"""The command line: presets and their errors, and the whole line once at smoke scale."""

import json
import re

import numpy as np
import pytest
import yaml

from pipelines.cli import main
from pipelines.shared import presets, scenes
from pipelines.shared.flags import split_list
from render.planning import light_sets
from render.records.manifest import read_manifest
from render.records.shards import file_hash, read_shard
from render.shared.errors import InputError
from sdps.methods import pretrained
from sdps.photos import reading

TINY = [word for item in ("size=32", "spp=2", "bounces=0") for word in ("--set", f"test.{item}")]


def fails(capsys: pytest.CaptureFixture, *argv: str) -> str:
    """Run the command, expect exit code 2 and one line on standard error, and return that line."""
    assert main(argv) == 2
    captured = capsys.readouterr()
    lines = [line for line in captured.err.splitlines() if line and not re.search(r"\d+%\|", line)]
    assert len(lines) == 1 and lines[0].startswith("sdps: "), captured.err
    return lines[0]


# ---- Presets ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", presets.names())
def test_every_shipped_preset_is_valid_and_survives_saving(name, tmp_path):
    preset = presets.load(name)
    assert preset.name == name
    presets.save_resolved(preset, tmp_path)
    assert presets.load(str(tmp_path / "config.yaml")) == preset


def test_paper_preset_has_the_published_composition_and_schedule():
    preset = presets.load("paper")
    per_shape = preset.data.views * preset.data.materials_per_view
    counts = {family: count * per_shape for family, count in preset.data.families.items()}
    assert counts == {"blobby": 25_920, "sculpture": 59_292}
    assert preset.data.light_count == 64
    lighting, normals, psfcn = (preset.run(name).config for name in ("lcnet", "nenet", "psfcn"))
    assert (lighting.epochs, lighting.batch_scenes, lighting.images) == (20, 32, 32)
    assert (normals.epochs, normals.batch_scenes, normals.loss) == (10, 16, "faithful")
    assert lighting.learning_rate_at(0.26) == pytest.approx(2.5e-4)
    assert (psfcn.epochs, psfcn.batch_scenes, psfcn.crop, psfcn.learning_rate_at(0.2)) == (30, 32, 32, 5e-4)


def test_an_override_changes_one_run_and_not_those_that_share_its_settings(tmp_path):
    """YAML's references, merged or not, are a short way to write settings, no bond between them."""
    (tmp_path / "own.yaml").write_text(
        "name: own\ndescription: runs that share settings\n"
        "normals: &normals {augmentation: &noise {noise: 0.01}}\npixels: *normals\nruns:\n"
        "  a: &a {base: nenet, seed: 3, augmentation: *noise}\n  b: *a\n  c: {<<: *a, seed: 4}\n"
    )
    ways = ["runs.a.seed=7", "runs.a.augmentation.noise=0.5"]
    for overrides in (ways, ways[::-1]):
        preset = presets.load(str(tmp_path / "own.yaml"), overrides)
        configs = [preset.run(name).config for name in "abc"]
        assert [config.seed for config in configs] == [7, 3, 4]
        assert [config.augmentation.noise for config in configs] == [0.5, 0.01, 0.01]
        assert preset.normals == preset.pixels == {"augmentation": {"noise": 0.01}}


def test_overrides_reach_any_field_and_convert_types():
    preset = presets.load("smoke", ["data.size=32", "lighting.learning_rate=1e-3", "test.materials=[chrome]",
                                    "data.families.blobby=1", "lighting.augmentation.noise=0"])  # fmt: skip
    assert preset.data.size == 32
    lighting = preset.run("lcnet").config
    assert lighting.learning_rate == 1e-3
    assert preset.test.materials == ("chrome",)
    assert preset.data.families == {"blobby": 1, "sculpture": 3}
    assert lighting.augmentation.noise == 0.0


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("data.sise=32", "did you mean 'data.size'"),
        ("dta.size=32", "did you mean 'data'"),
        ("data.size", "expected section.field=value"),
        ("data.size=big", "data.size: expected int"),
        ("data.size=30", "size must be a multiple of 4"),
        ("lighting.precision=bf16", "lighting.precision"),
        ("test.lights=mertest", "did you mean 'merltest'"),
        ("data.size=[1", "not valid YAML"),
    ],
)
def test_wrong_override_names_the_field(override, message):
    with pytest.raises(InputError, match=re.escape(message)):
        presets.load("smoke", [override])


def test_preset_errors_from_the_command_line(capsys, tmp_path):
    assert "did you mean 'demo'" in fails(capsys, "render-data", "--preset", "dmeo", "--out", str(tmp_path / "a"))
    assert "no such file" in fails(capsys, "train", "--preset", "absent.yaml")
    broken = tmp_path / "broken.yaml"
    broken.write_text("name: [unclosed\n")
    assert "broken.yaml" in fails(capsys, "render-data", "--preset", str(broken))
    assert not (tmp_path / "a").exists()


# ---- Commands --------------------------------------------------------------------------------------


def test_unknown_command_and_flag(capsys):
    assert "did you mean 'train'" in fails(capsys, "trian")
    assert "--presett" in fails(capsys, "train", "--presett", "demo")


def test_help_lists_every_command(capsys):
    assert main([]) == 0
    text = capsys.readouterr().out
    for command in ("doctor", "render-data", "models", "train", "evaluate", "regenerate", "materials", "shapes"):
        assert command in text


def test_train_and_evaluate_without_data_or_weights_say_what_to_run(capsys, tmp_path, monkeypatch):
    monkeypatch.setattr(pretrained, "list_shipped", list)  # as if none travelled with the package
    assert "sdps render-data" in fails(capsys, "train", "--preset", "smoke", "--out", str(tmp_path / "none"))
    asked = (
        "evaluate",
        "merltest",
        "--preset",
        "smoke",
        "--out",
        str(tmp_path / "none"),
        "--set",
        "test.shipped=[all]",
    )
    assert "sdps train" in fails(capsys, *asked)
    assert not (tmp_path / "none" / "merltest").exists()


def test_data_commands_name_the_folder_that_was_meant(capsys, tmp_path):
    assert main(["data"]) == 0
    assert "validate" in capsys.readouterr().out
    assert "did you mean 'status'" in fails(capsys, "data", "stauts")
    (tmp_path / "data").mkdir()
    (tmp_path / "data" / "manifest.jsonl").write_text("")
    for command in ("status", "validate", "preview", "card"):
        assert f"name its data folder, {tmp_path / 'data'}" in fails(capsys, "data", command, str(tmp_path))
        assert "no manifest.jsonl there" in fails(capsys, "data", command, str(tmp_path / "none"))
    line = fails(capsys, "render-data", "--preset", "smoke", "--out", str(tmp_path / "data"))
    assert "--out names the folder above" in line and not (tmp_path / "data" / "data").exists()


def test_materials_and_shapes_list_what_there_is(capsys):
    assert main(["materials"]) == 0
    assert "100 materials" in (listing := capsys.readouterr().out) and "gold-metallic-paint" in listing
    assert main(["materials", "--category", "phenolic"]) == 0
    assert capsys.readouterr().out.count("fit error") == 12
    assert "did you mean 'plastic'" in fails(capsys, "materials", "--category", "plastik")
    assert main(["shapes"]) == 0
    assert "sculpture:<seed>" in capsys.readouterr().out


def test_doctor_reports_variant_and_cores(capsys):
    assert main(["doctor"]) in (0, 1)
    text = capsys.readouterr().out
    for name in ("mitsuba", "variant", "libLLVM", "cores", "free disk"):
        assert re.search(rf"^{name}\s+\S", text, re.MULTILINE)


def test_doctor_passes_on_a_small_disk_and_says_so(capsys, monkeypatch):
    monkeypatch.setattr("pipelines.doctor.free_bytes", lambda folder: 3_200_000_000)
    assert main(["doctor"]) == 0
    assert "3.2 GB; the demo takes about 5.0 GB, choose another --out" in capsys.readouterr().out


def test_doctor_that_cannot_fetch_says_so_and_goes_on(capsys, monkeypatch):
    def fails(*_: object) -> None:
        raise InputError("no network; sudo apt-get install libllvm19")

    monkeypatch.setattr("render.backend.variant.choose", fails)
    monkeypatch.setattr("render.backend.llvm.fetch", fails)
    assert main(["doctor", "--fix"]) == 1
    said = capsys.readouterr().out.splitlines()
    assert said[0] == "not fetched: no network; sudo apt-get install libllvm19"
    assert any(line.startswith("bunny mesh ") for line in said) and said[-1].startswith("missing: Mitsuba variant:")


def test_list_flags_take_commas_and_repetition():
    assert split_list(["a,b", "c", " d ,"]) == ["a", "b", "c", "d"]
    assert scenes.slug("lambertian:0.8/0.3/0.1") == "lambertian-0.8-0.3-0.1"
    assert scenes.slug("some/folder/my steel.yaml") == "my-steel"


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


# ---- The whole line --------------------------------------------------------------------------------


def test_the_whole_line_at_smoke_scale(capsys, tmp_path):
    fewer = ("lighting.steps=2", "normals.steps=2", "test.lights=near-uniform:12", "test.materials=[chrome]")
    flags = ["--preset", "smoke", "--out", str(tmp_path), *(word for item in fewer for word in ("--set", item))]
    for command in ("render-data", "train", "eval-merltest"):
        assert main([command, *flags]) == 0, capsys.readouterr().err
    text = capsys.readouterr().out
    assert "Table A, lighting estimation" in text and "constant predictor" in text
    results = json.loads((tmp_path / "eval" / "results.json").read_text())
    assert len(results["scenes"]) == 2
    lights = light_sets.load("near-uniform:12")
    for scene in results["scenes"]:
        constant = scene["scores"]["constant predictor"]
        assert constant["direction_mae"] == pytest.approx(np.degrees(np.arccos(lights[:, 2])).mean(), abs=0.1)
        assert scene["scores"]["least-squares, true lights"]["normal_mae"] < 35
        assert 0 < scene["scores"]["lcnet + nenet"]["normal_mae"] < 90
    page = (tmp_path / "report.html").read_text()
    assert page.count("data:image/png;base64,") >= 2 * 6
    assert not re.search(r"(src|href)=\"(?!data:|#)", page)  # self-contained
    for folder in ("data", "models/lcnet", "models/nenet", "merltest", "eval"):
        assert presets.load(str(tmp_path / folder / "config.yaml")).name == "smoke"
    for name in ("lcnet.safetensors", "lcnet-best.safetensors", "curves.png", "MODEL_CARD.md"):
        assert (tmp_path / "models" / "lcnet" / name).stat().st_size > 100
    evaluate_combinations(capsys, flags, tmp_path)


def evaluate_combinations(capsys, flags, out):
    """Train two more models in the folder of the line above, and combine what is there."""
    assert main(["train", *flags, "--models", "psfcn,cnnps", "--set", "pixels.steps=1"]) == 0
    assert "psfcn: 2 steps" in (text := capsys.readouterr().out) and "cnnps: 1 steps" in text
    flags = [*flags, "--set", "test.rotations=1"]
    combinations = {
        "lcnet + psfcn": ["--lighting", "lcnet", "--normals", "psfcn"],
        "lcnet + cnnps": ["--lighting", "lcnet", "--normals", "cnnps"],
        "cnnps, true lights": ["--normals", "cnnps"],
        "lcnet + nenet, true intensities": ["--normals", "sdps", "--intensities", "true"],
        "lcnet + least-squares": ["--lighting", "lcnet", "--normals", "least-squares"],
    }
    for name, words in combinations.items():
        assert main(["evaluate", "merltest", *flags, *words]) == 0
        assert name in capsys.readouterr().out
    scores = json.loads((out / "eval" / "results.json").read_text())["scenes"][0]["scores"]
    assert "direction_mae" not in scores["least-squares, true lights"]  # what was given is not scored
    assert "did you mean 'psfcn'" in fails(
        capsys, "evaluate", "merltest", *flags, "--lighting", "lcnet", "--normals", "psfnc"
    )
    line = fails(capsys, "evaluate", "merltest", *flags, "--normals", "sdps-reg")
    assert "no such weights; train them with `sdps train --models" in line
