"""`lab bench-train`: what a training step costs, the trainer's against a plain float32 loop, in one run.

Both kinds of processor are measured: this one, and this one held to AVX2 (`lab.shared.machines`). The ways of
taking a step are timed in turn, round after round, so that a change of the machine's load meets all of them. Images per
second are medians of wall time; images per second of processor time stand beside them, since these hold on a machine
that is not idle. Normal models are given true lights, so that no lighting model runs with them.
"""

import argparse
import os
import shutil
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch

from lab.bench.bench_scenes import write_scenes
from lab.shared.machines import hold, kinds, processor
from lab.shared.memory import apart, measure_seconds, peak_bytes
from pipelines.shared.flags import add_fields, add_out, from_flags
from render.shared.config import check_fields, to_plain
from render.shared.errors import InputError
from render.shared.files import write_json, write_text
from render.shared.progress import progress_bar
from render.shared.templates import fill
from sdps.core.losses import masked_normal_loss
from sdps.core.precision import arithmetic
from sdps.data.dataset import Batch
from sdps.models import registry
from sdps.models.base import FusionNetwork, LightingNetwork, Lights
from sdps.training.distributed import Team
from sdps.training.loggers import Meter
from sdps.training.stage_factory import create_stage
from sdps.training.training_config import LightingTraining, NormalTraining, TrainingConfig
from sdps.training.training_run import TrainingRun

RATIO_TARGETS = {"bfloat16": 2.7, "float32": 1.0}
"""Trainer over plain loop, by what the trainer computes in."""
MUON_TARGET = 0.15
"""Share of a step in float32 that Muon may take; it is not held to it beside layers in bfloat16."""
WAITING_TARGETS = {"lighting": 0.10, "normals": 0.02}
PLAIN, OURS, MUON = "plain float32 loop", "trainer", "trainer, Muon"
# What the trainer's configuration is changed by, beside its own lines.
VARIANTS: dict[str, dict[str, Any]] = {
    OURS: {},
    MUON: {"optimiser": "muon"},
    "trainer, NCHW": {"channels_last": False},
    "trainer, float32": {"precision": "float32"},
    "trainer, torch.compile": {"compile": True},
}
ONE_THREAD = "trainer, 1 thread"
_SCENES = 8
_MEMORY_STEPS = 3


@dataclass(frozen=True, kw_only=True)
class BenchTrainConfig:
    """What is timed.

    Attributes:
        models: Names of models that give lights or normals from whole images.
        data: Data folder with a split `train`; empty: scenes made for the purpose (`lab.bench.bench_scenes`).
        seconds: Seconds each way of taking a step is run for, over all rounds.
        rounds: Times the ways take turns.
        scenes: Scenes per step.
        images: Images per scene.
        size: Image side in pixels.
        seed: Root seed.
    """

    models: tuple[str, ...] = ("lcnet", "nenet")
    data: str = ""
    seconds: float = 10.0
    rounds: int = 3
    scenes: int = 4
    images: int = 12
    size: int = 128
    seed: int = 0

    def __post_init__(self) -> None:
        check_fields(self, "positive", "seconds", "rounds", "scenes", "images")
        if not self.models:
            raise InputError("models must name at least one; see `sdps list models`")
        for model in self.models:
            role = registry.entry(model).role
            if role not in WAITING_TARGETS:
                raise InputError(f"models: {model!r} is for {role!r}; name models for lights or normals")


def run(config: BenchTrainConfig) -> dict[str, Any]:
    """Time the steps of every model, in processes of their own.

    Returns:
        `config` and, by kind of processor under `kinds`, `machine` and `models`: per model `ways` and
        `per_processor_second` (images per second), `ratio`, `muon_share`, `waiting`, `memory_mb` and `skipped` (what
        was not measured, and why); plain values, ready for JSON.

    Raises:
        InputError: an unusable data folder or configuration.
    """
    with tempfile.TemporaryDirectory() as made:
        folder = Path(config.data or made)
        if not config.data:
            write_scenes(folder, max(_SCENES, config.scenes), size=config.size, seed=config.seed)
        result: dict[str, Any] = {"config": to_plain(config), "kinds": {}}
        pairs = [(kind, model) for kind in kinds() for model in config.models]
        for kind, model in progress_bar(pairs, unit="model", desc="bench-train"):
            with hold(kind):
                if kind not in result["kinds"]:
                    result["kinds"][kind] = {"machine": apart(machine), "models": {}}
                found = apart(measure, config, model, folder)
                found["memory_mb"] = {way: apart(peak_memory, config, model, folder, way) for way in (PLAIN, OURS)}
            result["kinds"][kind]["models"][model] = found
    return result


