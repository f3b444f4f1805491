"""What a rendering process is told at its start, and what it tells its parent through a pipe."""

from pathlib import Path
from typing import Any, NamedTuple


class WorkerConfig(NamedTuple):
    """What a rendering process is told at its start.

    Attributes:
        folder: The data folder.
        number: Number of the worker, for the ledger.
        threads: Threads it may use.
        variant: Mitsuba variant, chosen by the parent.
        llvm: Path of libLLVM, chosen by the parent.
        errors: File that takes its standard error.
        commit: The code's commit, for the shards' headers; None: that of this machine's copy.
    """

    folder: Path
    number: int
    threads: int
    variant: str
    llvm: str | None
    errors: Path
    commit: str | None = None


class Ready(NamedTuple):
    """The renderer has started."""


class Begun(NamedTuple):
    """Scenes are at work."""

    ids: tuple[str, ...]


class Done(NamedTuple):
    """A shard is written; its ledger line."""

    line: dict[str, Any]


class Failed(NamedTuple):
    """Scenes cannot be rendered: why, the end of the traceback of a defect, and the seconds they took."""

    ids: tuple[str, ...]
    reason: str
    traceback: str
    seconds: float


class Ended(NamedTuple):
    """A chunk is finished, or given up where the process is no longer sound."""

    sound: bool


class Fatal(NamedTuple):
    """A mistake that concerns the whole run."""

    reason: str


Message = Ready | Begun | Done | Failed | Ended | Fatal
