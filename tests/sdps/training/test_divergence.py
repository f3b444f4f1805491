"""A run that leaves the numbers: nothing that is not finite reaches a file, and the last good state stays."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from sdps_scenes import write_data

from render.shared.errors import InputError
from sdps.models.checkpoint import TrainedModel, load_state, load_weights, save_weights
from sdps.models.registry import create
from sdps.training.stages import NormalStage
from sdps.training.trainer import train
from sdps.training.training_config import NormalTraining
from sdps.training.training_run import CHECKPOINT

QUICK = NormalTraining(
    steps=6, batch_scenes=2, images=2, size=32, crop=16, lights="true", log_every=1, workers=0, validation_scenes=0,
    checkpoint_minutes=1e-9,
)  # fmt: skip


class Spoil:
    """A logger that spoils the network after a step, as a gradient that overflows does."""

    def __init__(self, stage: NormalStage, step: int) -> None:
        self.stage, self.step = stage, step

    def log(self, step: int, values: dict[str, float]) -> None:
        if step == self.step:
            with torch.no_grad():
                next(self.stage.network.parameters())[0] = float("nan")

    def close(self) -> None:
        pass


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("data")
    write_data(path, ("train",) * 4, lights=4, size=32)
    return path


@pytest.mark.parametrize("step", [1, 4, 6])  # before anything is saved, on the way, and before the weights are written
def test_weights_that_are_not_finite_are_never_written(folder: Path, tmp_path: Path, step: int) -> None:
    stage = NormalStage(QUICK)
    left = f"of step {step - 1}, stays in" if step > 1 else "nothing was saved before"
    with pytest.raises(InputError, match=rf"weights became infinite or NaN at step .*{left}.*lower learning_rate"):
        train(stage, folder, tmp_path, loggers=[Spoil(stage, step)])
    assert not list(tmp_path.glob("*.safetensors")) and not list(tmp_path.glob(".*tmp*"))
    assert (tmp_path / CHECKPOINT).exists() == (step > 1)
    if step > 1:
        state = load_state(tmp_path / CHECKPOINT)
        assert state["step"] == step - 1
        assert all(torch.isfinite(weight).all() for weight in state["network"].values())


def test_a_loss_that_is_not_finite_stops_the_run_and_says_what_is_left(folder: Path, tmp_path: Path) -> None:
    stage = NormalStage(replace(QUICK, checkpoint_minutes=60.0))
    with pytest.raises(InputError, match="the loss became nan at step 3; nothing was saved before; lower"):
        train(stage, folder, tmp_path, loggers=[Spoil(stage, 2)])


def test_weights_that_are_not_finite_are_not_read(tmp_path: Path) -> None:
    from render.shared.config import to_plain
    from sdps.data.augment import Augmentation

    network = create("nenet").eval()
    with torch.no_grad():
        next(network.parameters())[0] = float("inf")
    about = {"config": {"augmentation": to_plain(Augmentation())}}
    save_weights(tmp_path / "a.safetensors", TrainedModel("nenet", network, {}, about))
    with pytest.raises(InputError, match=r"a.safetensors: .* has values that are infinite or NaN; copy or train"):
        load_weights(tmp_path / "a.safetensors")
