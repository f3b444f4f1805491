"""Model cards: what they say comes from the files, the rest is not recorded, and the commands on them run."""

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml
from sdps_scenes import hemisphere_lights, shade, sphere_normals, write_data

from pipelines.shared import presets
from pipelines.train.train import in_order
from render.records.manifest import MANIFEST
from render.records.shards import file_hash
from render.shared.config import to_plain, to_yaml
from render.shared.errors import InputError
from sdps.methods import pretrained
from sdps.models.checkpoint import TrainedModel, load_weights, save_weights
from sdps.models.registry import create
from sdps.publishing.model_card import UNKNOWN, render_card, write_model_card
from sdps.training.training_config import LightingTraining, NormalTraining

CONFIG = NormalTraining(steps=8, batch_scenes=2, images=2, size=32, crop=16, lights="true", schedule="cosine")
LIGHT_ERRORS = {"val_direction_mae": 5.5, "val_intensity_error": 0.125}


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("data")
    write_data(path, ("train", "train", "val"), lights=4, size=32)
    return path


def write_run(
    out: Path, data: Path | None, *, model: str = "nenet", name: str = "own", config=CONFIG, lights: str = "true"
) -> Path:
    """Write what a finished run leaves and return its weights."""
    metadata = {
        "config": to_plain(config), "data": file_hash(data / MANIFEST) if data else "0" * 64, "code": "abc123",
        "step": 8, "seconds": 5400.0, "metrics": {"val_loss": 0.3, "val_normal_mae": 12.3456, **LIGHT_ERRORS},
        "lights": lights,
    }  # fmt: skip
    torch.manual_seed(0)
    path = out / name / f"{name}.safetensors"
    path.parent.mkdir(parents=True)
    save_weights(path, TrainedModel(model, create(model), {}, metadata))
    rows = [{"step": 4, "loss": 1.0, "images_per_second": 80.0, "waiting_share": 0.02, "seconds": 2700.0},
            {"step": 4, "val_normal_mae": 11.5}, {"step": 8, "val_normal_mae": 12.3456}]  # fmt: skip
    (path.parent / "metrics.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    (path.parent / "training.yaml").write_text(to_yaml({"model": model, "training": config}))
    return path


def front_matter(text: str) -> dict:
    return yaml.safe_load(text.split("---\n")[1])


def test_the_card_tells_what_the_files_tell(tmp_path: Path, data: Path) -> None:
    card = tmp_path / "MODEL_CARD.md"
    write_model_card(card, write_run(tmp_path, data), data)
    text = card.read_text()
    for fact in ("2,210,048", "B1", "the true ones", "1.50", "80", "2.0%", "abc123", file_hash(data / MANIFEST),
                 "train 2, val 1", "sphere", "`augmentation.intensity_range` | 0.2, 2", "`learning_rate` | 0.0005",
                 "| normal_mae | 12.35 | degrees | mean angle between estimated and true normals",
                 "11.5 at step 4", "x right, y up, z to the camera", "sdps.estimate(images, mask"):  # fmt: skip
        assert fact in text, fact
    assert str(tmp_path) not in text  # no paths of this machine
    assert str(data) not in text
    head = front_matter(text)
    assert head["tags"][-1] == "nenet"
    metrics = head["model-index"][0]["results"][0]["metrics"]
    assert {"type": "normal_mae", "value": 12.3456} in metrics


@pytest.mark.parametrize(
    "values", [{"step": "x"}, {"computed": [1]}, {"metrics": {"val_loss": []}}, {"scenes": "many"}]
)
def test_a_card_of_weights_with_nonsense_in_them_is_refused(values: dict, tmp_path: Path) -> None:
    path = write_run(tmp_path, None)
    model = load_weights(path)
    save_weights(path, replace(model, metadata=model.metadata | values))
    with pytest.raises(InputError, match=r"own\.safetensors: damaged or not weights with the settings"):
        render_card(path)


def test_validation_tells_how_many_images_it_had(tmp_path: Path) -> None:
    alike = render_card(write_run(tmp_path / "alike", None, config=replace(CONFIG, images=12)))
    other = render_card(write_run(tmp_path / "other", None, config=replace(CONFIG, images=12, validation_images=8)))
    assert "does not see, 12 images of each" in alike and "does not see, 8 images of each" in other


def test_errors_of_lights_are_those_of_lights_that_were_found(tmp_path: Path) -> None:
    given = render_card(write_run(tmp_path / "given", None))
    found = render_card(write_run(tmp_path / "found", None, lights="lcnet"))
    assert "direction_mae" not in given and "intensity_error" not in given
    assert "| direction_mae | 5.5 | degrees" in found and "| intensity_error | 0.125 |" in found
    shipped = (pretrained.shipped_folder() / "psfcn.md").read_text()
    assert "direction_mae" not in shipped and "intensity_error" not in shipped and "normal_mae" in shipped


def test_its_preset_repeats_the_run(tmp_path: Path, data: Path) -> None:
    text = render_card(write_run(tmp_path, data), data)
    block = re.search(r"```yaml\n(.*?)```", text, re.DOTALL).group(1)
    (tmp_path / "repeat.yaml").write_text(block)
    preset = presets.load(str(tmp_path / "repeat.yaml"))
    assert preset.train == ("own",)
    run = preset.run("own")
    assert (run.model, run.config) == ("nenet", CONFIG)


def test_the_whole_preset_is_told_where_it_is_known(tmp_path: Path, data: Path) -> None:
    weights = write_run(tmp_path, data)
    preset = presets.load("smoke", ["runs.first={base: psfcn}", "runs.own={base: nenet, start: first}"])
    presets.save_resolved(preset, weights.parent)
    block = re.search(r"```yaml\n(.*?)```", render_card(weights, data), re.DOTALL).group(1)
    (tmp_path / "repeat.yaml").write_text(block)
    again = presets.load(str(tmp_path / "repeat.yaml"))
    assert again.train == ("own",) and again.data == preset.data
    assert in_order(again, ["own"]) == in_order(preset, ["own"])
    assert sorted(in_order(again, ["own"])) == ["first", "lcnet", "own"]


def test_its_snippet_loads_the_weights(tmp_path: Path, data: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    weights = write_run(tmp_path, data)
    snippet = re.search(r"```python\n(.*?)```", render_card(weights), re.DOTALL).group(1)
    monkeypatch.chdir(weights.parent)
    normals, mask = sphere_normals(24)
    lights = hemisphere_lights(4, np.random.default_rng(0))
    names = {"images": shade(normals, lights), "mask": mask, "lights": lights, "intensities": np.ones(4)}
    exec(snippet, names)
    np.testing.assert_allclose(names["estimate"].light_directions, lights, atol=1e-6)  # of its last line


def test_what_is_not_known_is_not_recorded(tmp_path: Path) -> None:
    weights = write_run(tmp_path, None)
    (weights.parent / "metrics.jsonl").unlink()
    (weights.parent / "training.yaml").unlink()
    model = load_weights(weights)
    bare = {"config": model.metadata["config"]}
    save_weights(weights, TrainedModel(model.name, model.network, {}, bare))
    text = render_card(weights)
    for row in ("optimiser steps", "hours", "images per second", "SHA-256 of the manifest", "composition"):
        assert f"| {row} | {UNKNOWN}" in text, row
    assert "no validation scenes" in text
    assert "model-index" not in front_matter(text)


def test_another_manifest_is_told(tmp_path: Path, data: Path) -> None:
    assert "another manifest now" in render_card(write_run(tmp_path, None), data)


def test_terms_come_from_the_data_card(tmp_path: Path, data: Path) -> None:
    weights = write_run(tmp_path, data)
    assert "Terms of the materials and shapes: not recorded" in render_card(weights, data)
    (data / "DATASET_CARD.md").write_text("# Data\n\n## Licences\n\nchrome: research use.\n\n## Known limits\n\nmany\n")
    text = render_card(weights, data)
    assert "chrome: research use." in text
    assert "many" not in text


def test_licences(tmp_path: Path, data: Path) -> None:
    weights = write_run(tmp_path, data)
    text = render_card(weights, data)
    assert front_matter(text)["license_name"] == "terms-of-the-training-data"
    assert "as the terms of the training data's materials allow; those fitted to MERL: research use" in text
    text = render_card(weights, data, shipped=weights)
    assert {"license": "other", "license_name": "research-use", "license_link": "LICENSE-DATA"}.items() <= front_matter(
        text
    ).items()
    assert "research use only (`LICENSE-DATA`)" in text and "MIT (`LICENSE`)" in text


def test_pretrained_weights_say_the_same() -> None:
    """Their cards were not all written by the template as it is now."""
    cards = sorted(path for path in pretrained.shipped_folder().glob("*.md") if path.stem != "RESULTS")
    assert len(cards) == len(pretrained.list_shipped())
    for card in cards:
        text = card.read_text()
        assert front_matter(text)["license_name"] == "research-use" and "research use only (`LICENSE-DATA`)" in text


def test_names_break_no_table(tmp_path: Path) -> None:
    config = replace(CONFIG, lights="<b>&|", start="x|y")
    text = render_card(write_run(tmp_path, None, name="a|b", config=config))
    assert r"| `lights` | &lt;b&gt;&amp;\| |" in text and r"| `start` | x\|y |" in text


@pytest.mark.parametrize(
    ("model", "fact"),
    [
        ("lcnet-reg", "this project decided: heads and loss"),
        ("upsfcn", "does not apply"),
        ("nenet-norm", "pixel's norm"),
        ("frames", "exchange what they show 4 times"),
        ("frames-any", "Nothing is assumed of the light but that it differs"),
        ("frames-any", "a fixed camera, light that differs between the images"),
        ("nenet-norm", "Not among them: near lights, perspective, ambient light, the optics of real cameras, several"),
        ("frames", "Not among them: ambient light, the optics of real cameras, several lights at once."),
    ],
)
def test_models_differ(tmp_path: Path, model: str, fact: str) -> None:
    config = LightingTraining() if model.startswith("lcnet") else CONFIG
    weights = write_run(tmp_path, None, model=model, config=config)
    trained = load_weights(weights)
    metadata = {key: value for key, value in trained.metadata.items() if key != "lights"}
    save_weights(weights, TrainedModel(model, trained.network, {}, metadata))
    assert fact in render_card(weights)


def test_foreign_weights_are_refused(tmp_path: Path) -> None:
    (tmp_path / "own.safetensors").write_bytes(b"nothing")
    with pytest.raises(InputError, match="damaged or not a safetensors file"):
        write_model_card(tmp_path / "MODEL_CARD.md", tmp_path / "own.safetensors")
    assert not (tmp_path / "MODEL_CARD.md").exists()
