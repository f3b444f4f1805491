"""`sdps train`: the models named, each after those whose lights or normals it is trained on."""

import argparse
import logging
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from pipelines.shared import presets
from pipelines.shared.flags import add_cache_argument
from pipelines.shared.presets import Preset
from pipelines.train.stored_runs import StoredRuns, data_folder
from render.shared.config import to_yaml
from render.shared.errors import InputError
from render.shared.files import write_text

if TYPE_CHECKING:
    from sdps.models.checkpoint import TrainedModel
    from sdps.training.distributed import Team
    from sdps.training.trainer import TrainingResult


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the flags of `sdps train`."""
    presets.add_common_arguments(parser)
    parser.add_argument("--models", default=None, metavar="NAME,...",
                        help="models, combinations or runs of the preset (default: the preset's)")  # fmt: skip
    parser.add_argument("--data", default=None, help="data folder (default: <out>/data)")
    parser.add_argument("--stream", action="store_true", help="render the planned scenes while training; store none")
    parser.add_argument("--tensorboard", action="store_true", help="also write TensorBoard logs")
    add_cache_argument(parser)


def main(args: argparse.Namespace) -> int:
    """Train what is asked for, resuming what is there; exit code 130 when stopped by a signal."""
    from sdps.methods.pretrained import MODELS_FOLDER, is_run
    from sdps.training import recipes
    from sdps.training.distributed import team

    logging.basicConfig(level=logging.WARNING, format="%(message)s")
    preset, out = presets.from_arguments(args)
    wanted = args.models.split(",") if args.models else list(preset.train)
    data = Path(args.data) if args.data else out / "data"
    with team() as here, data_folder(data, args.cache_gb, here) as folder:
        runs = StoredRuns(out, MODELS_FOLDER, here)
        for name in in_order(preset, recipes.expand(wanted, preset.runs)):
            runs.fetch([name, *filter(is_run, preset.run(name).requires.values())])
            result = train_run(preset, name, folder, runs, here, args)
            if result.weights is None:
                return 130
            if here.leads:
                sys.stdout.write(runs.shown(describe(name, result)))
    return 0


def in_order(preset: Preset, names: list[str]) -> list[str]:
    """Return the runs named and those they need, each after what it needs.

    Raises:
        InputError: runs that need each other, or weights that are not there and that no run makes.
    """
    from sdps.methods.pretrained import is_run, require

    ordered: list[str] = []

    def visit(name: str, above: tuple[str, ...]) -> None:
        if name in above:
            raise InputError(f"runs.{name}: needs itself (by way of {', '.join(above)}); change its lights")
        for needed in preset.run(name).requires.values():
            if is_run(needed):
                visit(needed, (*above, name))
            else:
                require(needed)  # said before hours of training, not after
        if name not in ordered:
            ordered.append(name)

    for name in names:
        visit(name, ())
    return ordered


def train_run(
    preset: Preset, name: str, data: Path, runs: StoredRuns, here: "Team", args: argparse.Namespace
) -> "TrainingResult":
    """Train one run into its folder, and describe it there with curves and a model card."""
    from sdps.methods.pretrained import MODELS_FOLDER
    from sdps.training.stage_factory import create_stage
    from sdps.training.trainer import train

    run, out = preset.run(name), runs.folder
    trained = {use: load_required(out, needed) for use, needed in run.requires.items()}
    stage = create_stage(name, run.model, run.config, trained)
    folder = out / MODELS_FOLDER / name
    source = None
    if args.stream:
        from pipelines.train.streaming import open_stream

        source = open_stream(preset, data, stage, here, preset.stream)
    result = train(stage, data, folder, source=source, tensorboard=args.tensorboard, on_save=lambda: runs.send(name))
    if here.leads:
        presets.save_resolved(preset, folder)
        write_text(folder / "training.yaml", to_yaml({"model": run.model, "training": run.config}))
        if result.weights is not None:
            document(folder, data, result.weights[name])
        runs.send(name, wait=True)
    return result


def document(folder: Path, data: Path, weights: Path) -> None:
    """Write the learning curves and the model card of a finished run."""
    from sdps.publishing.learning_curves import write_curves
    from sdps.publishing.model_card import write_model_card
    from sdps.training.trainer import METRICS

    write_curves(folder / METRICS, folder / "curves.png")
    write_model_card(folder / "MODEL_CARD.md", weights, data)


def load_required(out: Path, name: str) -> "TrainedModel":
    """Load the weights that a run needs: those of another, shipped ones, or a file's."""
    from sdps.methods.pretrained import is_run, require, trained_file
    from sdps.models.checkpoint import load_weights

    return load_weights(trained_file(out, name) if is_run(name) else require(name))


def describe(name: str, result: "TrainingResult") -> str:
    """Say in a line how a run ended."""
    metrics = ", ".join(f"{key[4:]} {value:.3f}" for key, value in result.metrics.items()) or "no validation scenes"
    return (
        f"{name}: {result.steps} steps in {result.seconds / 60:.1f} min, "
        f"{100 * result.waiting_share:.1f} % of it waiting for data; validation: {metrics}; "
        f"{', '.join(str(path) for path in (result.weights or {}).values())}\n"
    )
