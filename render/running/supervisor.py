"""Rendering a plan with several processes, so that no scene can stop the run: the parent's side.

The parent gives chunks of consecutive views of a shape to a pool (`render.running.worker_pool`), writes the ledger and
the failures, and watches the disk. It never imports mitsuba. The bytes of a shard depend on the manifest alone, not on
how the work was shared.
"""

import signal
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from render.planning import budget
from render.planning.chunks import cut, share
from render.records.ledger import Ledger, Survey, now, survey, sweep
from render.records.manifest import SceneSpec
from render.records.mirror import mirror_of
from render.records.sending import open_ledger, send_leftovers
from render.running.protocol import Failure, Fatal, Outcome, Result
from render.running.worker_pool import LocalPool, WorkerPool
from render.running.worker_process import serve
from render.shared.config import check_fields
from render.shared.errors import InputError
from render.shared.progress import progress_bar

HOPELESS = 20  # failures after which a run without a single success is given up


@dataclass(frozen=True, kw_only=True)
class RunOptions:
    """How to run a plan; none of it changes a byte of a shard.

    Attributes:
        workers: Processes; 0 takes what cores and memory allow, and one on a GPU.
        timeout: Seconds without a finished scene after which a process is stopped and its view counts as failed; 0
            waits for ever.
        recycle: Scenes after which a process is replaced, since Mitsuba keeps some memory of every scene.
        part: Which share of the shapes to render, from 1.
        parts: Number of shares.
        retry_failed: Try scenes again that failed before.
        verify: Hash every finished shard instead of trusting the ledger.
        keep_free: Bytes of disk to leave free.
    """

    workers: int = 0
    timeout: float = 600.0
    recycle: int = 500
    part: int = 1
    parts: int = 1
    retry_failed: bool = False
    verify: bool = False
    keep_free: int = budget.KEEP_FREE

    def __post_init__(self) -> None:
        check_fields(self, "not negative", "workers", "timeout", "keep_free")
        check_fields(self, "at least 1", "recycle")
        if not 1 <= self.part <= self.parts:
            raise InputError(f"shard must be i/n with i from 1 to n, got {self.part}/{self.parts}")


@dataclass(frozen=True)
class RunSummary:
    """What a run did.

    Attributes:
        scenes: Scenes of the plan, or of this share of it.
        done: Scenes that are finished now.
        lines: Ledger lines of those rendered now.
        failed: Failure lines of this run.
        skipped: Scenes left out because they failed in an earlier run.
        seconds: Wall time.
        workers: Processes used.
    """

    scenes: int
    done: int
    lines: list[dict[str, Any]]
    failed: list[dict[str, Any]]
    skipped: int
    seconds: float
    workers: int

    def stage_shares(self) -> dict[str, float]:
        """Return the share of the processes' time per stage; `other` is starting, waiting and idling."""
        total = max(self.seconds * self.workers, 1e-9)
        stages = {name: seconds / total for name, seconds in budget.stage_seconds(self.lines).items()}
        return stages | {"other": max(0.0, 1 - sum(stages.values()))}


def render_supervised(
    scenes: Sequence[SceneSpec],
    folder: str | Path,
    options: RunOptions | None = None,
    *,
    serve: Callable[..., None] = serve,
    pool: WorkerPool | None = None,
) -> RunSummary:
    """Render every scene that has no whole shard yet and did not fail before; go on after failures.

    Args:
        scenes: The manifest, whole.
        folder: Data folder; its `shards/`, `log/` and `failed.jsonl` are written.
        options: How to run it.
        serve: What a rendering process runs, a module-level function.
        pool: Who renders, closed at the end; processes of this machine when omitted.

    Raises:
        InputError: a mistake that concerns the whole run: the disk, or a process that cannot start. Shards stay.
        KeyboardInterrupt: on Ctrl-C or SIGTERM, after all processes have ended.
    """
    options, folder = options or RunOptions(), Path(folder)
    scenes = share(scenes, options.part, options.parts)
    sweep(folder)
    send_leftovers(folder)
    found = survey(folder, scenes, verify=options.verify)
    wanted = [scene for scene in scenes if scene.id not in found.done]
    if not options.retry_failed:
        wanted = [scene for scene in wanted if scene.id not in found.failed]
    by_id = {scene.id: scene for scene in scenes}
    measured = [(by_id[id], line["bytes"]) for id, line in list(found.lines.items())[-1000:]]
    if wanted:
        # Shards on their way to a store stay here only until they are sent.
        needed = 0 if mirror_of(folder) else budget.disk_bytes(wanted, measured)
        budget.require_space(folder, needed, options.keep_free)
    start = time.monotonic()
    with tempfile.TemporaryDirectory() as errors, open_ledger(folder) as ledger, _sigterm_as_interrupt():
        run = _Run(scenes, wanted, found, folder, options, ledger)
        if wanted or pool:
            run.render(pool or LocalPool(
                folder, Path(errors), workers=options.workers, timeout=options.timeout, recycle=options.recycle,
                serve=serve,
            ))  # fmt: skip
    return RunSummary(
        scenes=len(scenes), done=len(found.done) + len(run.lines), lines=run.lines, failed=run.failed,
        skipped=len(scenes) - len(found.done) - len(wanted), seconds=time.monotonic() - start, workers=run.workers,
    )  # fmt: skip


