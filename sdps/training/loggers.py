"""Measuring a run, and where metrics go. Any object with `log(step, values)` and `close()` is a logger."""

import json
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Protocol

import numpy as np

from render.shared.errors import InputError
from render.shared.files import read_whole_lines, write_jsonl, writing


class Logger(Protocol):
    """Receives named numbers as training goes on."""

    def log(self, step: int, values: dict[str, float]) -> None:
        """Take the values of one step."""

    def close(self) -> None:
        """Flush and release."""


class JsonlLogger:
    """One JSON object per line, with the step first.

    Args:
        path: The file, appended to.
        last_step: Step training resumes from; lines of later steps, which a killed run wrote after its
            last checkpoint, are dropped so that no step appears twice.
    """

    def __init__(self, path: Path, last_step: int) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        if path.is_file():
            # A killed run may have left half a line at the end.
            write_jsonl(path, [row for row in read_whole_lines(path) if row["step"] <= last_step])
        self._path = path
        with writing(path):
            self._file = open(path, "a", encoding="utf-8")  # noqa: SIM115 (closed by close)

    def log(self, step: int, values: dict[str, float]) -> None:
        """Write one line and flush it.

        Raises:
            InputError: the disk is full.
        """
        with writing(self._path):
            self._file.write(json.dumps({"step": step, **values}) + "\n")
            self._file.flush()

    def close(self) -> None:
        """Close the file."""
        with suppress(OSError):  # of a line that `log` could not write, and reported
            self._file.close()


class TensorBoardLogger:
    """Scalars for TensorBoard.

    Raises:
        InputError: tensorboard is not installed.
    """

    def __init__(self, folder: Path) -> None:
        try:
            from torch.utils.tensorboard import SummaryWriter
        except ImportError as error:
            raise InputError("tensorboard is not installed; install it or leave TensorBoard off") from error
        self._writer = SummaryWriter(str(folder))

    def log(self, step: int, values: dict[str, float]) -> None:
        """Add one point to every scalar's curve."""
        for name, value in values.items():
            self._writer.add_scalar(name, value, step)

    def close(self) -> None:
        """Flush and close."""
        self._writer.close()


class Meter:
    """Averages losses and measures speed and waiting between two lines of metrics."""

    def __init__(self) -> None:
        self._all_waited, self._all_started = 0.0, time.perf_counter()
        self._restart()

    def _restart(self) -> None:
        self._losses: dict[str, list[float]] = {}
        self._images, self._waited, self._started = 0, 0.0, time.perf_counter()

    @property
    def empty(self) -> bool:
        """Whether no step was taken since the last line."""
        return not self._losses

    @contextmanager
    def waiting(self) -> Iterator[None]:
        """Count the time inside as waiting for data."""
        began = time.perf_counter()
        yield
        self._waited += time.perf_counter() - began
        self._all_waited += time.perf_counter() - began

    def add(self, losses: dict[str, float], images: int) -> None:
        """Take the losses of one step on so many images."""
        self._images += images
        for name, value in losses.items():
            self._losses.setdefault(name, []).append(value)

    def summary(self) -> dict[str, float]:
        """Return the means since the last call, and start again."""
        seconds = time.perf_counter() - self._started
        values = {name: float(np.mean(history)) for name, history in self._losses.items()}
        values["images_per_second"] = self._images / seconds
        values["waiting_share"] = self._waited / seconds
        self._restart()
        return values

    def total_waiting_share(self) -> float:
        """Return the share of time spent waiting since the meter was made."""
        return self._all_waited / max(time.perf_counter() - self._all_started, 1e-9)