def machine() -> dict[str, Any]:
    """Describe the processor, what `auto` chooses on it, and what it can do at most: rates of large matrix products.

    Their ratio bounds what bfloat16 can gain on networks that are convolutions and little else.
    """
    chosen = arithmetic()
    rates = {}
    for name in ("float32", "bfloat16"):
        left, right = (torch.ones(2048, 2048, dtype=getattr(torch, name)) for _ in range(2))
        left @ right
        times = [measure_seconds(partial(torch.matmul, left, right)) for _ in range(5)]
        rates[name] = float(np.median([2 * 2048**3 / 1e9 / seconds for seconds in times]))
    return {
        "processor": processor(), "precision": chosen.precision, "reason": chosen.reason,
        "instructions": torch.backends.cpu.get_cpu_capability(), "threads": torch.get_num_threads(),
        "torch": torch.__version__, "load": os.getloadavg()[0] if hasattr(os, "getloadavg") else None,
        "matmul_gflops": rates,
    }  # fmt: skip


def measure(config: BenchTrainConfig, model: str, folder: Path) -> dict[str, Any]:
    """Time a model's steps on one prepared batch, and its waiting for data."""
    updates: list[float] = []  # seconds that Muon takes, a step each
    with tempfile.TemporaryDirectory() as scratch:
        batch = first_batch(config, model, folder)
        images = batch.images.shape[0] * batch.images.shape[1]
        ways, skipped = _ways(config, model, folder, Path(scratch), batch, updates)
        skipped |= _warm_up(ways)
        updates.clear()
        wall, processor = _in_turn(ways, config, images)
        waiting = {
            f"{workers} loader processes": _waiting(config, model, folder, Path(scratch), workers) for workers in (0, 1)
        }
    rates = {name: _measure_spread(values) for name, values in wall.items()}
    ratios = [ours / plain for ours, plain in zip(wall[OURS], wall[PLAIN], strict=True)]
    return {
        "batch": list(batch.images.shape),
        "ways": rates,
        "per_processor_second": {name: _measure_spread(values) for name, values in processor.items()},
        "ratio": _measure_spread(ratios),
        "muon_share": float(np.mean(updates)) * rates[MUON]["median"] / images if MUON in ways else None,
        "waiting": waiting,
        "skipped": skipped,
    }


def _ways(
    config: BenchTrainConfig, model: str, folder: Path, scratch: Path, batch: Batch, updates: list[float]
) -> tuple[dict[str, Callable[[], object]], dict[str, str]]:
    """Return the ways of taking a step by name, and what is left out with the reason."""
    ways: dict[str, Callable[[], object]] = {PLAIN: plain_loop(model, batch)}
    skipped, threads = {}, torch.get_num_threads()
    for name, changes in VARIANTS.items():
        if changes.get("compile") and not any(map(shutil.which, (os.environ.get("CXX", "g++"), "c++", "clang++"))):
            skipped[name] = "no C++ compiler"
            continue
        if changes.get("precision") == arithmetic().precision:
            skipped[name] = "what the trainer does"
            continue
        trainer = make_trainer(replace(training(config, model), **changes), model, folder, scratch / name)
        if name == MUON:
            update = trainer.optimiser.step
            trainer.optimiser.step = lambda update=update: updates.append(measure_seconds(update))  # type: ignore
        ways[name] = partial(trainer.take_step, batch, 0.5)

    def one_thread() -> None:
        torch.set_num_threads(1)
        try:
            ways[OURS]()
        finally:
            torch.set_num_threads(threads)

    if threads > 1:
        ways[ONE_THREAD] = one_thread
    else:
        skipped[ONE_THREAD] = "there is no other"
    return ways, skipped


def _warm_up(ways: dict[str, Callable[[], object]]) -> dict[str, str]:
    """Take two steps each way; drop the variants that cannot and return why."""
    failed = {}
    for name in list(ways):
        try:
            ways[name]()
            ways[name]()  # the second meets memory and kernels that are there
        except InputError as error:  # of the trainer, when a step spoils the weights
            if name in (PLAIN, OURS):
                raise
            failed[name] = str(error)
            del ways[name]
    return failed


def training(config: BenchTrainConfig, model: str) -> TrainingConfig:
    """Return the settings the trainer is measured with: those of the presets for processors without a GPU."""
    entry = registry.entry(model)
    kind = LightingTraining if entry.role == "lighting" else NormalTraining
    settings = kind(
        seed=config.seed, batch_scenes=config.scenes, images=config.images, size=config.size, optimiser="adamw",
        validation_scenes=0,
    )  # fmt: skip
    return replace(settings, lights="true") if isinstance(settings, NormalTraining) and entry.lights else settings


def make_trainer(settings: TrainingConfig, model: str, folder: Path, scratch: Path) -> TrainingRun:
    """Build the trainer as a run does."""
    return TrainingRun(create_stage(model, model, settings, {}), folder, scratch, Team(0, 1, torch.device("cpu")))


