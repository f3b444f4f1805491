"""A function over jobs on the workers of a Dask cluster: for what is not rendering of scenes, and needs no books."""

import queue
import threading
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from itertools import islice
from typing import Any, TypeVar

from pipelines.shared.cluster.cluster_config import ClusterChoice
from pipelines.shared.cluster.link import Link
from render.running.cluster_worker import Mismatch
from render.shared.errors import InputError

J = TypeVar("J")
R = TypeVar("R")
_ONE = threading.Lock()  # a job uses all threads of its worker, so a worker does one at a time


def mapped(
    choice: ClusterChoice, function: Callable[[J], R], jobs: Iterable[J], identity: Callable[[], object]
) -> Iterator[R]:
    """Yield what a function makes of jobs, in the order they end; two jobs a worker are out at a time.

    A job whose worker dies is done again by another, up to four times.

    Args:
        choice: The cluster.
        function: A function of a module.
        jobs: What it is called with; sent to the workers.
        identity: Tells what results depend on, as installed; a worker of which it says something else is refused.

    Raises:
        InputError: no scheduler, a worker that is refused, a job whose every worker died, or what the function raised.
    """
    link, remaining, here = Link(choice), iter(jobs), identity()
    out: dict[Any, Any] = {}
    back: queue.SimpleQueue[Any] = queue.SimpleQueue()
    try:
        while True:
            if link.client.status != "running":
                raise OSError("no answer")
            room = 2 * max(1, len(link.client.nthreads())) - len(out)
            for job in islice(remaining, max(0, room)):
                future = link.client.submit(_work, function, job, identity, here, pure=False)
                out[future.key] = future
                future.add_done_callback(back.put)
            if not out:
                return
            with suppress(queue.Empty):
                out.pop((future := back.get(timeout=1.0)).key)
                yield future.result()
    except InputError as error:
        raise InputError(
            f"--cluster {choice.name}: a worker {error}" if isinstance(error, Mismatch) else str(error)
        ) from error
    except Exception as error:
        if type(error).__module__.partition(".")[0] not in ("distributed", "dask") and not isinstance(error, OSError):
            raise
        said = (str(error).splitlines() or [""])[0]
        raise InputError(
            f"--cluster {choice.name}: lost the scheduler or a job's workers ({type(error).__name__}: {said}); "
            "run the same command again"
        ) from error
    finally:
        link.close()


def _work(function: Callable[[J], R], job: J, identity: Callable[[], object], wanted: object) -> R:
    """Do a job on a worker.

    Raises:
        Mismatch: the worker has something else installed.
    """
    if identity() != wanted:
        raise Mismatch("has other versions, code or files of one's own than this machine; make both the same")
    with _ONE:
        return function(job)
