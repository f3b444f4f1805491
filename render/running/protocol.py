"""What a rendering process and its parent say to each other through a pipe, wherever the results go.

The parent sends chunks of a plan (`render.planning.chunks.Chunk`), and None at the end. The worker sends `Ready` once;
for a chunk it sends `Started`, `Result` and `Failure` as they come, and then `Finished`. After `Fatal` it ends.
"""

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np


class WorkerConfig(NamedTuple):
    """How a rendering process is to work.

    Attributes:
        folder: The data folder, which takes the shards; None: results carry the arrays instead.
        number: Number of the worker, for the ledger.
        threads: Threads it may use.
        variant: Mitsuba variant, chosen by the parent.
        llvm: Path of libLLVM, chosen by the parent.
        errors: File that takes its standard error.
        commit: The code's commit, for the shards' headers; None: that of this machine's copy.
        ahead: Messages that may wait for a parent that does not read; rendering then pauses. 0: none.
    """

    folder: Path | None
    number: int
    threads: int
    variant: str
    llvm: str | None
    errors: Path
    commit: str | None = None
    ahead: int = 0


class SceneArrays(NamedTuple):
    """What training needs of a scene, as in `render.records.shards.Shard`."""

    images: np.ndarray  # (L, H, W, 3) float16, linear radiance under irradiance pi
    normals: np.ndarray  # (H, W, 3) float32, unit, camera frame, zero outside the mask
    mask: np.ndarray  # (H, W) bool
    depth: np.ndarray  # (H, W) float32, half image widths


class Ready(NamedTuple):
    """The renderer has started."""


class Started(NamedTuple):
    """Work on scenes has begun: if the process dies now, these are to blame."""

    ids: tuple[str, ...]


class Result(NamedTuple):
    """A scene is rendered: its ledger line, and its arrays unless they are in a shard."""

    line: dict[str, Any]
    arrays: SceneArrays | None = None


class Failure(NamedTuple):
    """Scenes cannot be rendered: why, the end of the traceback of a defect, and the seconds they took."""

    ids: tuple[str, ...]
    reason: str
    traceback: str
    seconds: float


class Finished(NamedTuple):
    """A chunk is finished, or given up where the process is no longer sound."""

    sound: bool


class Fatal(NamedTuple):
    """A mistake that concerns the whole run."""

    reason: str


Message = Ready | Started | Result | Failure | Finished | Fatal
Outcome = Result | Failure | Fatal
"""What those who asked for the work hear of it."""
