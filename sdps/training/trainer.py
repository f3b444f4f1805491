"""The trainer of every model: load, step, log, validate, checkpoint, resume.

A run's folder holds `metrics.jsonl`, `checkpoint.pt` (everything needed to go on), the best weights so far
(`<run>-best.safetensors`) and, once finished, the last (`<run>.safetensors`). Running the same command again resumes;
a run that was stopped and resumed takes the same steps on the same batches as one that was not. Started by `torchrun`,
several processes share every batch and take the steps one process would take.
"""

import logging
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import torch

from render.shared.errors import InputError
from render.shared.progress import progress_bar
from sdps.data.interrupts import StopRequest, stop_on_signal
from sdps.data.sources import BatchSource
from sdps.training.distributed import team
from sdps.training.loggers import JsonlLogger, Logger, Meter, TensorBoardLogger
from sdps.training.stages import Stage
from sdps.training.training_run import TrainingRun

METRICS = "metrics.jsonl"

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class TrainingResult:
    """How a run ended.

    Attributes:
        weights: The safetensors files by name, or None when the run was stopped before its budget was spent.
        steps: Optimiser steps taken in all.
        seconds: Seconds of training in all.
        metrics: Final validation metrics, `val_...`; empty without validation scenes.
        waiting_share: Share of this call's training time spent waiting for data.
        interrupted: Stopped by a signal; the same call resumes.
    """

    weights: dict[str, Path] | None
    steps: int
    seconds: float
    metrics: dict[str, float]
    waiting_share: float
    interrupted: bool


def train(
    stage: Stage,
    data_folder: str | Path,
    out_folder: str | Path,
    *,
    source: BatchSource | None = None,
    device: str | torch.device | None = None,
    loggers: Sequence[Logger] = (),
    tensorboard: bool = False,
    on_save: Callable[[], None] | None = None,
) -> TrainingResult:
    """Train a stage until its budget is spent, resuming what is in `out_folder`.

    Args:
        stage: What to train; carries the configuration.
        data_folder: Rendered data with splits `train` and, for validation, `val`.
        out_folder: Folder of the run.
        source: Where training batches come from; by default the stored scenes of `data_folder`.
        device: Torch device; CUDA when there is one, else CPU.
        loggers: Further receivers of metrics, besides `metrics.jsonl`.
        tensorboard: Also log to `<out_folder>/tensorboard`.
        on_save: Called in the leading process whenever a checkpoint has been written.

    Raises:
        InputError: unusable data, a checkpoint of another configuration or data set, or a loss that is
            no longer finite.
    """
    with team(device) as here:
        run = TrainingRun(stage, Path(data_folder), Path(out_folder), here, source)
        run.on_save = on_save
        try:
            return _train(run, list(loggers), tensorboard)
        finally:
            run.source.close()


def _train(run: TrainingRun, loggers: list[Logger], tensorboard: bool) -> TrainingResult:
    """Resume, run, validate and save."""
    run.resume()
    run.note_arithmetic()
    if run.finished_metrics is not None and run.progress() >= 1.0:
        return _describe_end(run, run.finished_metrics, 0.0, interrupted=False)
    run.finished_metrics = None
    if run.team.leads:
        loggers.insert(0, JsonlLogger(run.folder / METRICS, run.step))
        if tensorboard:
            loggers.append(TensorBoardLogger(run.folder / "tensorboard"))
    metrics: dict[str, float] = {}
    try:
        with stop_on_signal() as stop:
            waiting_share, stopped = _take_steps(run, loggers, stop)
        if run.team.leads:
            if not stopped:
                metrics = run.finished_metrics = run.validate()
                _report(loggers, run.step, metrics)
                run.save_weights(metrics)
            run.save()
    finally:
        for logger in loggers:
            logger.close()
    run.team.wait()  # the others may want the leader's weights next
    if stopped:
        _log.warning("stopped after step %d; run the same command again to resume", run.step)
    return _describe_end(run, metrics, waiting_share, interrupted=stopped)


def _take_steps(run: TrainingRun, loggers: Iterable[Logger], stop: StopRequest) -> tuple[float, bool]:
    """Take steps until the budget is spent or a stop is requested; return the share of time waited, and whether."""
    config = run.config
    batches = run.source.batches(run.samples)
    meter = Meter()
    saved = time.perf_counter()
    look = {"desc": run.stage.name, "bar_format": "{l_bar}{bar}| {elapsed}<{remaining} {postfix}"}
    bar = progress_bar(total=100.0, initial=100.0 * run.progress(), disable=not run.team.leads, **look)

    def tell() -> None:
        values = meter.summary() | {"learning_rate": run.learning_rate, "seconds": run.seconds()}
        _report(loggers, run.step, values)
        bar.set_postfix_str(f"loss {values['loss']:.3f}, {values['images_per_second']:.0f} images/s")

    with bar:
        while True:
            stopped = run.team.any(stop.requested)
            (progress,) = run.team.agree([run.progress()])
            if progress >= 1.0 or stopped:
                break
            with meter.waiting():
                batch = next(batches)
            if isinstance(batch, InputError):
                raise batch
            meter.add(run.take_step(batch, progress), batch.images.shape[0] * batch.images.shape[1])
            if run.step % config.log_every == 0:
                tell()
            if config.validate_every and run.step % config.validate_every == 0 and run.team.leads:
                _report(loggers, run.step, run.validate())
            if run.team.leads and time.perf_counter() - saved > 60.0 * config.checkpoint_minutes:
                run.save()
                saved = time.perf_counter()
            bar.update(100.0 * min(run.progress(), 1.0) - bar.n)
        if not (stopped or meter.empty):  # a run shorter than `log_every` has a line, too
            tell()
    return meter.total_waiting_share(), stopped


def _report(loggers: Iterable[Logger], step: int, values: dict[str, float]) -> None:
    for logger in loggers:
        if values:
            logger.log(step, values)


def _describe_end(
    run: TrainingRun, metrics: dict[str, float], waiting_share: float, *, interrupted: bool
) -> TrainingResult:
    """Return how the run ended."""
    name = run.stage.name
    weights = None if interrupted else {name: run.folder / f"{name}.safetensors"}
    return TrainingResult(weights, run.step, run.seconds(), metrics, waiting_share, interrupted)
