"""The stage that trains a run, by the role of its model."""

from collections.abc import Mapping
from typing import cast

from torch import nn

from render.shared.errors import InputError
from sdps.models import registry
from sdps.models.checkpoint import TrainedModel
from sdps.training.pixel_stage import PixelStage
from sdps.training.stages import LightingStage, NormalStage, Stage
from sdps.training.training_config import LightingTraining, NormalTraining, TrainingConfig

_ANOTHER = "runs.{}.start: {!r} has another network; name one of its kind"


def create_stage(name: str, model: str, config: TrainingConfig, trained: Mapping[str, TrainedModel]) -> Stage:
    """Return the stage that trains a run.

    Args:
        name: Name of the run.
        model: Name in the registry.
        config: The run's configuration, of the model's role.
        trained: The models it needs, by what they are for: `lighting`, and `start` for the weights that training
            starts from.

    Raises:
        InputError: a start of another network, or lights of a model that finds none.
    """
    stage = _stage(name, model, config, trained)
    if "start" in trained:
        first = trained["start"]
        try:
            stage.added = _take_weights(stage.network, first.network)
        except RuntimeError as error:
            raise InputError(_ANOTHER.format(name, first.name)) from error
    return stage


def _take_weights(network: nn.Module, first: nn.Module) -> frozenset[str]:
    """Copy the weights of a network into one of its kind; return the names of those that it lacks.

    Raises:
        RuntimeError: sizes differ, or parts are missing.
    """
    added = getattr(network, "added", ())  # earlier kinds lack these: they stay random
    loaded = network.load_state_dict(first.state_dict(), strict=False)
    if loaded.unexpected_keys or any(key.partition(".")[0] not in added for key in loaded.missing_keys):
        raise RuntimeError(f"missing {loaded.missing_keys}, not known {loaded.unexpected_keys}")
    return frozenset(loaded.missing_keys)


def _stage(name: str, model: str, config: TrainingConfig, trained: Mapping[str, TrainedModel]) -> Stage:
    """Return the stage with random weights."""
    role = registry.entry(model).role
    if role == "lighting":
        return LightingStage(cast(LightingTraining, config), model=model, name=name)
    lighting = trained.get("lighting")
    if lighting is not None and lighting.role != "lighting":
        raise InputError(f"runs.{name}.lights: {lighting.name!r} finds no lights; name a lighting model, or `true`")
    kind = PixelStage if role == "pixels" else NormalStage
    return kind(cast(NormalTraining, config), lighting, model=model, name=name)
