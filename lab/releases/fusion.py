"""Train the network that joins the answers of networks and of refinement, on what `fusion_data` made.

    python -m lab.releases.fusion out/fusion              # train, write out/fusion/fusion.safetensors, print the table
    python -m lab.releases.fusion out/fusion --measure    # print the table of weights that are there

Scenes of the split `val`, whose shapes and materials are in no other scene, are only measured. To release the weights,
copy the file to `assets/fusion.safetensors`.
"""

import argparse
import math
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np
import torch
from safetensors.torch import load_file, save_file
from torch import Tensor
from torch.nn import functional
from tqdm import tqdm

from pipelines.shared.text_tables import render_text
from render.shared.errors import InputError
from render.shared.files import atomic_path
from render.shared.imaging.vectors import unit
from sdps.core.losses import expected_error_loss
from sdps.core.metrics import angle_degrees
from sdps.core.symmetry import SYMMETRIES
from sdps.methods.fusion.evidence import Evidence
from sdps.methods.fusion.fuse import join
from sdps.methods.fusion.network import FusionNet, Inputs, prepare

_BATCH, _RATE, _DECAY, _WARM = 6, 1e-3, 0.05, 0.1
_SIDE = 96
_EXPECTED = 0.05
_LOSS = 0.3  # degrees; what counts as losing


@dataclass(frozen=True, kw_only=True, eq=False)
class Answered:
    """A scene that was answered.

    Attributes:
        name: Of the scene.
        evidence: What was found.
        truth: (h, w, 3) normals.
        held_out: It is measured, not learned.
        lights: Degrees by which lights were off at the start and refined.
    """

    name: str
    evidence: Evidence
    truth: np.ndarray
    held_out: bool
    lights: tuple[float, float]


def read(file: Path) -> Answered | None:
    """Read a scene; None of one that refinement says nothing about."""
    with np.load(file) as kept:
        if "truth" not in kept:
            return None
        values = {field.name: kept[field.name] for field in fields(Evidence)}
        evidence = Evidence(**{
            name: value if value.dtype == bool else float(value) if value.ndim == 0 else value.astype(np.float32)
            for name, value in values.items()
        })  # type: ignore[arg-type]  # fmt: skip
        return Answered(
            name=file.stem, evidence=evidence, truth=kept["truth"].astype(np.float32), held_out=bool(kept["held_out"]),
            lights=(float(kept["lights_start"]), float(kept["lights_refined"])),
        )  # fmt: skip


def train(scenes: Sequence[Answered], epochs: int, width: int, seed: int) -> FusionNet:
    """Return a network that has seen every scene so many times, turned and cut at random."""
    torch.manual_seed(seed)
    rng, network = np.random.default_rng(seed), FusionNet(width=width)
    given = [(prepare(scene.evidence), _truth(scene)) for scene in scenes]
    steps = epochs * math.ceil(len(given) / _BATCH)
    adam = torch.optim.AdamW(network.parameters(), lr=_RATE, weight_decay=_DECAY)
    plan = torch.optim.lr_scheduler.OneCycleLR(adam, _RATE, total_steps=steps, pct_start=_WARM)
    bar = tqdm(total=steps, disable=None)
    for _ in range(epochs):
        for some in np.array_split(rng.permutation(len(given)), math.ceil(len(given) / _BATCH)):
            inputs, truth = _batch([given[number] for number in some], rng)
            found, mask = network(inputs), inputs.maps[:, -1:]
            chord = ((found.normals - truth).square().sum(dim=1, keepdim=True) + 1e-6).sqrt() * mask
            loss = (chord.sum(dim=(1, 2, 3)) / mask.sum(dim=(1, 2, 3)).clamp(min=1.0)).mean()
            loss = loss + _EXPECTED * expected_error_loss(found.expected, found.normals, truth, mask)
            adam.zero_grad(set_to_none=True)
            loss.backward()
            torch.nn.utils.clip_grad_norm_(network.parameters(), 1.0)
            adam.step()
            plan.step()
            bar.update()
    return network.eval()


