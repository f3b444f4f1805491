"""How fast a run trains on this machine, from a few timed steps."""

import time

import torch
from torch.nn import functional

from sdps.core.precision import arithmetic
from sdps.data.dataset import Batch
from sdps.models import registry
from sdps.models.checkpoint import TrainedModel
from sdps.training.recipes import Run
from sdps.training.stage_factory import create_stage

_TIMED_STEPS = 3
_NETWORKS_SHARE = 0.75
"""Of a step's time; loading, augmentation and the optimiser take the rest."""


def images_per_second(run: Run, device: torch.device) -> float:
    """Time forward and backward passes of a run's stage on made-up images.

    Returns:
        Images a second, with an allowance for loading and the optimiser.
    """
    config = run.config
    trained = {
        use: TrainedModel(model, registry.create(model), {}, {})
        for use, model in run.requires.items()
        if use != "start"
    }
    stage = create_stage(run.name, run.model, config, trained)
    stage.to(device)
    scenes, images, side = config.batch_scenes, config.images, config.size
    vectors = functional.normalize(torch.ones(scenes, 3, side, side), dim=1)
    batch = Batch(
        torch.rand(scenes, images, 3, side, side), torch.ones(scenes, 1, side, side), vectors,
        functional.normalize(torch.rand(scenes, images, 3) + 0.1, dim=-1), torch.ones(scenes, images),
        torch.zeros(scenes, 2, dtype=torch.int64), torch.arange(scenes), torch.zeros(scenes, images), vectors, vectors,
        torch.zeros(scenes, images, 3, 3),
    ).to(device)  # fmt: skip
    least = float("inf")
    for _ in range(_TIMED_STEPS):
        began = time.perf_counter()
        with arithmetic(config.precision, device).autocast():
            loss, _ = stage.loss(batch)
        loss.backward()
        float(loss.detach())  # waits for a GPU
        least = min(least, time.perf_counter() - began)
    return _NETWORKS_SHARE * scenes * images / least
