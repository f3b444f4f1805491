"""The state of a training run (network, optimiser, place in the data), and the operations on it."""

import logging
import math
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn.parallel import DistributedDataParallel

from render.records.manifest import read_manifest
from render.shared.config import to_plain
from render.shared.decoding import decoding
from render.shared.errors import InputError
from render.shared.seeds import spread_evenly
from sdps.data.dataset import Batch, SampleKey, SampleOptions, SceneDataset, collate
from sdps.data.resident.resident_scenes import ResidentScenes
from sdps.data.sources import BatchSource, StoredScenes
from sdps.models.checkpoint import TrainedModel, code_version, load_state, save_state, save_weights
from sdps.training.distributed import Team
from sdps.training.kept_weights import KeptWeights
from sdps.training.muon import Muon
from sdps.training.stages import Stage
from sdps.training.training_config import EARLIER_NAMES, TrainingConfig

CHECKPOINT = "checkpoint.pt"
# What may differ between the parts of one run: how long, and how it is carried out, but not what is computed.
_MAY_CHANGE = {
    "epochs", "steps", "minutes", "workers", "cache", "shuffle_window",  # the last is in the source's identity
    "log_every", "validate_every", "validation_scenes", "checkpoint_minutes", "precision", "channels_last",
}  # fmt: skip
_log = logging.getLogger(__name__)
_MOST_SKIPPED = 5
"""Steps in a row whose gradient is not finite, after which training ends."""


class _Loss(nn.Module):
    """A stage's loss as a module, so that `DistributedDataParallel` sees one forward pass."""

    def __init__(self, stage: Stage) -> None:
        super().__init__()
        self.stage, self.network = stage, stage.network

    def forward(self, batch: Batch) -> tuple[Tensor, dict[str, Tensor]]:
        return self.stage.loss(batch)


