"""Whether a normal network does better on scenes that it learned from than on others: what more scenes could bring.

    python -m lab.studies.seen_and_unseen DATA --preset anylight --run frames-any
    python -m lab.studies.seen_and_unseen DATA --preset anylight --run frames-any --models OUT

Scenes of splits `train` and `val` of the data folder that the run learned from, measured as training validates.
"""

import argparse
import sys
from collections.abc import Sequence
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import cast

import numpy as np
import torch

from pipelines.shared import presets
from pipelines.shared.text_tables import render_text
from render.shared.seeds import generator, spread_evenly
from sdps.core.precision import arithmetic
from sdps.data.dataset import Batch, SampleOptions, make_sample
from sdps.data.scene_store import SceneStore, list_finished
from sdps.methods import pretrained
from sdps.models.checkpoint import load_weights
from sdps.training.stage_factory import create_stage
from sdps.training.stages import Stage
from sdps.training.training_config import NormalTraining


def build_stage(preset: str, run: str, models: Path | None) -> Stage:
    """Return the stage of a run, with its trained weights."""
    found, find = presets.load(preset).run(run), pretrained.finder(models)
    weights = load_weights(find(run))
    config = replace(cast(NormalTraining, found.config), start=run, options=weights.options)
    trained = {use: load_weights(find(name)) for use, name in found.requires.items() if use != "start"}
    stage = create_stage(run, found.model, config, trained | {"start": weights})
    stage.to(torch.device("cpu"))
    stage.network.eval()
    return stage


def measure(stage: Stage, data: Path, split: str, count: int, options: SampleOptions) -> np.ndarray:
    """Return the errors of so many scenes (N,), in degrees."""
    store, errors = SceneStore(data, cache=False), []
    half = arithmetic(stage.config.precision, torch.device("cpu"))
    for scene in spread_evenly(list_finished(data, split, skip_missing=True), count):
        sample = make_sample(scene, store.load(scene), options, generator(0, "seen and unseen", scene.id))
        with torch.no_grad(), half.autocast():
            errors.append(stage.metrics(Batch(*(part[None] for part in sample)))[stage.goal])
    return np.array(errors)


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("data", type=Path)
    parser.add_argument("--preset", default="anylight")
    parser.add_argument("--run", default="frames-any")
    parser.add_argument("--models", type=Path, default=None, help="folder of trained runs (default: shipped weights)")
    parser.add_argument("--scenes", type=int, default=40)
    args = parser.parse_args(arguments)
    stage, lines = build_stage(args.preset, args.run, args.models), []
    for split, (suffix, options) in product(("train", "val"), stage.validations().items()):
        errors = measure(stage, args.data, split, args.scenes, options)
        unsure = errors.std() / len(errors) ** 0.5
        lines.append([split, suffix.strip("_") or "all", str(len(errors)), f"{errors.mean():.2f}", f"{unsure:.2f}"])
    sys.stdout.write(render_text("Mean error, degrees", ["scenes of", "light", "number", "error", "+-"], lines))
    return 0


if __name__ == "__main__":
    sys.exit(main())
