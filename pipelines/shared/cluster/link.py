"""The connection to a Dask cluster: opened, opened again when it broke, and closed with all that was started for it."""

import importlib
import logging
import shutil
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import TYPE_CHECKING, Any

from pipelines.shared.cluster.cluster_config import BATCH, KUBERNETES, ClusterChoice
from render.planning import budget
from render.shared.errors import InputError

if TYPE_CHECKING:
    from distributed import Client

ANSWER = 10.0  # seconds within which a scheduler answers


class Link:
    """A cluster and the client that speaks to it.

    Args:
        choice: The cluster.

    Raises:
        InputError: a package or command that is missing, a scheduler that does not answer, or a bad configuration.
    """

    def __init__(self, choice: ClusterChoice) -> None:
        self.choice = choice
        distributed = _import("distributed", "distributed", "sdps[cluster]")
        logging.getLogger("distributed").setLevel(logging.CRITICAL)  # we report what matters ourselves
        self._client_class = distributed.Client
        self.cluster = self._start()
        try:
            self.client = self.connect()
        except InputError:
            self.close()
            raise

    def connect(self) -> "Client":
        """Return a new client.

        Raises:
            InputError: no scheduler answers.
        """
        place = self.cluster if self.cluster is not None else self.choice.name
        try:
            # Shards come from the workers directly, where this machine reaches them, and else by the scheduler.
            client = self._client_class(place, timeout=ANSWER, direct_to_workers=True, set_as_default=False)
        except (OSError, ValueError) as error:
            raise InputError(
                f"--cluster {self.choice.name}: no Dask scheduler answers there "
                f"({(str(error).splitlines() or [type(error).__name__])[0]}); "
                "start one with `dask scheduler`, or correct the address"
            ) from error
        self.client = client
        return client

    def slots(self) -> int:
        """Return the tasks that the workers present take at a time."""
        return sum(self.client.nthreads().values())

    def expected(self) -> int:
        """Return the tasks that the workers will take at a time once all are there, as far as is known."""
        job = self.choice.config.job
        # The cores of a job are slots, however many Dask processes share them.
        ask = self.choice.config.jobs * int(job.get("cores", 1)) if self.choice.name in BATCH else self.choice.local
        return max(1, ask, self.slots())

    def close(self) -> None:
        """Close the client, and end the workers that were started here."""
        for thing in (getattr(self, "client", None), self.cluster):
            if thing is not None:
                with suppress(Exception):  # a cluster that is gone is closed
                    thing.close(timeout=ANSWER)

    def _start(self) -> Any:
        """Start the workers, unless they are there; return the cluster object, if one was made."""
        choice = self.choice
        if choice.local:
            memory = max(budget.available_memory() // choice.local, budget.GIBIBYTE)
            with _without_ctrl_c():
                return importlib.import_module("distributed").LocalCluster(
                    n_workers=choice.local, threads_per_worker=1, memory_limit=memory, dashboard_address=":0",
                    silence_logs=logging.CRITICAL,
                )  # fmt: skip
        if choice.name in BATCH:
            kind, command = BATCH[choice.name]
            with _without_ctrl_c():  # its import takes Ctrl-C for itself
                jobqueue = _import("dask_jobqueue", "dask-jobqueue", "sdps[cluster]")
            if shutil.which(command) is None:
                raise InputError(
                    f"--cluster {choice.name}: no command {command} here; run this where jobs are submitted"
                )
            cluster = self._make(getattr(jobqueue, kind), choice.config.job)
            cluster.scale(jobs=choice.config.jobs)
            return cluster
        if choice.name == KUBERNETES:
            operator = _import("dask_kubernetes.operator", "dask-kubernetes", "dask-kubernetes")
            return self._make(operator.KubeCluster, {"n_workers": choice.config.jobs} | choice.config.job)
        return None

    def _make(self, kind: Any, arguments: dict[str, Any]) -> Any:
        """Make a cluster, whose own complaints about its arguments become one line."""
        try:
            return kind(**arguments)
        except Exception as error:  # each batch system has its own
            said = (str(error).splitlines() or [type(error).__name__])[0]
            raise InputError(f"{self.choice.file}: job: {said}; see the documentation of {kind.__name__}") from error


@contextmanager
def _without_ctrl_c() -> Iterator[None]:
    """Let processes that are started inside ignore Ctrl-C, which reaches the whole group; this one decides."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


def _import(name: str, package: str, install: str) -> Any:
    """Import a package that only clusters need.

    Raises:
        InputError: it is not installed.
    """
    try:
        return importlib.import_module(name)
    except ImportError as error:
        python = f"{sys.executable} -m " if sys.executable else ""
        raise InputError(f"--cluster needs the package {package}: {python}pip install '{install}'") from error
