"""Whether a normal network does better on scenes that it learned from than on others: what more scenes could bring.

    python -m lab.studies.seen_and_unseen DATA --preset anylight --run frames-any
    python -m lab.studies.seen_and_unseen DATA --preset anylight --run frames-any --models OUT

Scenes of splits `train` and `val` of the data folder that the run learned from, measured as training validates.
"""

import argparse
import sys
from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch

from pipelines.shared import presets
from pipelines.shared.text_tables import render_text
from render.shared.seeds import spread_evenly
from sdps.core.precision import arithmetic
from sdps.data.dataset import Batch, SampleKey, SampleOptions, SceneDataset, collate
from sdps.methods import pretrained
from sdps.models.checkpoint import load_weights
from sdps.training.stage_factory import create_stage
from sdps.training.stages import Stage
from sdps.training.training_config import NormalTraining


def build_stage(preset: str, run: str, models: Path | None, **options: Any) -> Stage:
    """Return the stage of a run of a normal network, with its trained weights; `options` change the network's."""
    found, find = presets.load(preset).run(run), pretrained.finder(models)
    weights = load_weights(find(run))
    config = replace(cast(NormalTraining, found.config), start=run, options=weights.options | options)
    trained = {use: load_weights(find(name)) for use, name in found.requires.items() if use != "start"}
    stage = create_stage(run, found.model, config, trained | {"start": weights})
    stage.to(torch.device("cpu"))
    return stage


def read_scenes(data: Path, split: str, count: int, options: SampleOptions) -> Iterator[Batch]:
    """Yield a batch of each of so many scenes of a split, evenly spread."""
    scenes = SceneDataset(data, split, options, cache=False, skip_missing=True)
    for index in spread_evenly(range(len(scenes)), count):
        yield cast(Batch, collate([scenes.sample(SampleKey(index, 0, index))]))  # `sample` raises


def measure(stage: Stage, data: Path, split: str, count: int, options: SampleOptions) -> np.ndarray:
    """Return the errors of so many scenes (N,), in degrees."""
    with torch.no_grad(), arithmetic(stage.config.precision, torch.device("cpu")).autocast():
        return np.array([stage.metrics(batch)[stage.goal] for batch in read_scenes(data, split, count, options)])


def read_arguments(arguments: Sequence[str] | None, about: str | None, scenes: int) -> argparse.Namespace:
    """Return the arguments of a study of a run that is about this (its docstring) and takes so many scenes."""
    parser = argparse.ArgumentParser(description=about.splitlines()[0] if about else None)
    parser.add_argument("data", type=Path)
    parser.add_argument("--preset", default="anylight")
    parser.add_argument("--run", default="frames-any")
    parser.add_argument("--models", type=Path, default=None, help="folder of trained runs (default: shipped weights)")
    parser.add_argument("--scenes", type=int, default=scenes)
    return parser.parse_args(arguments)


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure, and print the table."""
    args = read_arguments(arguments, __doc__, 40)
    stage, lines = build_stage(args.preset, args.run, args.models), []
    stage.network.eval()
    for split, (suffix, options) in product(("train", "val"), stage.validations().items()):
        errors = measure(stage, args.data, split, args.scenes, options)
        unsure = errors.std() / len(errors) ** 0.5
        lines.append([split, suffix.strip("_") or "all", str(len(errors)), f"{errors.mean():.2f}", f"{unsure:.2f}"])
    sys.stdout.write(render_text("Mean error, degrees", ["scenes of", "light", "number", "error", "+-"], lines))
    return 0


if __name__ == "__main__":
    sys.exit(main())
