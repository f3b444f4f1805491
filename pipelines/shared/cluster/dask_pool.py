"""Rendering by the workers of a Dask cluster: chunks go out, shards come back over the wire.

The run's records stay here: the ledger, the failures and the shards are written by this process only, when a chunk has
come back whole. A worker that is killed is replaced by Dask, and its chunk rendered again from the start; so no scene
is lost or doubled. Only as many chunks are out as keep the workers busy, which bounds the memory of all who take part.
"""

import queue
import threading
import time
import uuid
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pipelines.shared.cluster.cluster_config import ClusterChoice
from pipelines.shared.cluster.link import Link
from render.planning.budget import duration
from render.planning.chunks import Chunk
from render.running.cluster_worker import ClusterWorker, Mismatch, Task, TaskResult, make_task
from render.running.protocol import Failure, Fatal, Outcome, Result
from render.running.worker_process import serve
from render.shared.errors import InputError
from render.shared.files import atomic_path

if TYPE_CHECKING:
    from distributed import Future

AHEAD = 2  # chunks out per slot: one at work, one waiting there
CHUNK_BYTES = 64_000_000  # shards that a worker holds before they are fetched
COUNTING = 2.0  # seconds between looks at how many workers there are
AGAIN = 5.0  # seconds between tries to reach a lost scheduler
_HERE: list[ClusterWorker] = []
_LOCK = threading.Lock()


