"""Every model learns a handful of scenes by heart: proof that its inputs, loss and gradients are wired up.

Bounds lie at twice what is reached on any seed, and far below what a network reaches that does not see what it should:
a plate that faces the camera is 40 degrees off these spheres, a light at the camera 50 off these lights.
"""

from pathlib import Path

import pytest
import torch
from sdps_scenes import errors, write_data

from render.shared.config import build
from sdps.models.lcnet import EARLY_SIZE, INPUT_SIZE
from sdps.models.registry import MODELS, entry
from sdps.training import recipes
from sdps.training.stage_factory import create_stage
from sdps.training.stages import LightingStage, Stage
from sdps.training.trainer import train
from sdps.training.training_config import LightingTraining

COMMON = {
    "schedule": "cosine", "warmup": 0.05, "optimiser": "adamw", "workers": 0, "validation_scenes": 0,
    "augmentation": {"noise": 0.02}, "log_every": 1000,
}  # fmt: skip
LIGHTING = {"batch_scenes": 3, "images": 6, "learning_rate": 1e-3, "clip_gradient": 5.0}
NORMALS = {"batch_scenes": 3, "images": 6, "size": 16, "crop": 0, "learning_rate": 2e-3, "clip_gradient": 1.0}
STEPS = {"lighting": 300, "normals": 600, "pixels": 900}
QUICK = {"nenet": 150}  # in fewer steps; the rest waits for `make test-slow`
LEARNED = 6.0  # degrees; quick ones reach 1.6 to 2.7


def stage_of(name: str, role: str) -> Stage:
    """Return the stage that trains a model on true lights where it is given lights, in few steps."""
    settings = COMMON | (LIGHTING if role == "lighting" else NORMALS) | {"steps": QUICK.get(name, STEPS[role])}
    if role == "pixels":
        # All lights at every step: with random subsets of them the observation maps of a pixel never repeat.
        settings |= {
            "images": 24,
            "min_lights": 24,
            "clip_gradient": 0.0,
            "learning_rate": 1e-3,
            "pixels_per_scene": 64,
        }
    if role in ("normals", "pixels") and entry(name).lights:
        settings["lights"] = "true"
    run = recipes.run(name, {}, {name: settings})
    return create_stage(name, name, run.config, {})


CASES = [
    pytest.param(name, item.role, marks=[] if name in QUICK else [pytest.mark.slow]) for name, item in MODELS.items()
]


@pytest.mark.parametrize(("name", "role"), CASES)
def test_a_handful_of_scenes_is_learned(name: str, role: str, tmp_path: Path) -> None:
    torch.manual_seed(0)
    lighting = role == "lighting"
    lights = {"pixels": 24}.get(role, 6)
    write_data(tmp_path, ("train",) * 3, lights=lights, size=128 if lighting else 16)
    stage = stage_of(name, role)
    before = errors(stage, tmp_path)
    train(stage, tmp_path, tmp_path / "run")
    after = errors(stage, tmp_path)
    if lighting:
        assert before["direction_mae_expectation"] > 15.0
        assert after["direction_mae_expectation"] < LEARNED, after
    else:
        assert before["normal_mae"] > 20.0
        assert after["normal_mae"] < LEARNED, after


def overfit_lcnet(folder: Path, steps: int, size: int) -> tuple[dict[str, float], dict[str, float]]:
    """Return the metrics before and after training on three scenes of six lights."""
    write_data(folder, ("train",) * 3, lights=6, size=size)
    stage = LightingStage(build(LightingTraining, COMMON | LIGHTING | {"steps": steps, "size": size}))
    before = errors(stage, folder)
    train(stage, folder, folder / "run")
    return before, errors(stage, folder)


def test_lcnet_learns_the_light_directions_of_a_few_scenes(tmp_path: Path) -> None:
    before, after = overfit_lcnet(tmp_path, 100, EARLY_SIZE)
    assert before["direction_mae"] > 20.0
    assert after["direction_mae"] < LEARNED, after


@pytest.mark.slow
def test_lcnet_learns_the_light_intensities_of_a_few_scenes(tmp_path: Path) -> None:
    # Intensities are drawn again on every access, so these are learned rather than remembered, which takes longer.
    before, after = overfit_lcnet(tmp_path, 600, INPUT_SIZE)
    assert before["intensity_error"] > 0.25
    assert after["intensity_error"] < 0.15
    assert after["direction_mae"] < 3.0
