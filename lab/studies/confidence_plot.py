"""Compare the errors that a network expects with those it makes, on scenes it has not seen; writes a plot.

    python -m lab.studies.confidence_plot out/mix/data shipped:frames --lights shipped:lightset --out plot.png
    python -m lab.studies.confidence_plot out/mix/data shipped:lightset --out plot.png

Pixels, or images of a lighting network, are sorted by the error that is expected of them and cut into eighths. A
network that knows its errors has its points on the diagonal.
"""

import argparse
import sys
from pathlib import Path
from typing import Any

import numpy as np
import torch
from matplotlib.figure import Figure

from render.shared.errors import InputError
from render.shared.seeds import spread_evenly
from sdps.core.metrics import angle_degrees
from sdps.data.dataset import Batch, SampleKey, SampleOptions, SceneDataset, collate
from sdps.methods.pretrained import require
from sdps.models.base import Lights
from sdps.models.checkpoint import load_weights

_PARTS = 8


@torch.no_grad()
def errors(data: Path, weights: Path, lighting: Path | None, scenes: int, images: int) -> np.ndarray:  # (2, N)
    """Return expected and actual errors in degrees of the object pixels, or the lights, of scenes of split `val`."""
    model = load_weights(weights)
    network = model.network.eval()
    lights = None if lighting is None else load_weights(lighting).network.eval()
    augmentation = model.augmentation()
    dataset = SceneDataset(
        data, "val", SampleOptions(seed=0, images=images, augmentation=augmentation), skip_missing=True
    )
    found = []
    for index in spread_evenly(range(len(dataset)), scenes):
        batch = collate([dataset.sample(SampleKey(index, 0, index))])
        pair = _of_lights(network, batch) if model.role == "lighting" else _of_normals(network, lights, batch)
        if pair is None:
            raise InputError(f"{weights}: tells no error to expect; name weights of `frames` or `lightset`")
        found.append(np.stack(pair))
    return np.concatenate(found, axis=1)


def _of_lights(network: Any, batch: Batch) -> tuple[np.ndarray, np.ndarray] | None:
    """Return expected and actual errors of the lights, (Q,) each; None where the network tells none."""
    found = network.read_lights(network(batch.images, batch.mask))
    if found.expected_error is None:
        return None
    return found.expected_error[0].numpy(), angle_degrees(found.directions[0].numpy(), batch.directions[0].numpy())


def _of_normals(network: Any, lights: Any, batch: Batch) -> tuple[np.ndarray, np.ndarray] | None:
    """Return expected and actual errors of the object's pixels, (P,) each; None where the network tells none."""
    told = Lights(batch.directions, batch.intensities)
    if lights is not None:
        told = lights.read_lights(lights(batch.images, batch.mask), "expectation").with_errors()
    normals, expected = network.regress_with_error(network.encode(network.observe(batch.images, batch.mask, told)))
    if expected is None:
        return None
    inside = batch.mask[0, 0] > 0.5
    pair = [each[0].permute(1, 2, 0)[inside].numpy() for each in (normals, batch.normals)]
    return expected[0, 0][inside].numpy(), angle_degrees(*pair)


def main() -> int:
    """Print the table and write the plot."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path, help="data folder")
    parser.add_argument("weights", help="weights: a file or shipped:NAME")
    parser.add_argument("--lights", help="weights of a lighting model; without it the lights are the true ones")
    parser.add_argument("--scenes", type=int, default=48)
    parser.add_argument("--images", type=int, default=32)
    parser.add_argument("--out", type=Path, required=True, help="PNG to write")
    args = parser.parse_args()
    lighting = None if args.lights is None else require(args.lights)
    try:
        expected, actual = errors(args.data, require(args.weights), lighting, args.scenes, args.images)
    except InputError as error:
        sys.stderr.write(f"confidence_plot: {error}\n")
        return 2
    parts = np.array_split(np.argsort(expected), _PARTS)
    means = np.array([[each[part].mean() for part in parts] for each in (expected, actual)])
    for name, row in zip(("expected", "actual"), means, strict=True):
        sys.stdout.write(f"| {name} | {' | '.join(f'{value:.1f}' for value in row)} |\n")
    correlation = np.corrcoef(np.log(expected + 0.1), np.log(actual + 0.1))[0, 1]
    sys.stdout.write(f"{expected.size} values; correlation of the logarithms {correlation:.2f}\n")
    figure = Figure(figsize=(4.2, 4.0), layout="constrained")
    axes = figure.add_subplot(xlabel="error expected, degrees", ylabel="error made, degrees")
    limit = 1.08 * means.max()
    axes.plot([0.0, limit], [0.0, limit], color="0.7")
    axes.plot(*means, marker="o")
    axes.set(xlim=(0.0, limit), ylim=(0.0, limit))
    args.out.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(args.out, dpi=120)
    return 0


if __name__ == "__main__":
    sys.exit(main())
