"""Train the network that joins the answers of networks and of refinement, on what `fusion_data` made.

    python -m lab.releases.fusion out/fusion              # train, write out/fusion/fusion.safetensors, print the table
    python -m lab.releases.fusion out/fusion --measure    # print the table of weights that are there

Scenes of the split `val`, whose shapes and materials are in no other scene, are only measured. To release the weights,
copy the file to `assets/fusion.safetensors`.
"""

import argparse
import math
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from safetensors.torch import save_file
from torch import Tensor
from torch.nn import functional

from lab.shared.answered_scenes import Answered, read_all, tabulate
from render.shared.errors import InputError
from render.shared.files import atomic_path
from render.shared.progress import progress_bar
from sdps.core.losses import expected_error_loss, mean_over_object
from sdps.core.symmetry import SYMMETRIES
from sdps.methods.fusion.fuse import load_fusion
from sdps.methods.fusion.network import FusionNet, Inputs, prepare

_BATCH, _RATE, _DECAY, _WARM = 6, 1e-3, 0.05, 0.1
_SIDE = 96
_EXPECTED = 0.05
_FLOOR, _USUAL = 0.035, 0.12  # chords of two and of seven degrees


def train(scenes: Sequence[Answered], epochs: int, width: int, seed: int) -> FusionNet:
    """Return a network that has seen every scene with evidence so many times, turned and cut at random."""
    torch.manual_seed(seed)
    rng, network = np.random.default_rng(seed), FusionNet(width=width)
    given = [(prepare(scene.evidence), _truth(scene)) for scene in scenes if scene.evidence is not None]
    steps = epochs * math.ceil(len(given) / _BATCH)
    adam = torch.optim.AdamW(network.parameters(), lr=_RATE, weight_decay=_DECAY)
    plan = torch.optim.lr_scheduler.OneCycleLR(adam, _RATE, total_steps=steps, pct_start=_WARM)
    parts = (part for _ in range(epochs) for part in np.array_split(rng.permutation(len(given)), steps // epochs))
    with progress_bar(total=steps, desc="fusion") as bar:
        for some in parts:
            inputs, truth = _batch([given[number] for number in some], rng)
            adam.zero_grad(set_to_none=True)
            loss = _loss(network, inputs, truth)
            if not torch.isfinite(loss):
                raise ArithmeticError(f"the loss is {loss.item()} at step {bar.n}; an answer is not finite")
            loss.backward()
            torch.nn.utils.clip_grad_norm_(network.parameters(), 1.0)
            adam.step()
            plan.step()
            bar.update()
    return network.eval()


def _loss(network: FusionNet, inputs: Inputs, truth: Tensor) -> Tensor:
    """Return the error against true normals (B, 3, H, W), plus the loss of the expected error.

    Each scene's error is divided by that of the plain mean, so that an easy scene counts as much as a hard one.
    """
    found, mask = network(inputs), inputs.maps[:, -1:]
    mean = functional.normalize(inputs.network + inputs.refined, dim=1)
    share = _mean_chord(found.normals, truth, mask) / (_mean_chord(mean, truth, mask) + _FLOOR)
    return _USUAL * share.mean() + _EXPECTED * expected_error_loss(found.expected, found.normals, truth, mask)


def _mean_chord(normals: Tensor, truth: Tensor, mask: Tensor) -> Tensor:  # (B,)
    """Return each scene's mean distance between normals (B, 3, H, W) and true ones over its object."""
    return mean_over_object(((normals - truth).square().sum(dim=1, keepdim=True) + 1e-6).sqrt(), mask)


def _truth(scene: Answered) -> Tensor:
    """Return true normals (1, 3, h, w)."""
    return torch.from_numpy(np.ascontiguousarray(scene.truth.transpose(2, 0, 1)))[None]


def _batch(some: list[tuple[Inputs, Tensor]], rng: np.random.Generator) -> tuple[Inputs, Tensor]:
    """Return scenes turned at random, and a window of each."""
    parts: list[list[Tensor]] = []
    for inputs, truth in some:
        height, width = inputs.maps.shape[2:]
        padded = functional.pad(truth, (0, width - truth.shape[3], 0, height - truth.shape[2]))
        symmetry = SYMMETRIES[rng.integers(len(SYMMETRIES))]
        turned = inputs.turn(symmetry)
        both = [*turned[:4], symmetry.vectors(symmetry.images(padded), dim=1)]
        height, width = both[0].shape[2:]
        room = (0, max(_SIDE - width, 0), 0, max(_SIDE - height, 0))
        top, left = (int(rng.integers(max(side - _SIDE, 0) + 1)) for side in (height, width))
        cut = [functional.pad(each, room)[:, :, top : top + _SIDE, left : left + _SIDE] for each in both]
        parts.append([*cut, turned.numbers])
    network, refined, start, rest, truths, numbers = (torch.cat(each) for each in zip(*parts, strict=True))
    return Inputs(network, refined, start, rest, numbers), truths


def group(scenes: Sequence[Answered]) -> dict[str, list[Answered]]:
    """Return what was learned from, and what was held out by the number of images."""
    held_out = [scene for scene in scenes if scene.held_out]
    groups = {"learned from": [scene for scene in scenes if not scene.held_out], "held out": held_out}
    for low, high in ((4, 7), (8, 15), (16, 31), (32, 48)):
        name = f"held out, {low} to {high} images"
        groups[name] = [scene for scene in held_out if low <= scene.images <= high]
    return groups


def main(arguments: Sequence[str] | None = None) -> int:
    """Train and measure."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("--epochs", type=int, default=40)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--measure", action="store_true", help="the weights that are there")
    args = parser.parse_args(arguments)
    scenes = read_all(args.out / "answers")
    if not scenes:
        raise InputError(f"{args.out}: no answers; make them with `python -m lab.releases.fusion_data {args.out}`")
    weights = args.out / "fusion.safetensors"
    if not args.measure:
        network = train([scene for scene in scenes if not scene.held_out], args.epochs, FusionNet.WIDTH, args.seed)
        with atomic_path(weights) as temporary:
            save_file({name: value.half().contiguous() for name, value in network.state_dict().items()}, temporary)
    for line in tabulate(group(scenes), load_fusion(weights)):
        sys.stdout.write(line)
    return 0


if __name__ == "__main__":
    sys.exit(main())
