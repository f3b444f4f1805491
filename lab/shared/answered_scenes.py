"""Scenes that networks and refinement answered: kept in files, read back, and measured against the truth."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np

from pipelines.shared.text_tables import render_text
from render.shared.errors import InputError
from render.shared.files import atomic_path
from render.shared.imaging.vectors import unit
from sdps.core.geometry import UNKNOWN, Rig
from sdps.core.metrics import angle_degrees
from sdps.inference.inference_config import InferenceConfig
from sdps.methods.fusion.evidence import Evidence, find_place
from sdps.methods.fusion.fuse import join
from sdps.methods.fusion.network import FusionNet
from sdps.methods.parse import parse
from sdps.methods.pretrained import finder
from sdps.methods.runner import Runner
from sdps.refinement.refine import RefineConfig
from sdps.refinement.trust import RefinedEstimate, choose

_LOSS = 0.3  # degrees; what counts as losing
_MOST_HALF = float(np.finfo(np.float16).max)  # the gloss of a black mirror is more
_HEAD = ("scenes", "", "first", "second look", "refined", "mean", "fused", "expected", "refined loses", "fused loses",
         "lights first", "refined")  # fmt: skip


@dataclass(frozen=True, kw_only=True, eq=False)
class Answered:
    """A scene that was answered.

    Attributes:
        name: Of the scene.
        evidence: What is joined; None where refinement says nothing, so that the answer is the network's own.
        truth: (h, w, 3) normals.
        held_out: It is measured, not learned.
        lights: Degrees by which lights were off at the start and in the answer.
        start: (h, w, 3) normals of the network, zero outside the mask.
        told: (h, w) degrees to expect of them.
        images: Their number.
        lit: Light directions were given.
    """

    name: str
    evidence: Evidence | None
    truth: np.ndarray
    held_out: bool
    lights: tuple[float, float]
    start: np.ndarray
    told: np.ndarray
    images: int
    lit: bool


def make_runner(method: str, models: Path | None = None, refining: RefineConfig | None = None) -> Runner:
    """Return a method whose networks see eight turned views; `models`: folder of runs to look in first."""
    find = finder(models)
    return Runner(parse(method, find), find, InferenceConfig(light_views=8, normal_views=8), refining)


def answer(
    runner: Runner, images: np.ndarray, mask: np.ndarray, lights: np.ndarray | None, gains: np.ndarray | None,
    saturation: float = np.inf, rig: Rig = UNKNOWN,
) -> tuple[RefinedEstimate, Evidence | None]:  # fmt: skip
    """Return what a method that ends in `+refine` finds, and the evidence that is joined, None where it is void."""
    found = runner.estimate(images, mask, lights, gains, saturation=saturation, rig=rig)
    assert isinstance(found, RefinedEstimate)
    if found.trust.void:
        return found, None
    found = choose(found.start, found.refined, found.trust._replace(doubt=""))
    return found, runner.ask_again(images, mask, found, lit=lights is not None, rig=rig)


def keep(
    file: Path, answered: tuple[RefinedEstimate, Evidence | None], normals: np.ndarray, directions: np.ndarray, *,
    held_out: bool, lit: bool,
) -> None:  # fmt: skip
    """Write what was found of a scene; of one whose evidence is None, the start that is then the answer.

    Args:
        file: Where.
        answered: Of `answer`.
        normals: (H, W, 3) the truth.
        directions: (L, 3) the true lights.
        held_out: It is to be measured, not learned.
        lit: Light directions were given.
    """
    found, evidence = answered
    start, box = found.start, find_place(np.abs(normals).sum(axis=-1) > 0.0)
    assert start.expected_error is not None  # only such networks are asked
    kept: dict[str, Any] = {
        "held_out": np.asarray(held_out), "truth": normals[box], "start": start.normals[box],
        "told_first": start.expected_error[box], "images": np.asarray(len(directions)), "lit": np.asarray(lit),
    }  # fmt: skip
    if evidence is not None:
        kept |= evidence.arrays()
    for name, lights in (("lights_start", start), ("lights_refined", found)):
        kept[name] = np.asarray(angle_degrees(lights.light_directions, directions).mean())
    file.parent.mkdir(parents=True, exist_ok=True)
    thin = {name: value.clip(-_MOST_HALF, _MOST_HALF).astype(np.float16)
            if value.ndim > 1 and value.dtype != bool else value for name, value in kept.items()}  # fmt: skip
    with atomic_path(file) as temporary, temporary.open("wb") as handle:
        np.savez_compressed(handle, allow_pickle=False, **thin)


def read(file: Path) -> Answered:
    """Read a scene.

    Raises:
        InputError: it was kept before scenes without evidence were.
    """
    with np.load(file) as archive:
        kept = {name: _widen(archive[name]) for name in archive.files}
    if "truth" not in kept:
        raise InputError(f"{file}: holds no answer, as an earlier version wrote it; delete it and answer again")
    names = [field.name for field in fields(Evidence)]
    evidence = Evidence(**{name: kept[name] for name in names}) if "network" in kept else None
    return Answered(
        name=file.stem, evidence=evidence, truth=kept["truth"], held_out=bool(kept["held_out"]),
        lights=(kept["lights_start"], kept["lights_refined"]), start=kept["start"], told=kept["told_first"],
        images=int(kept["images"]), lit=bool(kept["lit"]),
    )  # fmt: skip


def _widen(value: np.ndarray) -> Any:
    """Return a number, a mask, or an array in float32."""
    return float(value) if value.ndim == 0 else value if value.dtype == bool else value.astype(np.float32)


def read_all(folder: Path) -> list[Answered]:
    """Return the scenes of a folder."""
    return [read(file) for file in sorted(folder.glob("*.npz"))]


def measure(scene: Answered, network: FusionNet) -> list[float]:
    """Return mean degrees of the network's first and second look, of refinement, of their plain mean and of fusion; and
    what fusion expects. Without evidence all of them are the first look.
    """
    evidence, mask = scene.evidence, scene.start.any(axis=-1)
    truth = scene.truth[mask]
    if evidence is None:
        return [float(angle_degrees(scene.start[mask], truth).mean())] * 5 + [float(scene.told[mask].mean())]
    normals, expected = join(evidence, network)
    mean = unit(evidence.network[mask] + evidence.refined[mask])
    tried = (scene.start[mask], evidence.network[mask], evidence.refined[mask], mean, normals[mask])
    return [*(float(angle_degrees(each, truth).mean()) for each in tried), float(expected[mask].mean())]


def tabulate(groups: Mapping[str, Sequence[Answered]], network: FusionNet) -> Iterator[str]:
    """Yield a table with a line a group, degrees; losing is against the network's first look."""
    lines = []
    for name, scenes in groups.items():
        if scenes:
            some = np.array([measure(scene, network) for scene in scenes])
            lost = [str(int((some[:, k] > some[:, 0] + _LOSS).sum())) for k in (2, 4)]
            lights = np.array([scene.lights for scene in scenes if not scene.lit] or [(np.nan, np.nan)])
            means, off = ([f"{value:.2f}" for value in values.mean(axis=0)] for values in (some, lights))
            lines.append([name, str(len(some)), *means, *lost, *off])
    yield render_text(f"Normals and lights, degrees; a loss is over {_LOSS}", _HEAD, lines)
