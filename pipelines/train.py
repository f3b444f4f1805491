"""`sdps train`: LCNet first, then NENet on the lights the frozen LCNet estimates."""

import argparse
import logging
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from pipelines import presets

if TYPE_CHECKING:
    from sdps.training import TrainingResult

LIGHTING, NORMALS = "lighting", "normals"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the flags of `sdps train`."""
    presets.add_common_arguments(parser)
    parser.add_argument("--data", default=None, help="data folder (default: <out>/data)")
    parser.add_argument("--tensorboard", action="store_true", help="also write TensorBoard logs")


def main(args: argparse.Namespace) -> int:
    """Train both stages, resuming whatever is there; exit code 130 when stopped by a signal."""
    from sdps.checkpoint import load_weights
    from sdps.stages import LightingStage, NormalStage
    from sdps.training import train

    logging.basicConfig(level=logging.WARNING, format="%(message)s")
    preset, out = presets.from_arguments(args)
    data = Path(args.data) if args.data else out / "data"
    first = train(LightingStage(preset.lighting), data, out / LIGHTING, tensorboard=args.tensorboard)
    presets.save_resolved(preset, out / LIGHTING)
    if first.weights is None:
        return 130
    _report("LCNet", first)
    lighting = load_weights(first.weights, "lcnet") if preset.normals.lights == "estimated" else None
    second = train(NormalStage(preset.normals, lighting), data, out / NORMALS, tensorboard=args.tensorboard)
    presets.save_resolved(preset, out / NORMALS)
    if second.weights is None:
        return 130
    _report("NENet", second)
    return 0


def _report(name: str, result: "TrainingResult") -> None:
    """Print how a stage ended."""
    metrics = ", ".join(f"{key[4:]} {value:.3f}" for key, value in result.metrics.items()) or "no validation scenes"
    sys.stdout.write(
        f"{name}: {result.steps} steps in {result.seconds / 60:.1f} min, "
        f"{100 * result.waiting_share:.1f} % of it waiting for data; validation: {metrics}; {result.weights}\n"
    )
