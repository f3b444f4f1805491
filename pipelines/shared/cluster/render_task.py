"""What a worker of a Dask cluster runs for us; it has one station, whoever asks."""

import threading
from pathlib import Path

from render.running.station import Rendered, Station, Task

_HERE: list[Station] = []
_LOCK = threading.Lock()


def station() -> Station:
    """Return the station of this worker; its memory and place are those Dask gives."""
    from distributed import get_worker

    with _LOCK:
        if not _HERE:
            worker = get_worker()
            memory = int(getattr(worker.memory_manager, "memory_limit", 0) or 0)
            _HERE.append(Station(Path(worker.local_directory) / "sdps", memory // max(1, worker.state.nthreads)))
    return _HERE[0]


def render_task(task: Task) -> tuple[str, Rendered]:
    """Render a chunk; return who did, and what came of it."""
    from distributed import get_worker

    return get_worker().address, station().render(task)


def stop(run: str) -> None:
    """Let a run's tasks end on this worker, and its idle processes."""
    for here in _HERE:
        here.stop(run)
