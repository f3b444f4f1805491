"""One queue of jobs for all sessions, run one after another in a process of their own.

The server's process loads neither torch nor Mitsuba. The worker keeps both loaded between jobs; it is replaced when a
running job is cancelled, when it dies, and when it holds too much memory.
"""

import itertools
import math
import multiprocessing
import threading
import time
from collections import deque
from dataclasses import dataclass, field
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any

from pipelines.app.common.app_worker import serve

QUEUED, RUNNING, DONE, FAILED, CANCELLED = "queued", "running", "done", "failed", "cancelled"
_LIVE = (QUEUED, RUNNING)
WAITING_LIMIT = 20
_MEMORY_LIMIT = 4 * 2**30
"""Bytes the worker may hold after a job; above that it is replaced."""
_KEPT = 200  # finished jobs of which the state is remembered
_POLL = 0.2


@dataclass
class Job:
    """A job and its state.

    Attributes:
        id: Number.
        owner: Session that requested it; no other may see or cancel it.
        task: Name of a task of `app_worker.TASKS`.
        arguments: Its keyword arguments.
        state: queued, running, done, failed or cancelled.
        stage: What it is doing.
        share: How much of it is done, in [0, 1].
        message: Of a failed job, one line.
        result: What the task returned.
        began: Time it started (`time.monotonic`).
    """

    id: int
    owner: str
    task: str
    arguments: dict[str, Any]
    state: str = QUEUED
    stage: str = ""
    share: float = 0.0
    message: str = ""
    result: Any = None
    began: float = field(default=0.0)


class _Worker:
    """A worker process and the pipe to it. One thread starts, uses and ends it; others may `kill` it."""

    def __init__(self) -> None:
        context = multiprocessing.get_context("spawn")
        self.pipe, other = context.Pipe()
        self.process: BaseProcess = context.Process(target=serve, args=(other,), name="sdps-app-worker", daemon=True)
        self.process.start()
        other.close()
        self.condemned = False

    def is_usable(self) -> bool:
        """Return whether it can take a job."""
        return not self.condemned and self.process.is_alive()

    def kill(self) -> None:
        """End it without waiting for it."""
        self.condemned = True
        self.process.kill()

    def end(self) -> None:
        """End it and wait for it; the system may need seconds to reclaim the memory of a large process."""
        self.kill()
        self.process.join(5)
        self.pipe.close()


