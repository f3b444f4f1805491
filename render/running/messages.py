"""What a rendering process is told at its start, and what it tells its parent through a pipe."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any


@dataclass(frozen=True)
class WorkerConfig:
    """What a rendering process is told at its start.

    Attributes:
        folder: The data folder.
        number: Number of the worker, for the ledger.
        threads: Threads it may use.
        variant: Mitsuba variant, chosen by the parent.
        llvm: Path of libLLVM, chosen by the parent.
        errors: File that takes its standard error.
    """

    folder: Path
    number: int
    threads: int
    variant: str
    llvm: str | None
    errors: Path


@dataclass(frozen=True)
class Ready:
    """The renderer has started."""


@dataclass(frozen=True)
class Begun:
    """Scenes are at work."""

    ids: tuple[str, ...]


@dataclass(frozen=True)
class Done:
    """A shard is written; its ledger line."""

    line: dict[str, Any]


@dataclass(frozen=True)
class Failed:
    """Scenes cannot be rendered: why, the end of the traceback of a defect, and the seconds they took."""

    ids: tuple[str, ...]
    reason: str
    traceback: str
    seconds: float


@dataclass(frozen=True)
class Ended:
    """A chunk is finished, or given up where the process is no longer sound."""

    sound: bool


@dataclass(frozen=True)
class Fatal:
    """A mistake that concerns the whole run."""

    reason: str


Message = Ready | Begun | Done | Failed | Ended | Fatal