def _truth(scene: Answered) -> Tensor:
    """Return true normals (1, 3, h, w)."""
    return torch.from_numpy(np.ascontiguousarray(scene.truth.transpose(2, 0, 1)))[None]


def _batch(some: list[tuple[Inputs, Tensor]], rng: np.random.Generator) -> tuple[Inputs, Tensor]:
    """Return scenes turned at random, and a window of each."""
    parts: list[list[Tensor]] = []
    for inputs, truth in some:
        padded = functional.pad(
            truth, (0, inputs.maps.shape[3] - truth.shape[3], 0, inputs.maps.shape[2] - truth.shape[2])
        )
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


def tabulate(scenes: Sequence[Answered], network: FusionNet) -> Iterator[str]:
    """Yield the table of means, and what is lost against the network."""
    rows = [(scene, _errors(scene, network)) for scene in tqdm(scenes, disable=None)]
    lines = []
    kinds: dict[str, Callable[[Answered], bool]] = {
        "learned from": lambda scene: not scene.held_out,
        "held out": lambda scene: scene.held_out,
        "held out, at most 7 images": lambda scene: scene.held_out and scene.evidence.images < 8,
        "held out, 8 to 24": lambda scene: scene.held_out and 8 <= scene.evidence.images <= 24,
        "held out, more": lambda scene: scene.held_out and scene.evidence.images > 24,
    }
    for name, belongs in kinds.items():
        some = np.array([errors for scene, errors in rows if belongs(scene)])
        if len(some):
            means = (f"{value:.2f}" for value in some.mean(axis=0))
            lost = [int((some[:, k] > some[:, 0] + _LOSS).sum()) for k in (2, 4)]
            lines.append([name, str(len(some)), *means, *map(str, lost)])
    head = ["scenes", "", "start", "network", "refined", "mean", "fused", "expected", "refined loses", "fused loses"]
    yield render_text("Normals, degrees; losing 0.3 against the start", head, lines)
    for label, belongs in (("held out", kinds["held out"]), ("learned from", kinds["learned from"])):
        lights = np.array([scene.lights for scene, _ in rows if belongs(scene) and not scene.evidence.lit])
        if len(lights):
            yield f"lights, {label}: start {lights[:, 0].mean():.2f}, refined {lights[:, 1].mean():.2f}\n"


def _errors(scene: Answered, network: FusionNet) -> list[float]:
    """Return mean degrees of start, network, refinement, plain mean and fusion, and what fusion expects."""
    evidence = scene.evidence
    mask, truth = evidence.mask, scene.truth[evidence.mask]
    normals, expected = join(evidence, network)
    mean = unit(evidence.network[mask] + evidence.refined[mask])
    tried = (evidence.start[mask], evidence.network[mask], evidence.refined[mask], mean, normals[mask])
    return [*(float(angle_degrees(each, truth).mean()) for each in tried), float(expected[mask].mean())]


def main(arguments: Sequence[str] | None = None) -> int:
    """Train and measure."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("--epochs", type=int, default=40)
    parser.add_argument("--width", type=int, default=32)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--measure", action="store_true", help="the weights that are there")
    args = parser.parse_args(arguments)
    scenes = [scene for file in sorted((args.out / "answers").glob("*.npz")) if (scene := read(file)) is not None]
    if not scenes:
        raise InputError(f"{args.out}: no answers; make them with `python -m lab.releases.fusion_data {args.out}`")
    weights = args.out / "fusion.safetensors"
    if args.measure:
        network = FusionNet(width=args.width).eval()
        network.load_state_dict({name: value.float() for name, value in load_file(weights).items()})
    else:
        network = train([scene for scene in scenes if not scene.held_out], args.epochs, args.width, args.seed)
        with atomic_path(weights) as temporary:
            save_file({name: value.half().contiguous() for name, value in network.state_dict().items()}, temporary)
    for line in tabulate(scenes, network):
        sys.stdout.write(line)
    return 0


if __name__ == "__main__":
    sys.exit(main())