def first_batch(config: BenchTrainConfig, model: str, folder: Path) -> Batch:
    """Return the first training batch of the data folder.

    Raises:
        InputError: the folder cannot be trained on.
    """
    with tempfile.TemporaryDirectory() as scratch:
        source = make_trainer(training(config, model), model, folder, Path(scratch)).source
        batch = next(source.batches(0))
        source.close()
    return _sound(batch)


def _sound(batch: Batch | InputError) -> Batch:
    """Return a batch, or raise the mistake that stands in its place."""
    if isinstance(batch, InputError):
        raise batch
    return batch


def plain_loop(model: str, batch: Batch) -> Callable[[], object]:
    """Return a step as one would write it first: float32, default memory layout, AdamW."""
    network = registry.create(model)
    optimiser = torch.optim.AdamW(network.parameters(), lr=1e-4)

    def step() -> float:
        if isinstance(network, LightingNetwork):
            prediction = network(batch.images, batch.mask)
            loss = network.loss(prediction, Lights(batch.directions, batch.intensities))["total"]
        else:
            assert isinstance(network, FusionNetwork), model
            lights = Lights(batch.directions, batch.intensities)
            normals = network(network.observe(batch.images, batch.mask, lights))
            loss = masked_normal_loss(normals, batch.normals, batch.mask)
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        return float(loss.detach())

    return step


def _in_turn(
    ways: dict[str, Callable[[], object]], config: BenchTrainConfig, images: int
) -> tuple[dict[str, list[float]], dict[str, list[float]]]:
    """Return each way's images per second in every round, of wall time and of processor time."""
    wall: dict[str, list[float]] = {name: [] for name in ways}
    processor: dict[str, list[float]] = {name: [] for name in ways}
    for _ in range(config.rounds):
        for name, way in ways.items():
            steps, began, spent = 0, time.perf_counter(), time.process_time()
            while steps == 0 or time.perf_counter() - began < config.seconds / config.rounds:
                way()
                steps += 1
            wall[name].append(steps * images / (time.perf_counter() - began))
            processor[name].append(steps * images / (time.process_time() - spent))
    return wall, processor


def _waiting(config: BenchTrainConfig, model: str, folder: Path, scratch: Path, workers: int) -> dict[str, float]:
    """Train on the real source and return the share of time spent waiting for it, and images per second."""
    trainer = make_trainer(replace(training(config, model), workers=workers), model, folder, scratch / f"w{workers}")
    batches = trainer.source.batches(0)
    try:
        for _ in range(2 + _SCENES // config.scenes):  # starts the loader, decodes every scene once, warms up
            trainer.take_step(_sound(next(batches)), 0.5)
        meter, began = Meter(), time.perf_counter()
        while time.perf_counter() - began < config.seconds / 2:
            with meter.waiting():
                batch = _sound(next(batches))
            meter.add(trainer.take_step(batch, 0.5), batch.images.shape[0] * batch.images.shape[1])
        values = meter.summary()
        return {"share": values["waiting_share"], "images_per_second": values["images_per_second"]}
    finally:
        trainer.source.close()


def peak_memory(config: BenchTrainConfig, model: str, folder: Path, way: str) -> float | None:
    """Take a few steps in this process and return its peak resident memory in MB; None where /proc is missing."""
    batch = first_batch(config, model, folder)
    with tempfile.TemporaryDirectory() as scratch:
        if way == PLAIN:
            step = plain_loop(model, batch)
        else:
            step = partial(make_trainer(training(config, model), model, folder, Path(scratch)).take_step, batch, 0.5)
        for _ in range(_MEMORY_STEPS):
            step()
    peak = peak_bytes()
    return None if peak is None else peak / 1e6


def _measure_spread(values: list[float]) -> dict[str, float]:
    return {"median": float(np.median(values)), "least": min(values), "most": max(values)}


def table(result: dict[str, Any]) -> str:
    """Format the result of `run` as Markdown."""
    models = {model for found in result["kinds"].values() for model in found["models"]}
    return fill(
        Path(__file__).with_suffix(".md.j2"), kinds=result["kinds"], ratio_targets=RATIO_TARGETS,
        muon_target=MUON_TARGET, waiting_targets={name: WAITING_TARGETS[registry.entry(name).role] for name in models},
    )  # fmt: skip


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add one flag per field of `BenchTrainConfig`."""
    add_fields(parser, BenchTrainConfig)
    add_out(parser, Path("out/bench-train"))


def main(args: argparse.Namespace) -> int:
    """Run the benchmark, print its tables, write them and return the exit code."""
    result = run(from_flags(BenchTrainConfig, args))
    text = table(result)
    sys.stdout.write(text)
    write_json(args.out / "bench.json", result)
    write_text(args.out / "bench.md", text)
    return 0
