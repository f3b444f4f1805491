"""Settings of a run: schedules, refusals, and what a run takes of others."""

from pathlib import Path

import numpy as np
import pytest
import torch

from render.shared.config import build
from render.shared.errors import InputError
from sdps.models.checkpoint import TrainedModel
from sdps.models.registry import create
from sdps.training import recipes
from sdps.training.stage_factory import create_stage
from sdps.training.training_config import LightingTraining, NormalTraining


def test_schedules_of_the_paper() -> None:
    lighting = LightingTraining()
    assert (lighting.epochs, lighting.batch_scenes, lighting.images, lighting.learning_rate) == (20, 32, 32, 5e-4)
    rates = [lighting.learning_rate_at(epoch / 20) for epoch in (0, 4.9, 5, 10, 15, 19.9)]
    np.testing.assert_allclose(rates, [5e-4, 5e-4, 2.5e-4, 1.25e-4, 6.25e-5, 6.25e-5])
    normal = NormalTraining()
    assert (normal.epochs, normal.batch_scenes, normal.learning_rate_at(0.79)) == (10, 16, 5e-4 / 8)
    warm = LightingTraining(schedule="cosine", warmup=0.1)
    assert warm.learning_rate_at(0.05) == pytest.approx(2.5e-4)
    assert warm.learning_rate_at(0.55) == pytest.approx(2.5e-4)
    assert warm.learning_rate_at(1.2) == pytest.approx(0.0)
    decaying = LightingTraining(schedule="trapezoid", cooldown=0.2, warmup=0.1)
    rates = [decaying.learning_rate_at(progress) for progress in (0.05, 0.5, 0.79, 0.9, 1.0)]
    np.testing.assert_allclose(rates, [2.5e-4, 5e-4, 5e-4, 2.5e-4, 0.0], atol=1e-12)
    assert decaying == LightingTraining(schedule="warmup-stable-decay", cooldown=0.2, warmup=0.1), "an earlier name"


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"steps": 0}, "steps must be positive"),
        ({"steps": 5, "minutes": 1.0}, "both set"),
        ({"accumulate": 3}, "must divide"),
        ({"epochs": 12.0}, "halve_after"),
        ({"start_share": 0.5}, "there is no start"),
        ({"start": "other", "start_share": 1.0}, r"start_share must be in \[0, 1\)"),
        ({"size": 96}, "must be 128 for LCNet, .* or 64 for a run that others start from"),
        ({"learnin_rate": 1.0}, "did you mean 'training.learning_rate'"),
        ({"augmentation": {"noise": 2.0}}, "noise"),
    ],
)
def test_configuration_is_checked(values: dict, message: str) -> None:
    with pytest.raises(InputError, match=message):
        build(LightingTraining, values, "training")


def test_a_run_takes_start_and_lights_of_others(tmp_path: Path) -> None:
    settings = {"runs": {"psfcn-late": {"base": "psfcn", "start": "nenet", "steps": 1}}}
    run = recipes.run("psfcn-late", {}, settings["runs"])
    assert run.requires == {"start": "nenet"}
    first = TrainedModel("nenet", create("nenet"), {}, {"config": {"augmentation": {}}})
    stage = create_stage("psfcn-late", run.model, run.config, {"start": first})
    pairs = zip(stage.network.state_dict().values(), first.network.state_dict().values(), strict=True)
    assert all(torch.equal(*pair) for pair in pairs)
    other = TrainedModel("upsfcn", create("upsfcn"), {}, {"config": {"augmentation": {}}})
    with pytest.raises(InputError, match=r"runs.psfcn-late.start: 'upsfcn' has another network"):
        create_stage("psfcn-late", run.model, run.config, {"start": other})
    begun = recipes.run("frames", {}, {"frames": {"start": "nenet"}})
    with pytest.raises(InputError, match=r"runs.frames.start: 'nenet' has another network"):
        create_stage("frames", begun.model, begun.config, {"start": first})
    run = recipes.run("nenet", {}, {"nenet": {"lights": "shipped:psfcn"}})
    with pytest.raises(InputError, match=r"runs.nenet.lights: 'upsfcn' finds no lights; name a lighting model"):
        create_stage("nenet", "nenet", run.config, {"lighting": other})