class _Run:
    """The records of one run: what has come of its scenes."""

    def __init__(
        self,
        scenes: Sequence[SceneSpec],
        wanted: Sequence[SceneSpec],
        found: Survey,
        folder: Path,
        options: RunOptions,
        ledger: Ledger,
    ) -> None:
        self.scenes, self.folder, self.options, self.ledger = scenes, folder, options, ledger
        self.wanted = {scene.id: scene for scene in wanted}
        self.attempts = {id: len(rows) for id, rows in found.failed.items()}
        self.lines: list[dict[str, Any]] = []
        self.failed: list[dict[str, Any]] = []
        self.workers = 1

    def render(self, pool: WorkerPool) -> None:
        """Render until nothing is left."""
        self.bar = progress_bar(
            total=len(self.scenes), initial=len(self.scenes) - len(self.wanted), unit="scene", desc="render",
            bar_format="{desc}: {percentage:3.0f}%|{bar:20}| {n_fmt}/{total_fmt} [{elapsed}{postfix}]",
        )  # fmt: skip
        try:
            with self.bar:
                pool.submit(cut(self.scenes, self.wanted, pool.slots, pool.chunk_bytes))
                note = ""
                while pool.busy():
                    while self.ledger.is_crowded():  # shards that wait for their store fill the disk
                        time.sleep(0.1)
                    for outcome in pool.poll():
                        self._record(outcome)
                    self.workers = pool.count
                    if pool.note != note:
                        note = pool.note
                        self.bar.set_postfix_str(note)
                    self.bar.update(0)  # the time, whenever the bar is drawn again
        finally:
            pool.close()

    def _record(self, outcome: Outcome) -> None:
        match outcome:
            case Result(line):
                self._record_result(line)
            case Failure():
                self._record_failure(outcome)
            case Fatal(reason):
                raise InputError(f"{reason} ({self._kept()})" if self.lines else reason)

    def _record_result(self, line: dict[str, Any]) -> None:
        self.lines.append(line)
        self.ledger.add(line)
        self._update_bar(1)
        if budget.free_bytes(self.folder) < self.options.keep_free:
            raise InputError(
                f"{self.folder}: less than {budget.gigabytes(self.options.keep_free)} of disk are free; "
                f"{self._kept()}; free space and run it again to go on"
            )

    def _record_failure(self, failure: Failure) -> None:
        for id in failure.ids:
            scene = self.wanted[id]
            self.attempts[id] = self.attempts.get(id, 0) + 1
            line = {
                "id": id, "seed": scene.seed, "shape": scene.shape, "material": scene.material,
                "reason": failure.reason, "traceback": failure.traceback, "seconds": round(failure.seconds, 3),
                "attempt": self.attempts[id], "time": now(),
            }  # fmt: skip
            self.failed.append(line)
            self.ledger.fail(line)
        self._update_bar(len(failure.ids))
        if not self.lines and len(self.failed) >= HOPELESS:
            raise InputError(
                f"{self.folder}: the first {len(self.failed)} scenes all failed, the last one: {failure.reason}; "
                "fix that, then run it again with --retry-failed"
            )

    def _update_bar(self, count: int) -> None:
        pace = budget.recent_pace(self.lines, self.workers)
        left = len(self.wanted) - len(self.lines) - len(self.failed)
        eta = f"{budget.duration(pace.left(left))} left, " if pace else ""
        self.bar.set_postfix_str(f"{eta}{len(self.failed)} failed", refresh=False)
        self.bar.update(count)

    def _kept(self) -> str:
        return f"{len(self.lines)} scenes of this run are finished and kept"


@contextmanager
def _sigterm_as_interrupt() -> Iterator[None]:
    """Let SIGTERM end a run as Ctrl-C does; signals can be handled in the main thread only."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    before = signal.signal(signal.SIGTERM, interrupt)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)
