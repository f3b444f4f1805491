"""Compare the errors that a normal network expects with those it makes, on scenes it has not seen; writes a plot.

    python docs/scripts/confidence_plot.py out/mix/data shipped:frames --lights shipped:lcnet-soft --out plot.png

Pixels are sorted by the error that is expected of them and cut into eighths. A network that knows its errors has its
points on the diagonal.
"""

import argparse
import sys
from pathlib import Path

import numpy as np
import torch
from matplotlib.figure import Figure

from render.shared.errors import InputError
from sdps.core.metrics import angle_degrees
from sdps.data.dataset import SampleKey, SampleOptions, SceneDataset, collate
from sdps.methods.pretrained import require
from sdps.models.base import Lights
from sdps.models.checkpoint import load_weights

_PARTS = 8


@torch.no_grad()
def errors(data: Path, weights: Path, lighting: Path | None, scenes: int, images: int) -> np.ndarray:  # (2, P)
    """Return expected and actual errors in degrees of the object pixels of scenes of split `val`."""
    model = load_weights(weights)
    network = model.network.eval()
    lights = None if lighting is None else load_weights(lighting).network.eval()
    augmentation = model.augmentation()
    dataset = SceneDataset(
        data, "val", SampleOptions(seed=0, images=images, augmentation=augmentation), skip_missing=True
    )
    found = []
    for index in np.linspace(0, len(dataset) - 1, min(scenes, len(dataset))).round().astype(int):
        batch = collate([dataset.sample(SampleKey(int(index), 0, int(index)))])
        told = Lights(batch.directions, batch.intensities)
        if lights is not None:
            told = lights.lights(lights(batch.images, batch.mask), "expectation")
        normals, expected = network.regress_with_error(network.encode(network.observe(batch.images, batch.mask, told)))
        if expected is None:
            raise InputError(f"{weights}: tells no error to expect; name weights of `frames`")
        inside = batch.mask[0, 0] > 0.5
        pair = [each[0].permute(1, 2, 0)[inside].numpy() for each in (normals, batch.normals)]
        found.append(np.stack([expected[0, 0][inside].numpy(), angle_degrees(*pair)]))
    return np.concatenate(found, axis=1)


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
    sys.stdout.write(f"{expected.size} pixels; correlation of the logarithms {correlation:.2f}\n")
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
