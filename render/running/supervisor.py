"""Rendering a plan with several processes, so that no scene can stop the run: the parent's side.

The parent hands out chunks of consecutive views of a shape, writes the ledger and the failures, and watches time and
disk. It never imports mitsuba. The bytes of a shard depend on the manifest alone, not on how the work was shared.
"""

import signal
import tempfile
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from multiprocessing.connection import wait
from pathlib import Path
from typing import Any

from render.backend import variant
from render.planning import budget
from render.planning.chunks import cut, share
from render.records.ledger import Ledger, Survey, now, survey, sweep
from render.records.manifest import SceneSpec
from render.records.mirror import mirror_of
from render.records.sending import open_ledger, send_leftovers
from render.running.isolation import serve
from render.running.messages import Begun, Done, Ended, Failed, Fatal, Message, Ready, WorkerConfig
from render.running.process import Worker
from render.shared.config import check_fields
from render.shared.errors import InputError
from render.shared.progress import progress_bar

STARTING = 300.0  # seconds a process may take to import and choose its variant
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
) -> RunSummary:
    """Render every scene that has no whole shard yet and did not fail before; go on after failures.

    Args:
        scenes: The manifest, whole.
        folder: Data folder; its `shards/`, `log/` and `failed.jsonl` are written.
        options: How to run it.
        serve: What a rendering process runs, a module-level function.

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
        run = _Run(scenes, wanted, found, folder, options, ledger, Path(errors), serve)
        run.go()
    return RunSummary(
        scenes=len(scenes), done=len(found.done) + len(run.lines), lines=run.lines, failed=run.failed,
        skipped=len(scenes) - len(found.done) - len(wanted), seconds=time.monotonic() - start, workers=run.count,
    )  # fmt: skip


class _Run:
    """One run: the queue of chunks, the processes, and what has come of them."""

    def __init__(
        self,
        scenes: Sequence[SceneSpec],
        wanted: Sequence[SceneSpec],
        found: Survey,
        folder: Path,
        options: RunOptions,
        ledger: Ledger,
        errors: Path,
        serve: Callable[..., None],
    ) -> None:
        self.folder, self.options, self.ledger, self.errors, self.serve = folder, options, ledger, errors, serve
        self.total, self.initial = len(scenes), len(scenes) - len(wanted)
        self.wanted = {scene.id: scene for scene in wanted}
        self.attempts = {id: len(rows) for id, rows in found.failed.items()}
        self.lines: list[dict[str, Any]] = []
        self.failed: list[dict[str, Any]] = []
        self.workers: list[Worker] = []
        self.started = 0
        choice = variant.choose() if wanted else None
        self.variant, self.llvm = (choice.variant, choice.llvm) if choice else ("", None)
        limit = options.workers or budget.default_workers(self.variant)
        self.queue = deque(cut(scenes, self.wanted, limit))
        self.count = max(1, min(limit, len(self.queue)))

    def go(self) -> None:
        """Render until the queue is empty."""
        self.bar = progress_bar(
            total=self.total, initial=self.initial, unit="scene", desc="render",
            bar_format="{desc}: {percentage:3.0f}%|{bar:20}| {n_fmt}/{total_fmt} [{elapsed}{postfix}]",
        )  # fmt: skip
        try:
            with self.bar:
                while self.queue or any(worker.busy for worker in self.workers):
                    self._hand_out()
                    self._listen()
            for worker in self.workers:
                worker.dismiss()
        finally:
            for worker in self.workers:
                worker.process.terminate()
            for worker in self.workers:
                worker.close()
            sweep(self.folder, [worker.process.pid for worker in self.workers])

    def _hand_out(self) -> None:
        """Give every idle process a chunk, and start processes while there is work for them."""
        if self.ledger.crowded:
            return
        for worker in [worker for worker in self.workers if not worker.busy]:
            if worker.rendered >= self.options.recycle:
                self._retire(worker)
            elif self.queue:
                worker.take(self.queue.popleft())
        while self.queue and len(self.workers) < self.count:
            config = WorkerConfig(
                folder=self.folder, number=self.started, threads=max(1, budget.cores() // self.count),
                variant=self.variant, llvm=str(self.llvm) if self.llvm else None,
                errors=self.errors / f"{self.started}.txt",
            )  # fmt: skip
            self.workers.append(Worker(self.serve, config))
            self.started += 1
            self.workers[-1].take(self.queue.popleft())

    def _listen(self) -> None:
        """Wait for news from the processes, and stop those that hang."""
        ready = wait([worker.connection for worker in self.workers], timeout=self._patience())
        for worker in [worker for worker in self.workers if worker.connection in ready]:
            try:
                message = worker.connection.recv()
            except (EOFError, OSError):
                self._lost(worker, worker.exit_reason())
                continue
            worker.since = time.monotonic()
            self._take(worker, message)
        for worker in list(self.workers):
            limit = self._limit(worker)
            if limit and worker.busy and time.monotonic() - worker.since > limit:
                worker.abort()
                self._lost(worker, f"timed out after {limit:g} s")

    def _limit(self, worker: Worker) -> float:
        return self.options.timeout if worker.ready else STARTING

    def _patience(self) -> float:
        """Return how long nothing needs to be looked at."""
        ends = [worker.since + limit for worker in self.workers if worker.busy and (limit := self._limit(worker))]
        return min(max(min(ends, default=1e9) - time.monotonic(), 0.0) + 0.01, 1.0)

    # ---- Messages from the processes ----

    def _take(self, worker: Worker, message: Message) -> None:
        """Act on a message of a process."""
        match message:
            case Ready():
                worker.ready = True
            case Begun(ids):
                worker.current, worker.view_start = ids, worker.since
            case Done(line):
                self._done(worker, line)
            case Failed():
                self._failed(worker, message)
            case Ended(sound):
                self._ended(worker, sound)
            case Fatal(reason):
                raise InputError(f"{reason} ({self._kept()})" if self.lines else reason)

    def _done(self, worker: Worker, line: dict[str, Any]) -> None:
        worker.finished(line["id"])
        worker.rendered += 1
        self.lines.append(line)
        self.ledger.add(line)
        self._tick(1)
        if budget.free_bytes(self.folder) < self.options.keep_free:
            raise InputError(
                f"{self.folder}: less than {budget.gigabytes(self.options.keep_free)} of disk are free; "
                f"{self._kept()}; free space and run it again to go on"
            )

    def _failed(self, worker: Worker, failure: Failed) -> None:
        for id in failure.ids:
            worker.finished(id)
            scene = self.wanted[id]
            self.attempts[id] = self.attempts.get(id, 0) + 1
            line = {
                "id": id, "seed": scene.seed, "shape": scene.shape, "material": scene.material,
                "reason": failure.reason, "traceback": failure.traceback, "seconds": round(failure.seconds, 3),
                "attempt": self.attempts[id], "time": now(),
            }  # fmt: skip
            self.failed.append(line)
            self.ledger.fail(line)
        self._tick(len(failure.ids))
        if not self.lines and len(self.failed) >= HOPELESS:
            raise InputError(
                f"{self.folder}: the first {len(self.failed)} scenes all failed, the last one thus: {failure.reason}; "
                "mend that, then run it again with --retry-failed"
            )

    def _ended(self, worker: Worker, sound: bool) -> None:
        worker.busy, worker.current = False, ()
        if worker.left:  # a process that is no longer sound leaves the rest to another one
            self.queue.appendleft(worker.left)
        if not sound:
            self._retire(worker)

    # ---- Losing processes ----

    def _lost(self, worker: Worker, reason: str) -> None:
        """Record what a dead or stopped process was working on, and give the rest of its chunk to another."""
        worker.process.join()
        tail = worker.stderr_tail()
        if not worker.ready:
            said = f": {tail.splitlines()[-1]}" if tail else ""
            raise InputError(f"a rendering process did not start ({reason}){said}; run `sdps doctor`")
        if worker.current:
            self._failed(worker, Failed(worker.current, reason, tail, time.monotonic() - worker.view_start))
        if worker.left:
            self.queue.appendleft(worker.left)
        self.workers.remove(worker)
        sweep(self.folder, [worker.process.pid])

    def _retire(self, worker: Worker) -> None:
        worker.dismiss()
        worker.process.terminate()
        worker.close()
        self.workers.remove(worker)

    # ---- Telling ----

    def _tick(self, count: int) -> None:
        pace = budget.recent_pace(self.lines, self.count)
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