class Jobs:
    """The queue and its worker. Thread-safe; only `close` waits for a process, so the event loop may call all other
    methods.
    """

    def __init__(self, memory_limit: int = _MEMORY_LIMIT) -> None:
        self._memory_limit = memory_limit
        self._numbers = itertools.count(1)
        self._jobs: dict[int, Job] = {}
        self._waiting: deque[Job] = deque()
        self._changed = threading.Condition()
        self._closed = False
        self._worker: _Worker | None = None  # set only by the thread
        self.worker_memory = 0
        """Bytes the worker held after its last job."""
        self._thread = threading.Thread(target=self._run, name="jobs", daemon=True)
        self._thread.start()

    def submit(self, owner: str, task: str, **arguments: Any) -> Job | None:
        """Queue a job; return None if too many are waiting."""
        with self._changed:
            if len(self._waiting) >= WAITING_LIMIT:
                return None
            job = Job(next(self._numbers), owner, task, arguments)
            self._jobs[job.id] = job
            for old in [key for key, item in self._jobs.items() if item.state not in _LIVE][:-_KEPT]:
                del self._jobs[old]
            self._waiting.append(job)
            self._changed.notify_all()
            return job

    def get(self, owner: str, number: int) -> Job | None:
        """Return a job of an owner, None where there is none."""
        job = self._jobs.get(number)
        return job if job is not None and job.owner == owner else None

    def works_in(self, place: Path) -> bool:
        """Return whether a waiting or running job uses a folder as its `place`."""
        with self._changed:
            return any(job.state in _LIVE and job.arguments.get("place") == str(place) for job in self._jobs.values())

    def describe(self, job: Job) -> dict[str, Any]:
        """Return the state of a job, JSON ready; `left` is the time left in seconds, None while it is unknown."""
        with self._changed:
            before = self._waiting.index(job) + (self._running() is not None) if job in self._waiting else 0
        elapsed = time.monotonic() - job.began if job.began else 0.0
        known = job.state == RUNNING and job.share > 0.03 and elapsed > 1.0
        return {
            "id": job.id, "task": job.task, "state": job.state, "stage": job.stage, "share": round(job.share, 4),
            "before": before, "left": round(elapsed * (1 - job.share) / job.share, 1) if known else None,
            "message": job.message, "result": job.result, "seconds": round(elapsed, 1),
        }  # fmt: skip

    def cancel(self, job: Job) -> None:
        """Remove a waiting job from the queue; for a running one end the worker, which `_run` notices."""
        with self._changed:
            if job.state == QUEUED:
                self._waiting.remove(job)
                job.state = CANCELLED
            elif job.state == RUNNING:
                job.state = CANCELLED
                if self._worker is not None:
                    self._worker.kill()

    def forget(self, owner: str) -> None:
        """Cancel and forget the jobs of a session that has ended."""
        with self._changed:
            for job in [job for job in self._jobs.values() if job.owner == owner]:
                self.cancel(job)
                del self._jobs[job.id]

    def close(self) -> None:
        """End the worker."""
        with self._changed:
            self._closed = True
            if self._worker is not None:
                self._worker.kill()
            self._changed.notify_all()
        self._thread.join(10)

    def _running(self) -> Job | None:
        return next((job for job in self._jobs.values() if job.state == RUNNING), None)

    def _run(self) -> None:
        """Pass jobs to the worker one by one; it starts before the first job, so that its libraries are loaded."""
        while True:
            worker = self._find_worker()
            with self._changed:
                while not self._waiting and not self._closed:
                    self._changed.wait()
                if self._closed:
                    break
                if worker is None or not worker.is_usable():  # it may have died while idle
                    continue
                job = self._waiting.popleft()
                job.state, job.began = RUNNING, time.monotonic()
            try:
                worker.pipe.send((job.task, job.arguments))
                self._follow(job, worker)
            except (EOFError, OSError):
                self._end(job, FAILED, "the worker stopped, perhaps out of memory; try fewer or smaller pictures")
                worker.kill()
            if self.worker_memory > self._memory_limit:
                worker.kill()
        if worker is not None:
            worker.end()

    def _find_worker(self) -> _Worker | None:
        """Return a worker that can take a job, started if necessary; None if none can be started."""
        old = self._worker
        if old is not None and old.is_usable():
            return old
        if old is not None:
            old.end()
        try:
            worker = _Worker()
        except OSError:  # the system has no room for a process now
            time.sleep(_POLL)
            return None
        with self._changed:
            self._worker, self.worker_memory = worker, 0
        return worker

    def _follow(self, job: Job, worker: _Worker) -> None:
        """Read the worker's reports on a job until it ends.

        Raises:
            EOFError: the worker died.
        """
        while job.state == RUNNING:
            if not worker.pipe.poll(_POLL):
                if not worker.process.is_alive():
                    raise EOFError
                continue
            kind, *values = worker.pipe.recv()
            if kind == "stage":
                job.stage, share = values
                job.share = max(job.share, share)
            elif kind == "failed":
                self._end(job, FAILED, values[0])
            else:
                job.result, self.worker_memory = replace_nonfinite(values[0]), values[1]
                self._end(job, DONE)

    def _end(self, job: Job, state: str, message: str = "") -> None:
        with self._changed:
            if job.state == RUNNING:
                job.message, job.share = message, 1.0
                job.state = state


def replace_nonfinite(value: Any) -> Any:
    """Return a result with None for NaN and infinity, which JSON does not have."""
    if isinstance(value, dict):
        return {key: replace_nonfinite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [replace_nonfinite(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
