"""Training on mixed light: how many images a step sees, and both networks through their recipes."""

from pathlib import Path

import pytest
import torch
from any_light_weights import SMALL
from sdps_samples import distant_layout
from sdps_scenes import write_data

from pipelines.shared import presets
from sdps.data.dataset import Batch
from sdps.models.checkpoint import load_weights
from sdps.models.registry import COMBINATIONS
from sdps.training import recipes
from sdps.training.stage_factory import create_stage
from sdps.training.trainer import train

MIXED = {"noise": 0.0, "mixed": {"sparse": True, "single": 0.3, "surrounded": 0.3, "steady": 0.5}}
SHORT = {"steps": 2, "batch_scenes": 2, "images": 5, "fewest_images": 3, "size": 64, "workers": 0, "log_every": 1,
         "cache": False, "augmentation": MIXED}  # fmt: skip


def batch(seed: int) -> Batch:
    images = torch.rand(1, 8, 3, 16, 16)
    corner = torch.zeros(1, 2, dtype=torch.int64)
    return Batch(images, torch.ones(1, 1, 16, 16), images[:, 0], torch.zeros(1, 8, 3), torch.ones(1, 8), corner,
                 torch.tensor([seed]), **distant_layout(images))  # fmt: skip


@pytest.mark.parametrize("name", ["lightset-any", "frames-any"])
def test_each_step_draws_its_number_of_images(name: str) -> None:
    run = recipes.run(name, {}, {name: SHORT | {"lights": "true"} if name == "frames-any" else SHORT})
    stage, drawn = create_stage(name, run.model, run.config, {}), set()
    for seed in range(60):
        fewer = stage.draw_count(batch(seed))
        drawn.add(fewer.images.shape[1])
        assert {part.shape[1] for part in (fewer.directions, fewer.intensities, fewer.nearness)} == {
            fewer.images.shape[1]
        }
    assert drawn == {3, 4, 5, 6, 7, 8}


def test_the_preset_trains_both_networks_on_mixtures_of_any_lights() -> None:
    preset = presets.load("anylight")
    assert tuple(preset.train) == COMBINATIONS["anylight"].members()
    runs = [preset.run(name) for name in preset.train]
    assert all(run.config.augmentation.mixed.sparse and run.config.fewest_images for run in runs)
    assert runs[1].requires["lighting"] == "lightset-any"


def test_training_through_the_recipes(tmp_path: Path) -> None:
    write_data(tmp_path / "data", ("train", "train", "val"), lights=6, size=64)
    small = {name: {"options": options} for name, options in SMALL.items()}
    trained = {}
    for name, settings in small.items():
        run = recipes.run(name, {}, {name: SHORT | settings})
        stage = create_stage(name, run.model, run.config, trained)
        result = train(stage, tmp_path / "data", tmp_path / name, device="cpu")
        goal = f"val_{stage.goal}"
        assert result.steps == 2 and {goal, f"{goal}_single"} <= result.metrics.keys()
        trained["lighting"] = load_weights(result.weights[name])
        assert trained["lighting"].name == name
    assert run.requires == {"lighting": "lightset-any"}
