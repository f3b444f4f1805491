"""Who renders the chunks of a plan: processes of this machine, or of others.

`render.running.supervisor` keeps the records of a run and polls its pool for results. The processes here are watched:
one that hangs, dies, sends nonsense or takes too much memory costs the view it works on, and another takes over the
rest of its chunk.
"""

import time
from collections import deque
from collections.abc import Callable, Iterable
from contextlib import suppress
from multiprocessing.connection import wait
from pathlib import Path
from typing import Protocol

from render.backend import variant
from render.planning import budget
from render.planning.chunks import Chunk
from render.records.ledger import sweep
from render.running.protocol import Failure, Fatal, Finished, Message, Outcome, Ready, Result, Started, WorkerConfig
from render.running.worker_handle import WorkerHandle
from render.running.worker_process import serve

STARTING = 300.0  # seconds a process may take to import and choose its variant


class WorkerPool(Protocol):
    """What renders chunks.

    Attributes:
        slots: Processes that may render at the same time; known before the work is cut into chunks.
        count: Processes that do.
        note: What people should know of the pool now, such as that it waits; empty: nothing.
        chunk_bytes: Most bytes of shards in a chunk of several views; 0: as many as there are.
    """

    slots: int
    count: int
    note: str
    chunk_bytes: int

    def submit(self, chunks: Iterable[Chunk]) -> None:
        """Add chunks to the work."""

    def busy(self) -> bool:
        """Return whether anything is left to do."""

    def poll(self) -> list[Outcome]:
        """Wait about a second at most for outcomes and return them; shards of results lie in their folder."""

    def close(self) -> None:
        """End the processes, whether or not the work is done."""


