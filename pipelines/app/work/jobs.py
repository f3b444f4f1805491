"""One queue of jobs for everybody, run one after another in one process of their own.

The server's process loads neither torch nor Mitsuba. The worker keeps both loaded between jobs; it is replaced when a
running job is cancelled, when it dies, and when it holds more memory than allowed.
"""

import itertools
import multiprocessing
import threading
import time
from collections import deque
from dataclasses import dataclass, field
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from typing import Any

from pipelines.app.work.app_worker import serve

QUEUED, RUNNING, DONE, FAILED, CANCELLED = "queued", "running", "done", "failed", "cancelled"
WAITING_LIMIT = 20
_MEMORY_LIMIT = 4 * 2**30
"""Bytes the worker may hold after a job; above that a fresh one takes its place."""
_KEPT = 200  # finished jobs of which the state is remembered
_POLL = 0.2


@dataclass
class Job:
    """A job, what became of it and how far it is.

    Attributes:
        id: Number.
        owner: Session that asked for it; nobody else may see or cancel it.
        task: Name of a task of `app_worker.TASKS`.
        arguments: Its keyword arguments.
        state: queued, running, done, failed or cancelled.
        stage: What it is doing.
        share: Share that is done, in [0, 1].
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


class Jobs:
    """The queue and its worker. Thread-safe."""

    def __init__(self, memory_limit: int = _MEMORY_LIMIT) -> None:
        self._memory_limit = memory_limit
        self._numbers = itertools.count(1)
        self._jobs: dict[int, Job] = {}
        self._waiting: deque[Job] = deque()
        self._changed = threading.Condition()
        self._closed = False
        self._process: BaseProcess | None = None
        self._pipe: Connection | None = None
        self.worker_memory = 0
        """Bytes the worker held after its last job."""
        self._thread = threading.Thread(target=self._run, name="jobs", daemon=True)
        self._thread.start()

    def submit(self, owner: str, task: str, **arguments: Any) -> Job | None:
        """Queue a job; None where too many wait."""
        with self._changed:
            if len(self._waiting) >= WAITING_LIMIT:
                return None
            job = Job(next(self._numbers), owner, task, arguments)
            self._jobs[job.id] = job
            for old in [key for key, item in self._jobs.items() if item.state not in (QUEUED, RUNNING)][:-_KEPT]:
                del self._jobs[old]
            self._waiting.append(job)
            self._changed.notify_all()
            return job

    def get(self, owner: str, number: int) -> Job | None:
        """Return a job of an owner, None where there is none."""
        job = self._jobs.get(number)
        return job if job is not None and job.owner == owner else None

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
        """Take a waiting job out of the queue; of a running one end the worker, which `_run` notices."""
        with self._changed:
            if job.state == QUEUED:
                self._waiting.remove(job)
                job.state = CANCELLED
            elif job.state == RUNNING:
                job.state = CANCELLED
                self._stop_worker()

    def forget(self, owner: str) -> None:
        """Cancel the jobs of an owner who is gone."""
        for job in [job for job in self._jobs.values() if job.owner == owner]:
            self.cancel(job)

    def close(self) -> None:
        """End the worker."""
        with self._changed:
            self._closed = True
            self._stop_worker()
            self._changed.notify_all()
        self._thread.join(10)

    def _running(self) -> Job | None:
        return next((job for job in self._jobs.values() if job.state == RUNNING), None)

    def _run(self) -> None:
        """Pass jobs to the worker, one after another; the worker starts before the first job, so that it is warm."""
        while True:
            with self._changed:
                if not self._closed and (self._process is None or not self._process.is_alive()):
                    self._start_worker()
                while not self._waiting and not self._closed:
                    self._changed.wait()
                if self._closed:
                    return
                job = self._waiting.popleft()
                job.state, job.began = RUNNING, time.monotonic()
                pipe, process = self._pipe, self._process
            assert pipe is not None and process is not None
            try:
                pipe.send((job.task, job.arguments))
                self._follow(job, pipe, process)
            except (EOFError, OSError):
                self._end(job, FAILED, "the worker ended, perhaps for want of memory; try fewer or smaller pictures")
            with self._changed:
                if self.worker_memory > self._memory_limit:
                    self._stop_worker()

    def _follow(self, job: Job, pipe: Connection, process: BaseProcess) -> None:
        """Take in what the worker says of a job until it ends.

        Raises:
            EOFError: the worker died.
        """
        while job.state == RUNNING:
            if not pipe.poll(_POLL):
                if not process.is_alive():
                    raise EOFError
                continue
            kind, *values = pipe.recv()
            if kind == "stage":
                job.stage, share = values
                job.share = max(job.share, share)
            elif kind == "failed":
                self._end(job, FAILED, values[0])
            else:
                job.result, self.worker_memory = values
                self._end(job, DONE)

    def _end(self, job: Job, state: str, message: str = "") -> None:
        with self._changed:
            if job.state == RUNNING:
                job.message, job.share = message, 1.0
                job.state = state

    def _start_worker(self) -> None:
        context = multiprocessing.get_context("spawn")
        self._pipe, other = context.Pipe()
        self._process = context.Process(target=serve, args=(other,), name="sdps-app-worker", daemon=True)
        self._process.start()
        other.close()
        self.worker_memory = 0

    def _stop_worker(self) -> None:
        if self._process is not None and self._process.is_alive():
            self._process.kill()
            self._process.join(5)
        if self._pipe is not None:
            self._pipe.close()
        self._process = None
