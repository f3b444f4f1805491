"""Who renders the chunks of a run: processes of this machine, or others that take chunks and tell what came of them.

`render.running.supervisor` keeps the books of a run and asks its crew for news. The processes here are watched: one
that hangs, dies, sends nonsense or takes too much memory costs the view it works on, and another takes over the rest of
its chunk.
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
from render.running.isolation import serve
from render.running.messages import Begun, Done, Ended, Failed, Fatal, Message, Ready, WorkerConfig
from render.running.process import Worker

STARTING = 300.0  # seconds a process may take to import and choose its variant
News = Done | Failed | Fatal
"""What a run hears of its crew."""


class Crew(Protocol):
    """What renders chunks.

    Attributes:
        slots: Processes that may render side by side; known before the work is cut into chunks.
        count: Processes that do.
        note: What people should know of the crew now, such as that it waits; empty: nothing.
        chunk_bytes: Most bytes of shards in a chunk of several views; 0: as many as there are.
    """

    slots: int
    count: int
    note: str
    chunk_bytes: int

    def give(self, chunks: Iterable[Chunk]) -> None:
        """Add chunks to the work."""

    def busy(self) -> bool:
        """Tell whether anything is left to do."""

    def step(self) -> list[News]:
        """Wait about a second at most for news, and return it; shards of scenes that are done lie in their folder."""

    def close(self) -> None:
        """End the processes, whether or not the work is done."""


class LocalCrew:
    """Processes of this machine.

    Args:
        folder: The data folder.
        errors: Folder that takes the processes' standard error.
        workers: Processes; 0 takes what cores and memory allow, and one on a GPU.
        timeout: Seconds without a finished scene after which a process is stopped; 0 waits for ever.
        recycle: Scenes after which a process is replaced.
        threads: Threads of each; 0 shares the cores among them.
        memory: Bytes of memory each may take, where the system tells; 0: any.
        serve: What a process runs.
        commit: The code's commit, for the shards' headers; None: that of this machine's copy.
    """

    note, chunk_bytes = "", 0

    def __init__(
        self,
        folder: Path,
        errors: Path,
        *,
        workers: int = 0,
        timeout: float = 600.0,
        recycle: int = 500,
        threads: int = 0,
        memory: int = 0,
        serve: Callable[..., None] = serve,
        commit: str | None = None,
    ) -> None:
        self.folder, self.errors, self.timeout, self.recycle = folder, errors, timeout, recycle
        self.threads, self.memory, self.serve, self.commit = threads, memory, serve, commit
        self.choice = variant.choose()
        self.slots = workers or budget.default_workers(self.choice.variant)
        self.count = 1
        self.queue: deque[Chunk] = deque()
        self.workers: list[Worker] = []
        self.started = 0

    def give(self, chunks: Iterable[Chunk]) -> None:
        """Add chunks to the work."""
        self.queue.extend(chunks)
        self.count = max(self.count, min(self.slots, len(self.queue)))

    def busy(self) -> bool:
        """Tell whether anything is left to do."""
        return bool(self.queue) or any(worker.busy for worker in self.workers)

    def step(self) -> list[News]:
        """Hand out chunks, wait for news from the processes, and stop those that hang or take too much memory."""
        self._hand_out()
        news: list[News] = []
        ready = wait([worker.connection for worker in self.workers], timeout=self._patience())
        for worker in [worker for worker in self.workers if worker.connection in ready]:
            try:
                message = worker.hear(self.folder)
            except (EOFError, OSError):
                news += self._lost(worker, worker.exit_reason())
                continue
            if message is None:
                worker.abort()
                news += self._lost(worker, "worker sent a damaged or wrong message")
                continue
            worker.since = time.monotonic()
            news += self._take(worker, message)
        for worker in [worker for worker in self.workers if worker.busy]:
            reason = self._excess(worker)
            if reason:
                worker.abort()
                news += self._lost(worker, reason)
        return news

    def close(self) -> None:
        """End the processes; those that are idle end by themselves."""
        if not self.busy():
            for worker in self.workers:
                worker.dismiss()
        for worker in self.workers:
            worker.process.terminate()
        for worker in self.workers:
            worker.close()
        sweep(self.folder)
        self.workers, self.queue = [], deque()

    def _hand_out(self) -> None:
        """Give every idle process a chunk, and start processes while there is work for them."""
        for worker in [worker for worker in self.workers if not worker.busy]:
            if worker.rendered >= self.recycle:
                self._retire(worker)
            elif self.queue:
                worker.take(self.queue.popleft())
        while self.queue and len(self.workers) < self.count:
            config = WorkerConfig(
                folder=self.folder, number=self.started, threads=self.threads or max(1, budget.cores() // self.count),
                variant=self.choice.variant, llvm=str(self.choice.llvm) if self.choice.llvm else None,
                errors=self.errors / f"{self.started}.txt", commit=self.commit,
            )  # fmt: skip
            self.workers.append(Worker(self.serve, config))
            self.started += 1
            self.workers[-1].take(self.queue.popleft())

    def _excess(self, worker: Worker) -> str:
        """Say which limit a process is over, if any."""
        limit = self._limit(worker)
        if limit and time.monotonic() - worker.since > limit:
            return f"timed out after {limit:g} s"
        if self.memory and resident(worker.process.pid) > self.memory:
            return f"took more than {budget.gigabytes(self.memory)} of memory"
        return ""

    def _limit(self, worker: Worker) -> float:
        return self.timeout if worker.ready else STARTING

    def _patience(self) -> float:
        """Return how long nothing needs to be looked at."""
        ends = [worker.since + limit for worker in self.workers if worker.busy and (limit := self._limit(worker))]
        return min(max(min(ends, default=1e9) - time.monotonic(), 0.0) + 0.01, 1.0)

    def _take(self, worker: Worker, message: Message) -> list[News]:
        """Act on a message of a process; return what concerns the run."""
        match message:
            case Ready():
                worker.ready = True
            case Begun(ids):
                worker.current, worker.view_start = ids, worker.since
            case Done(line):
                worker.finished(line["id"])
                worker.rendered += 1
                return [message]
            case Failed(ids):
                for id in ids:
                    worker.finished(id)
                return [message]
            case Ended(sound):
                self._ended(worker, sound)
            case Fatal():
                return [message]
        return []

    def _ended(self, worker: Worker, sound: bool) -> None:
        worker.busy, worker.current = False, ()
        if worker.left:  # a process that is no longer sound leaves the rest to another one
            self.queue.appendleft(worker.left)
        if not sound:
            self._retire(worker)

    def _lost(self, worker: Worker, reason: str) -> list[News]:
        """Tell what a dead or stopped process was working on, and give the rest of its chunk to another."""
        worker.process.join()
        tail = worker.stderr_tail()
        self.workers.remove(worker)
        sweep(self.folder)
        if not worker.ready:
            said = f": {tail.splitlines()[-1]}" if tail else ""
            return [Fatal(f"a rendering process did not start ({reason}){said}; run `sdps doctor`")]
        current = worker.to_blame()  # of nobody, the next process would end in the same way, for ever
        for id in current:
            worker.finished(id)
        if worker.left:
            self.queue.appendleft(worker.left)
        return [Failed(current, reason, tail, time.monotonic() - worker.view_start)] if current else []

    def _retire(self, worker: Worker) -> None:
        worker.dismiss()
        worker.process.terminate()
        worker.close()
        self.workers.remove(worker)


def resident(pid: int | None) -> int:
    """Return the bytes of memory a process has; 0 where the system does not tell."""
    with suppress(OSError, ValueError, IndexError):
        pages = Path(f"/proc/{pid}/statm").read_text(encoding="ascii").split()[1]
        import resource

        return int(pages) * resource.getpagesize()
    return 0
