"""Runs: how a model's recipe, a preset's sections and a run's own settings make one configuration."""

from pathlib import Path

import pytest

from pipelines.shared import presets
from pipelines.train.train import in_order, load_required
from render.shared.errors import InputError
from sdps.methods import pretrained
from sdps.models.registry import MODELS
from sdps.training import recipes
from sdps.training.training_config import LightingTraining, NormalTraining, PixelTraining


def test_published_recipes_are_the_default() -> None:
    lcnet, nenet, psfcn = (recipes.run(name, {}, {}).config for name in ("lcnet", "nenet", "psfcn"))
    assert (lcnet.epochs, lcnet.batch_scenes, lcnet.learning_rate, lcnet.halve_after) == (20, 32, 5e-4, (5, 10, 15))
    assert (nenet.epochs, nenet.batch_scenes, nenet.crop, nenet.halve_after) == (10, 16, 0, (2, 4, 6, 8))
    assert (psfcn.epochs, psfcn.batch_scenes, psfcn.crop, psfcn.learning_rate) == (30, 32, 32, 1e-3)


def test_sections_lie_over_recipes_and_runs_over_sections() -> None:
    sections = {"normals": {"crop": 64, "augmentation": {"noise": 0.1, "symmetries": True}}}
    runs = {"psfcn": {"augmentation": {"noise": 0.0}}, "other": {"base": "psfcn", "crop": 16}}
    psfcn, other = (recipes.run(name, sections, runs) for name in ("psfcn", "other"))
    assert psfcn.config.crop == 64 and psfcn.config.epochs == 30
    assert psfcn.config.augmentation.noise == 0.0 and psfcn.config.augmentation.symmetries
    assert (other.name, other.model, other.config.crop) == ("other", "psfcn", 16)
    assert other.config.augmentation.noise == 0.1


def test_every_role_has_its_configuration() -> None:
    kinds = {"lighting": LightingTraining, "normals": NormalTraining, "pixels": PixelTraining}
    for name, item in MODELS.items():
        assert type(recipes.run(name, {}, {}).config) is kinds[item.role]


def test_what_a_run_needs() -> None:
    assert recipes.run("lcnet", {}, {}).requires == {}
    assert recipes.run("psfcn", {}, {}).requires == {}
    assert recipes.run("upsfcn-deep", {}, {}).requires == {}
    assert recipes.run("nenet-reg", {}, {}).requires == {"lighting": "lcnet-reg"}
    runs = {"nenet-k72": {"base": "nenet", "lights": "lcnet-k72"}, "lcnet-k72": {"base": "lcnet"}}
    assert recipes.run("nenet-k72", {}, runs).requires == {"lighting": "lcnet-k72"}


@pytest.mark.parametrize(
    ("sections", "runs", "name", "message"),
    [
        ({}, {}, "nenett", "did you mean 'nenet'"),
        ({"normals": {"crp": 64}}, {}, "nenet", "did you mean 'normals.crop'"),
        ({"lighting": {"size": 96}}, {}, "lcnet", "must be 128 for LCNet"),
        ({}, {"nenet": {"crop": 30}}, "nenet", "crop must be"),
        ({}, {"mine": {"base": "lcnt"}}, "mine", "unknown model 'lcnt'"),
        ({}, {"upsfcn": {"lights": "lcnet"}}, "upsfcn", "is not given lights"),
        ({"normals": {"glare_weight": 0.1}}, {}, "nenet", "unknown key 'normals.glare_weight'"),
        ({}, {"mine": {"base": "attention"}}, "mine", "unknown model 'attention'"),
    ],
)
def test_mistakes_name_the_field(sections: dict, runs: dict, name: str, message: str) -> None:
    with pytest.raises(InputError, match=message) as error:
        recipes.run(name, sections, runs)
    assert "\n" not in str(error.value)


def test_names_expand_to_runs() -> None:
    assert recipes.expand(["sdps-plus", "nenet"], {}) == ["lcnet-soft", "nenet-plus", "nenet"]
    assert set(recipes.expand(["all"], {"mine": {}})) == {*MODELS, "mine"}
    with pytest.raises(InputError, match="did you mean 'sdps-plus'"):
        recipes.expand(["sdps-pluss"], {})


def test_runs_are_trained_after_what_they_need() -> None:
    preset = presets.load("smoke")
    assert in_order(preset, ["nenet-reg", "nenet-plus"]) == ["lcnet-reg", "nenet-reg", "lcnet-soft", "nenet-plus"]
    with pytest.raises(InputError, match="needs itself"):
        in_order(presets.load("smoke", ["runs.a={base: nenet, lights: a}"]), ["a"])


def test_weights_that_are_there_need_no_run(tmp_path: Path) -> None:
    own = "runs.further={base: nenet, start: shipped:nenet, lights: shipped:lcnet}"
    assert in_order(presets.load("smoke", [own]), ["further"]) == ["further"]
    assert load_required(tmp_path, "shipped:lcnet").name == "lcnet"
    assert load_required(tmp_path, str(pretrained.shipped_folder() / "psfcn.safetensors")).name == "psfcn"
    gone = tmp_path / "gone.safetensors"
    with pytest.raises(InputError, match=r"gone.safetensors: no such weights"):
        in_order(presets.load("smoke", [f"runs.further={{base: nenet, start: {gone}}}"]), ["further"])


def test_presets_saved_by_an_earlier_version_load_without_what_was_removed(tmp_path: Path) -> None:
    file = tmp_path / "config.yaml"
    file.write_text("name: x\ndescription: x\njoint: {}\n")
    assert presets.load(str(file)).name == "x"
    file.write_text("name: x\ndescription: x\njoint: {steps: 3}\n")
    with pytest.raises(InputError, match=r"config.yaml: joint: .* was removed; delete the section"):
        presets.load(str(file))