class LocalPool:
    """Processes of this machine.

    Args:
        folder: The data folder; None: results carry the arrays.
        errors: Folder that takes the processes' standard error.
        workers: Processes; 0 takes what cores and memory allow, and one on a GPU.
        timeout: Seconds without a finished scene after which a process is stopped; 0 waits for ever.
        recycle: Scenes after which a process is replaced.
        threads: Threads of each; 0 shares the cores among them.
        memory: Bytes of memory each may take, where the system reports it; 0: any.
        serve: What a process runs.
        commit: The code's commit, for the shards' headers; None: that of this machine's copy.
        ahead: Messages that may wait in a process while nobody polls.
    """

    note, chunk_bytes = "", 0

    def __init__(
        self,
        folder: Path | None,
        errors: Path,
        *,
        workers: int = 0,
        timeout: float = 600.0,
        recycle: int = 500,
        threads: int = 0,
        memory: int = 0,
        serve: Callable[..., None] = serve,
        commit: str | None = None,
        ahead: int = 0,
    ) -> None:
        self.folder, self.errors, self.timeout, self.recycle = folder, errors, timeout, recycle
        self.threads, self.memory, self.serve, self.commit, self.ahead = threads, memory, serve, commit, ahead
        self.choice = variant.choose()
        self.slots = workers or budget.default_workers(self.choice.variant)
        self.count = 1
        self.queue: deque[Chunk] = deque()
        self.workers: list[WorkerHandle] = []
        self.started = 0

    def submit(self, chunks: Iterable[Chunk]) -> None:
        """Add chunks to the work."""
        self.queue.extend(chunks)
        self.count = max(self.count, min(self.slots, len(self.queue)))

    def busy(self) -> bool:
        """Return whether anything is left to do."""
        return bool(self.queue) or any(worker.busy for worker in self.workers)

    def poll(self) -> list[Outcome]:
        """Hand out chunks, wait for messages of the processes, and stop those that hang or take too much memory."""
        self._hand_out()
        outcomes: list[Outcome] = []
        ready = wait([worker.connection for worker in self.workers], timeout=self._patience())
        for worker in [worker for worker in self.workers if worker.connection in ready]:
            try:
                message = worker.receive()
            except (EOFError, OSError):
                outcomes += self._replace(worker, worker.exit_reason())
                continue
            if message is None:
                worker.abort()
                outcomes += self._replace(worker, "worker sent a damaged or wrong message")
                continue
            worker.since = time.monotonic()
            outcomes += self._handle(worker, message)
        for worker in [worker for worker in self.workers if worker.busy]:
            if reason := self._excess(worker):
                worker.abort()
                outcomes += self._replace(worker, reason)
        return outcomes

    def restart_clock(self) -> None:
        """Let timeouts count from now, after a time in which nobody polled."""
        for worker in self.workers:
            worker.since = time.monotonic()

    def close(self) -> None:
        """End the processes; those that are idle end by themselves."""
        if not self.busy():
            for worker in self.workers:
                worker.dismiss()
        for worker in self.workers:
            worker.terminate()
        for worker in self.workers:
            worker.close()
        self._sweep()
        self.workers, self.queue = [], deque()

    def _hand_out(self) -> None:
        """Give every idle process a chunk, and start processes while there is work for them."""
        for worker in [worker for worker in self.workers if not worker.busy]:
            if worker.rendered >= self.recycle:
                self._retire(worker)
            elif self.queue:
                worker.assign(self.queue.popleft())
        while self.queue and len(self.workers) < self.count:
            config = WorkerConfig(
                folder=self.folder, number=self.started, threads=self.threads or max(1, budget.cores() // self.count),
                variant=self.choice.variant, llvm=str(self.choice.llvm) if self.choice.llvm else None,
                errors=self.errors / f"{self.started}.txt", commit=self.commit, ahead=self.ahead,
            )  # fmt: skip
            self.workers.append(WorkerHandle(self.serve, config))
            self.started += 1
            self.workers[-1].assign(self.queue.popleft())

    def _excess(self, worker: WorkerHandle) -> str:
        """Return which limit a process is over, or an empty text."""
        limit = self._limit(worker)
        if limit and time.monotonic() - worker.since > limit:
            return f"timed out after {limit:g} s"
        if self.memory and resident_bytes(worker.process.pid) > self.memory:
            return f"took more than {budget.gigabytes(self.memory)} of memory"
        return ""

    def _limit(self, worker: WorkerHandle) -> float:
        return self.timeout if worker.ready else STARTING

    def _patience(self) -> float:
        """Return for how many seconds nothing needs to be looked at."""
        ends = [worker.since + limit for worker in self.workers if worker.busy and (limit := self._limit(worker))]
        return min(max(min(ends, default=1e9) - time.monotonic(), 0.0) + 0.01, 1.0)

    def _handle(self, worker: WorkerHandle, message: Message) -> list[Outcome]:
        """Act on a message of a process; return what concerns the run."""
        match message:
            case Ready():
                worker.ready = True
            case Started(ids):
                worker.current, worker.view_start = ids, worker.since
            case Result(line):
                worker.tick_off(line["id"])
                worker.rendered += 1
                return [message]
            case Failure(ids):
                for id in ids:
                    worker.tick_off(id)
                return [message]
            case Finished(sound):
                worker.busy, worker.current = False, ()
                if worker.left:  # a process that is no longer sound leaves the rest to another one
                    self.queue.appendleft(worker.left)
                if not sound:
                    self._retire(worker)
            case Fatal():
                return [message]
        return []

    def _replace(self, worker: WorkerHandle, reason: str) -> list[Outcome]:
        """Report what a dead or stopped process was working on, and leave the rest of its chunk to another."""
        worker.process.join()
        tail = worker.stderr_tail()
        self.workers.remove(worker)
        self._sweep()
        if not worker.ready:
            last = f": {tail.splitlines()[-1]}" if tail else ""
            return [Fatal(f"a rendering process did not start ({reason}){last}; run `sdps doctor`")]
        blamed = worker.find_blamed()  # if nobody were, the next process would end in the same way, for ever
        for id in blamed:
            worker.tick_off(id)
        if worker.left:
            self.queue.appendleft(worker.left)
        return [Failure(blamed, reason, tail, time.monotonic() - worker.view_start)] if blamed else []

    def _retire(self, worker: WorkerHandle) -> None:
        worker.dismiss()
        worker.terminate()
        worker.close()
        self.workers.remove(worker)

    def _sweep(self) -> None:
        if self.folder is not None:
            sweep(self.folder)


def resident_bytes(pid: int | None) -> int:
    """Return the bytes of memory a process has; 0 where the system does not report it."""
    with suppress(OSError, ValueError, IndexError):
        pages = Path(f"/proc/{pid}/statm").read_text(encoding="ascii").split()[1]
        import resource

        return int(pages) * resource.getpagesize()
    return 0
