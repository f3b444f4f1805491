"""What a data folder remembers of its runs: finished shards in `log/done-*.jsonl`, failures in `failed.jsonl`.

Both are only appended to, one line per event, so that a run that is stopped leaves at most a torn last line, which
readers skip. Every run writes a ledger of its own; several machines may fill one folder.
"""

import json
import math
import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from types import TracebackType
from typing import Any, Self, TextIO

from render.records.manifest import FAILED, SceneSpec, read_events, read_failed
from render.records.mirror import LOG, SHARDS, Damaged, mirror_of, shard_path
from render.records.shards import is_whole
from render.shared.errors import InputError
from render.shared.temporary import host, tidy


def now() -> str:
    """Return the time in UTC as ISO 8601 text."""
    return datetime.now(UTC).isoformat(timespec="milliseconds")


class Ledger:
    """The ledger of one run, open for appending; the file appears with its first line.

    Args:
        folder: The data folder.

    Raises:
        InputError: from `add` and `fail`: the folder cannot be written.
    """

    def __init__(self, folder: Path) -> None:
        start = datetime.now(UTC).strftime("%Y%m%dT%H%M%S%f")
        self.folder = folder
        self.path = folder / LOG / f"done-{host() or 'host'}-{os.getpid()}-{start}.jsonl"
        self._handle: TextIO | None = None

    def is_crowded(self) -> bool:
        """Return whether no further work should be handed out for now."""
        return False

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type | None, error: BaseException | None, trace: TracebackType | None) -> None:
        if self._handle is not None:
            with suppress(OSError):  # of a line that `add` could not write and raised
                self._handle.close()

    def add(self, line: dict[str, Any]) -> None:
        """Append the line of a finished shard: id, spec, bytes, seconds, stages, time, worker."""
        with _writing(self.path):
            if self._handle is None:
                self._handle = open(self.path, "a", encoding="utf-8")  # noqa: SIM115 - open for the whole run
            self._handle.write(json.dumps(line) + "\n")
            self._handle.flush()

    def fail(self, line: dict[str, Any]) -> None:
        """Append the line of a failure: id, seed, shape, material, reason, traceback, seconds, attempt, time."""
        path = self.folder / FAILED
        # One write each: several machines append to this file.
        with _writing(path), open(path, "a", encoding="utf-8") as handle:
            handle.write(json.dumps(line) + "\n")


@contextmanager
def _writing(path: Path) -> Iterator[None]:
    """Make the folder of a file; if it cannot be written, say so in one line."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        yield
    except OSError as error:
        raise InputError(f"{path}: cannot be written ({error.strerror or error}); free space") from error


def read_runs(folder: Path) -> list[list[dict[str, Any]]]:
    """Return the ledger lines of every run that finished a shard; a damaged line counts as torn."""
    paths = sorted((folder / LOG).glob("done-*.jsonl"))
    runs = ([line for line in read_events(path) if is_finished(line)] for path in paths)
    return [lines for lines in runs if lines]


def is_finished(line: dict[str, Any]) -> bool:
    """Return whether a finished shard's line has a time of a known zone, and numbers where it must."""
    try:
        zone = datetime.fromisoformat(line["time"]).tzinfo
    except ValueError:
        return False
    numbers = (line.get("seconds"), line.get("bytes"))
    return zone is not None and all(isinstance(value, int | float) and abs(value) < math.inf for value in numbers)


def latest(runs: Sequence[list[dict[str, Any]]]) -> dict[str, dict[str, Any]]:
    """Return the last line of every finished shard by id, in order of time."""
    lines = sorted((line for lines in runs for line in lines), key=lambda line: line["time"])
    return {line["id"]: line for line in lines}


def shard_sizes(folder: Path) -> dict[str, int]:
    """Return the bytes of every shard file by scene id, from one look at the folder or the listing of its store."""
    if mirror := mirror_of(folder):
        return mirror.sizes()
    try:
        with os.scandir(folder / SHARDS) as entries:
            return {
                entry.name[:-4]: entry.stat().st_size
                for entry in entries
                if entry.name.endswith(".exr") and not entry.name.startswith(".")
            }
    except FileNotFoundError:
        return {}
    except NotADirectoryError as error:
        raise InputError(f"{folder / SHARDS}: cannot be written (not a folder); choose another --out") from error


@dataclass(frozen=True)
class Survey:
    """Which scenes of a plan are finished.

    Attributes:
        done: Ids with a whole shard.
        failed: Ids that failed before and are not done, with all their failure lines.
        lines: Ledger line per finished shard that has one.
        size: Bytes of the finished shards.
    """

    done: frozenset[str]
    failed: dict[str, list[dict[str, Any]]]
    lines: dict[str, dict[str, Any]]
    size: int


def survey(folder: Path, scenes: Sequence[SceneSpec], *, verify: bool = False) -> Survey:
    """Find out which scenes need no rendering.

    A shard of the size and manifest line its ledger says is taken as whole; others are hashed, or all with `verify`.
    """
    sizes, lines = shard_sizes(folder), latest(read_runs(folder))
    done, listed = set(), {}
    for scene in scenes:
        size = sizes.get(scene.id)
        if size is None:
            continue
        line = lines.get(scene.id, {})
        known = line.get("bytes") == size and line.get("spec") == scene.digest()
        if (known and not verify) or _is_whole(folder, scene):
            done.add(scene.id)
            if known:
                listed[scene.id] = line
    failed = {id: rows for id, rows in read_failed(folder).items() if id not in done}
    return Survey(frozenset(done), failed, listed, sum(sizes[id] for id in done))


def _is_whole(folder: Path, scene: SceneSpec) -> bool:
    """Hash a shard, here or in the store."""
    try:
        return is_whole(shard_path(folder, scene), scene)
    except Damaged:
        return False


def sweep(folder: Path) -> None:
    """Remove half-written shards that nobody is writing: see `render.shared.temporary`."""
    tidy(folder / SHARDS)
