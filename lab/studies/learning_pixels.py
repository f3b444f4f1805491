"""What a step of `frames-any` costs, and what it teaches, when layers before the fusion learn from every n-th diagonal.

    OMP_NUM_THREADS=1 python -m lab.studies.learning_pixels DATA

A step of preset `anylight`, from the shipped weights, on one batch of training scenes of a data folder. What is taught
is the gradient of those layers: its cosine with that of all pixels, beside that of another batch with it. Only this
thread is timed.
"""

import argparse
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import cast

import torch
from torch import Tensor

from lab.studies.seen_and_unseen import build_stage
from pipelines.shared.text_tables import render_text
from render.shared.seeds import spread_evenly
from sdps.core.precision import arithmetic
from sdps.data.dataset import Batch, SampleKey, SceneDataset, collate
from sdps.training.stages import Stage

_EVERY = (1, 2, 3, 6)
_ROUNDS = 3
_AFTER = ("enter", "smaller", "quarter", "surroundings", "back", "leave")
"""Layers after the fusion."""


def read_batches(data: Path, stage: Stage) -> list[Batch]:
    """Return two batches of training scenes, which share none."""
    scenes = SceneDataset(data, "train", stage.sample_options(), cache=False, skip_missing=True)
    chosen = spread_evenly(range(len(scenes)), 2 * stage.config.batch_scenes)
    batches = [collate([scenes.sample(SampleKey(index, 0, index)) for index in chosen[start::2]]) for start in (0, 1)]
    return [cast(Batch, batch) for batch in batches]  # `sample` raises


def take_step(stage: Stage, batch: Batch) -> tuple[float, Tensor]:
    """Return the seconds of a step but for the optimiser, and the gradient of the layers before the fusion."""
    stage.network.zero_grad()
    began = time.thread_time()
    with arithmetic(stage.config.precision, torch.device("cpu")).autocast():
        loss, _ = stage.loss(batch)
    loss.backward()
    seconds = time.thread_time() - began
    named = stage.network.named_parameters()
    parts = [each.grad for name, each in named if each.grad is not None and name.partition(".")[0] not in _AFTER]
    return seconds, torch.cat([part.flatten() for part in parts])


def compare(one: Tensor, other: Tensor) -> float:
    """Return the cosine of two gradients."""
    return float(torch.nn.functional.cosine_similarity(one, other, dim=0))


def main(arguments: Sequence[str] | None = None) -> int:
    """Take steps, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("data", type=Path)
    parser.add_argument("--rounds", type=int, default=_ROUNDS)
    args = parser.parse_args(arguments)
    stages = {every: build_stage("anylight", "frames-any", None, learn_every=every) for every in _EVERY}
    batch, other = read_batches(args.data, stages[1])
    whole = take_step(stages[1], batch)[1]
    least = dict.fromkeys(_EVERY, float("inf"))
    taught: dict[int, Tensor] = {}
    for _ in range(args.rounds):
        for every, stage in stages.items():
            seconds, taught[every] = take_step(stage, batch)
            least[every] = min(least[every], seconds)
    lines = [[f"1 of {n}", f"{least[n]:.2f}", f"{compare(whole, taught[n]):.3f}"] for n in _EVERY]
    lines.append(["another batch", "", f"{compare(whole, take_step(stages[1], other)[1]):.3f}"])
    sys.stdout.write(render_text("A step", ["diagonals", "seconds", "cosine"], lines))
    return 0


if __name__ == "__main__":
    sys.exit(main())