class DaskPool:
    """The workers of a Dask cluster.

    Args:
        link: The cluster.
        folder: The data folder.
        timeout: Seconds without a finished scene after which a rendering process is stopped.
        serve: What a rendering process runs.
    """

    chunk_bytes = CHUNK_BYTES

    def __init__(self, link: Link, folder: Path, *, timeout: float = 600.0, serve: Callable[..., None] = serve) -> None:
        self.link, self.folder, self.timeout, self.serve = link, folder, timeout, serve
        self.run = uuid.uuid4().hex[:12]
        self.slots = link.expected()
        self.count, self.note = max(1, link.slots()), ""
        self.counted = time.monotonic()
        self.lost: float | None = None  # since when there is no connection to the scheduler
        self.tried = 0.0
        self.numbers: dict[str, int] = {}
        self.queue: deque[Chunk] = deque()
        self.out: dict[Any, tuple[Future[Any], Chunk]] = {}
        self.back: queue.SimpleQueue[Future[Any]] = queue.SimpleQueue()

    def submit(self, chunks: Iterable[Chunk]) -> None:
        """Add chunks to the work."""
        self.queue.extend(chunks)

    def busy(self) -> bool:
        """Return whether anything is left to do."""
        return bool(self.queue or self.out)

    def poll(self) -> list[Outcome]:
        """Send chunks, fetch one that is done, and restore a connection that broke."""
        if self.lost is not None:
            return self._reconnect()
        try:
            if self.link.client.status != "running":
                raise OSError("the client lost its scheduler")
            self._count_workers()
            self._send()
            future = self.back.get(timeout=1.0)
            return self._fetch(future) if future.key in self.out else []
        except queue.Empty:
            return []
        except OSError:  # so are Dask's errors of communication, and those of waiting too long
            self.lost, self.tried = time.monotonic(), 0.0
            return []

    def close(self) -> None:
        """Cancel what is out, end the rendering processes of the cluster, and leave it."""
        client = self.link.client
        with suppress(Exception):  # the cluster may be gone
            if client.status == "running":
                if self.out:
                    client.cancel([future for future, _ in self.out.values()], force=True)
                client.run(stop, self.run, on_error="ignore")
        self.out = {}
        self.link.close()

    def _count_workers(self) -> None:
        """Count the workers now and then."""
        if self.note or time.monotonic() - self.counted > COUNTING:
            slots, self.counted = self.link.slots(), time.monotonic()
            self.count, self.note = max(1, slots), "" if slots else "waits for workers"

    def _send(self) -> None:
        """Keep as many chunks out as the workers take."""
        while self.queue and len(self.out) < AHEAD * self.count:
            chunk = self.queue.popleft()
            future = self.link.client.submit(
                render_task, make_task(self.run, chunk, self.timeout, self.serve), pure=False,
                key=f"sdps-{uuid.uuid4()}",
            )  # fmt: skip
            self.out[future.key] = future, chunk
            future.add_done_callback(self.back.put)

    def _fetch(self, future: "Future[Any]") -> list[Outcome]:
        """Take in what came of a chunk."""
        chunk = self.out[future.key][1]
        if future.status in ("cancelled", "lost"):
            raise OSError(f"the scheduler forgot {future.key}")
        if future.status == "error":
            del self.out[future.key]
            return self._handle_error(chunk, future.exception())
        worker, result = future.result(timeout=self.timeout or None)
        del self.out[future.key]
        for id, data in result.shards.items():
            with atomic_path(self.folder / "shards" / f"{id}.exr") as temporary:
                temporary.write_bytes(data)
        number = self.numbers.setdefault(worker, len(self.numbers))
        left: Chunk | None = chunk
        outcomes: list[Outcome] = []
        for outcome in result.outcomes:
            match outcome:
                case Result(line):
                    line["worker"] = number
                    left = left and left.without([line["id"]])
                case Failure(ids):
                    left = left and left.without(ids)
                case Fatal(reason):
                    left, outcome = None, Fatal(f"worker {worker}: {reason}")
            outcomes.append(outcome)
        if left:
            self.queue.appendleft(left)
        return outcomes

    def _handle_error(self, chunk: Chunk, error: BaseException | None) -> list[Outcome]:
        """Act on a task that did not come to an end."""
        if isinstance(error, Mismatch):
            return [Fatal(f"--cluster {self.link.choice.name}: a worker {error}")]
        if type(error).__name__ == "KilledWorker":
            if len(chunk.groups) > 1:  # one view may be to blame: the others go on without it
                singles = [chunk.only(group) for group in chunk.groups]
                self.queue.extendleft(single for single in reversed(singles) if single)
                return []
            ids = tuple(scene.id for scene in chunk.scenes())
            return [Failure(ids, "every worker that tried it died", "", 0.0)]
        said = (str(error).splitlines() or [""])[0]
        return [Fatal(
            f"--cluster {self.link.choice.name}: a worker cannot run a task ({type(error).__name__}: {said}); "
            "install the same sdps and Dask there as here"
        )]  # fmt: skip

    def _reconnect(self) -> list[Outcome]:
        """Try to reach the scheduler again, for as long as the configuration says."""
        assert self.lost is not None
        passed, patience = time.monotonic() - self.lost, self.link.choice.config.patience
        name = self.link.choice.name
        if passed > patience:
            return [Fatal(f"--cluster {name}: no scheduler for {duration(patience)}; run the same command to go on")]
        self.note = f"no scheduler, tries again for {duration(patience - passed)}"
        if time.monotonic() - self.tried < AGAIN:
            time.sleep(min(1.0, max(patience - passed, 0.01)))
            return []
        self.tried = time.monotonic()
        with suppress(Exception):
            self.link.client.close(timeout=1)
        with suppress(InputError):
            self.link.connect()
            self.queue.extendleft(chunk for _, chunk in reversed(self.out.values()))
            self.out, self.lost = {}, None
        return []


@contextmanager
def open_pool(choice: ClusterChoice | None, folder: Path, **options: Any) -> Iterator[DaskPool | None]:
    """Yield the workers of a cluster, or None where none is named."""
    if choice is None:
        yield None
        return
    link = Link(choice)
    try:
        yield DaskPool(link, folder, **options)
    finally:
        link.close()


# ---- On a worker of the cluster ----


def render_task(task: Task) -> tuple[str, TaskResult]:
    """Render a chunk; return the worker's address, and what came of it."""
    from distributed import get_worker

    worker = get_worker()
    with _LOCK:  # one for all tasks of this worker, whoever asks; its memory and folder are those Dask gives
        if not _HERE:
            memory = int(getattr(worker.memory_manager, "memory_limit", 0) or 0) // max(1, worker.state.nthreads)
            _HERE.append(ClusterWorker(Path(worker.local_directory) / "sdps", memory))
    return worker.address, _HERE[0].render(task)


def stop(run: str) -> None:
    """Let a run's tasks end on this worker, and its idle processes."""
    for here in _HERE:
        here.stop(run)
