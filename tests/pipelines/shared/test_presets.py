"""Presets: what they hold, and overrides."""

import re

import pytest
from command_line import fails

from pipelines.shared import presets
from render.shared.errors import InputError


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


def test_a_name_may_be_a_word_that_yaml_takes_for_a_truth_value() -> None:
    assert presets.load("smoke", ["runs.nenet.lights=true"]).run("nenet").config.lights == "true"


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