class TrainingRun:
    """The state of a run, and the operations on it.

    Args:
        stage: What is trained; carries the configuration.
        data: Folder of rendered data.
        folder: The run's folder.
        here: The processes that share each batch.
        source: Where training batches come from; None: the stored scenes of `data`.
    """

    def __init__(self, stage: Stage, data: Path, folder: Path, here: Team, source: BatchSource | None = None) -> None:
        self.stage, self.config, self.data, self.folder, self.team = stage, stage.config, data, folder, here
        config = self.config
        stage.to(here.device)
        self.arithmetic = here.same_arithmetic(config.precision)
        self.source = source or _open_source(stage, data, here)
        self._validates = (
            config.validation_scenes > 0 and here.leads and any(scene.split == "val" for scene in read_manifest(data))
        )
        self.optimiser = _optimiser(stage.network, config)
        self.kept = KeptWeights(stage.network, config.ema, config.start_share, stage.added)
        if config.compile:
            stage.network.compile()
        self._loss: nn.Module = _Loss(stage)
        if here.world > 1:
            self._loss = DistributedDataParallel(self._loss)
        self.step = self.samples = 0
        self.computed: list[dict[str, Any]] = []
        """The precision and processor of each part of the run, and the step it began at."""
        self.best = math.inf
        self.learning_rate = config.learning_rate
        self.saved: int | None = None  # step of the checkpoint on disk
        self.on_save: Callable[[], None] | None = None
        self.finished_metrics: dict[str, float] | None = None
        self.skipped = 0  # steps in a row
        self._earlier_seconds, self._started = 0.0, time.perf_counter()

    def seconds(self) -> float:
        """Return the seconds of training so far, those before a resume included."""
        return self._earlier_seconds + time.perf_counter() - self._started

    def progress(self) -> float:
        """Return the share of the budget spent; 1 or more means done."""
        config = self.config
        if config.steps is not None:
            return self.step / config.steps
        if config.minutes is not None:
            return self.seconds() / (60.0 * config.minutes)
        return self.samples / (config.epochs * self.source.scenes)

    def take_step(self, batch: Batch, progress: float) -> dict[str, float]:
        """Take one optimiser step on `batch` and return its losses.

        Args:
            batch: This process's share of the step's scenes.
            progress: Share of the budget spent, which the learning rate follows.

        Raises:
            InputError: the loss is not finite.
        """
        config = self.config
        self.stage.network.train()
        self.learning_rate = config.learning_rate_at(progress)
        for group in self.optimiser.param_groups:
            group["lr"] = self.learning_rate
        sums: dict[str, Tensor] = {}
        for part in _parts(batch, config.batch_scenes // config.accumulate):
            share = len(batch.seed) / len(part.seed)
            with self.arithmetic.autocast():
                loss, terms = self._loss(part.to(self.team.device))
            (loss / share).backward()
            for name, value in {"loss": loss, **terms}.items():
                sums[name] = sums.get(name, 0.0) + value.detach().double() / share
        # One transfer a step: a GPU is waited for once.
        totals = self.team.mean(dict(zip(sums, torch.stack(list(sums.values())).tolist(), strict=True)))
        if not math.isfinite(totals["loss"]):
            raise self._divergence(f"the loss became {totals['loss']} at step {self.step + 1}")
        if config.clip_gradient:
            norm = torch.nn.utils.clip_grad_norm_(self.stage.network.parameters(), config.clip_gradient)
            totals["gradient_norm"] = float(norm)
        if math.isfinite(totals.get("gradient_norm", 0.0)):
            self.optimiser.step()
            self.skipped = 0
        else:  # one odd sample would spoil the weights
            self._skip_step(totals)
        self.optimiser.zero_grad(set_to_none=True)
        self.kept.update()
        self.step += 1
        self.samples += config.batch_scenes
        return totals

    def _skip_step(self, totals: dict[str, float]) -> None:
        """Leave the weights as they are, and say so; too often in a row is an error."""
        self.skipped += 1
        if self.skipped >= _MOST_SKIPPED:
            raise self._divergence(f"the gradient is not finite in {self.skipped} steps in a row, to {self.step + 1}")
        _log.warning("%s: the gradient of step %d is not finite; the step was left out", self.stage.name, self.step + 1)
        totals["gradient_norm"] = 0.0

    @torch.no_grad()
    def validate(self) -> dict[str, float]:
        """Return the stage's metrics, prefixed `val_`, averaged over fixed samples of the `val` split.

        The best weights so far, by the stage's goal, are saved.
        """
        if not self._validates:
            return {}
        trained, self.stage.network = self.stage.network, self.kept.network()
        self.stage.network.eval()
        values: dict[str, float] = {}
        try:
            for suffix, options in self.stage.validations().items():
                values |= {f"val_{name}{suffix}": value for name, value in self._measure(options).items()}
        finally:
            self.stage.network = trained
        if values[f"val_{self.stage.goal}"] < self.best:
            self.best = values[f"val_{self.stage.goal}"]
            self.save_weights(values, "-best")
        return values

    def _measure(self, options: SampleOptions) -> dict[str, float]:
        """Return the stage's metrics averaged over samples of the `val` split."""
        # Opened again each time: a folder that is still being rendered has more scenes by now.
        config = self.config
        scenes = SceneDataset(self.data, "val", options, cache=config.cache, skip_missing=config.skip_missing)
        rows = []
        for index in spread_evenly(range(len(scenes)), config.validation_scenes):
            batch = collate([scenes.sample(SampleKey(index, 0, index))])
            assert isinstance(batch, Batch)  # `sample` raises
            with self.arithmetic.autocast():
                rows.append(self.stage.metrics(batch.to(self.team.device)))
        return {name: float(np.mean([row[name] for row in rows])) for name in rows[0]}

    def _divergence(self, what: str) -> InputError:
        """Return the error for a run whose loss or weights are NaN or infinite; it names the last good checkpoint."""
        path = self.folder / CHECKPOINT
        kept = "nothing was saved before"
        if self.saved is not None:
            kept = f"the last good state, of step {self.saved}, stays in {path}"
        return InputError(f"{what}; {kept}; lower learning_rate and choose another --out")

    def _require_finite(self) -> None:
        """Refuse to write weights that a gradient has made infinite or NaN while the loss before it was finite."""
        if not self.kept.are_finite():
            raise self._divergence(f"the weights became infinite or NaN at step {self.step}")

    def save(self) -> None:
        """Write the checkpoint: weights, optimiser, random state, and place in the data.

        Raises:
            InputError: weights that are not finite; the checkpoint before stays.
        """
        self._require_finite()
        cuda = torch.cuda.get_rng_state_all() if self.team.device.type == "cuda" else []
        state = {
            "identity": _identify(self.stage, self.source),
            "network": self.stage.network.state_dict(),
            "average": self.kept.state_dict(),
            "optimiser": self.optimiser.state_dict(),
            "random": {"cpu": torch.get_rng_state(), "cuda": cuda},
            "step": self.step,
            "samples": self.samples,
            "best": self.best,
            "computed": self.computed,
            "seconds": self.seconds(),
            "finished_metrics": self.finished_metrics,
        }
        save_state(self.folder / CHECKPOINT, state)
        self.saved = self.step
        if self.on_save is not None:
            self.on_save()

    def resume(self) -> None:
        """Go on from the folder's checkpoint, if there is one.

        Raises:
            InputError: the checkpoint is damaged, or of another configuration or data set.
        """
        path = self.folder / CHECKPOINT
        if not path.is_file():
            return
        state = load_state(path)
        _require_same(path, state.get("identity", {}), self.stage, self.source)
        with decoding(path, "a checkpoint of this run", "delete it to start this run again"):
            self.stage.network.load_state_dict(state["network"])
            self.optimiser.load_state_dict(state["optimiser"])
            self.kept.load_state_dict(state["average"])
            torch.set_rng_state(state["random"]["cpu"])
            if self.team.device.type == "cuda" and state["random"]["cuda"]:
                torch.cuda.set_rng_state_all(state["random"]["cuda"])
            self.step, self.samples, self.best = state["step"], state["samples"], state["best"]
            self.saved = self.step
            self.computed = state.get("computed", [])
            self.finished_metrics = state["finished_metrics"]
            self._earlier_seconds, self._started = state["seconds"], time.perf_counter()

    def note_arithmetic(self) -> None:
        """Record what the following steps are computed in, and say so where the run began with something else."""
        now = {"step": self.step, "precision": self.arithmetic.precision, "device": self.arithmetic.device}
        if self.computed and self.computed[-1]["precision"] != now["precision"]:
            _log.warning("%s: began in %s and goes on in %s (%s)", self.stage.name, self.computed[-1]["precision"],
                         now["precision"], self.arithmetic.reason)  # fmt: skip
        if not self.computed or {**self.computed[-1], "step": 0} != {**now, "step": 0}:
            self.computed.append(now)

    def save_weights(self, metrics: dict[str, float], suffix: str = "") -> None:
        """Write the network with everything needed to use and to trace it; InputError where it is not finite."""
        self._require_finite()
        metadata = {
            "config": to_plain(self.config),
            **self.source.identity(),
            "code": code_version(),
            "step": self.step,
            "computed": self.computed,
            "seconds": round(self.seconds(), 1),
            "metrics": metrics,
            **self.stage.origin(),
        }
        model = TrainedModel(self.stage.model, self.kept.network(), self.stage.options, metadata)
        save_weights(self.folder / f"{self.stage.name}{suffix}.safetensors", model)


def _open_source(stage: Stage, data: Path, here: Team) -> BatchSource:
    """Return batches of a data folder, made by loader processes or on the device."""
    config, options = stage.config, stage.sample_options()
    shared: dict[str, Any] = {"batch": config.batch_scenes, "workers": config.workers, "rank": here.rank,
                              "world": here.world}  # fmt: skip
    if config.resident:
        return ResidentScenes(data, options, device=here.device, growing=config.skip_missing, **shared)
    return StoredScenes(
        SceneDataset(data, "train", options, cache=config.cache, skip_missing=config.skip_missing),
        pin_memory=here.device.type == "cuda", window=config.shuffle_window, **shared,
    )  # fmt: skip


def _optimiser(network: nn.Module, config: TrainingConfig) -> torch.optim.Optimizer | Muon:
    """Return the optimiser that a configuration names."""
    options: dict[str, Any] = {"lr": config.learning_rate, "weight_decay": config.weight_decay}
    if config.optimiser == "muon":
        return Muon(network, **options)
    kind = torch.optim.Adam if config.optimiser == "adam" else torch.optim.AdamW
    return kind(network.parameters(), **options, fused=True)


def _parts(batch: Batch, scenes: int) -> list[Batch]:
    """Split a batch into parts of this many scenes; the last may be smaller. With more processes there are fewer."""
    return [Batch(*tensors) for tensors in zip(*(tensor.split(scenes) for tensor in batch), strict=True)]


def _identify(stage: Stage, source: BatchSource) -> dict[str, Any]:
    """Return what identifies a run: model, data, origin of the weights, and the settings that affect the result."""
    fixed = {key: value for key, value in to_plain(stage.config).items() if key not in _MAY_CHANGE}
    about = {"model": stage.model, **source.identity()}
    return about | stage.origin() | {f"config.{key}": value for key, value in fixed.items()}


def _require_same(path: Path, saved: dict[str, Any], stage: Stage, source: BatchSource) -> None:
    """Refuse a checkpoint of another run; settings that did not exist when it was written count as their defaults.

    Args:
        path: Of the checkpoint.
        saved: What `_identify` returned when it was written.
        stage, source: Of the run to resume.

    Raises:
        InputError: they differ.
    """
    defaults = {f"config.{key}": value for key, value in to_plain(type(stage.config)()).items()}
    for key, value in _identify(stage, source).items():
        was = saved.get(key, defaults.get(key))
        was = EARLIER_NAMES.get(was, was) if isinstance(was, str) else was
        if isinstance(was, dict) and isinstance(defaults.get(key), dict):
            was = defaults[key] | was
        if was != value:
            raise InputError(f"{path}: of another run ({key} was {was!r}, now {value!r}); choose another --out")
