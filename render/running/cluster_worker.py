"""What a worker of a cluster does with a task, whichever engine brings it: render a chunk for a run on another machine.

It keeps its rendering process from one task to the next, so that kernels are compiled once, and watches it as a local
run does: a crash or a hang costs one view, never the worker. Shards return as bytes; nothing is shared.
"""

import hashlib
import shutil
import tempfile
import threading
import time
from collections.abc import Callable, Iterable
from functools import cache, lru_cache
from pathlib import Path
from typing import NamedTuple

import assets
from render.backend import variant
from render.materials import library
from render.materials.textures import map_names
from render.planning import provenance
from render.planning.chunks import Chunk
from render.planning.plan_counts import components
from render.records.shards import file_hash
from render.running.protocol import Fatal, Outcome, Result
from render.running.worker_pool import LocalPool
from render.running.worker_process import serve
from render.shared.errors import InputError
from render.shared.files import source_digest

_FILE = "file "  # before the path of what is not part of the package
IDLE = 60.0  # seconds after which a process without work ends: its run may be gone


class Task(NamedTuple):
    """What a worker is given.

    Attributes:
        run: Name of the run, for `stop`.
        chunk: What to render.
        needs: What the worker must have (`requirements`).
        timeout: Seconds without a finished scene after which the process is stopped.
        commit: The run's commit, for the shards' headers: workers may have the same code outside a checkout.
        serve: What the rendering process runs.
    """

    run: str
    chunk: Chunk
    needs: dict[str, str]
    timeout: float
    commit: str
    serve: Callable[..., None] = serve


class TaskResult(NamedTuple):
    """What came of a task: outcomes in order, and the bytes of the shards by scene id."""

    outcomes: list[Outcome]
    shards: dict[str, bytes]


class Mismatch(InputError):
    """The worker would render something else than was planned."""


@cache
def describe_installation() -> dict[str, str]:
    """Return what decides the bytes of shards, as installed here: versions, code, fitted materials."""
    found = {name: version for name, version in provenance.versions().items() if name != "python"}
    materials = hashlib.sha256()
    folder = Path(str(assets.__file__)).parent / "materials"
    for path in sorted(folder.rglob("*.yaml")):
        materials.update(path.relative_to(folder).as_posix().encode() + path.read_bytes())
    code = source_digest(Path(__file__).parent.parent)
    return found | {"code of the renderer": code, "fitted materials": materials.hexdigest()[:12]}


def requirements(shapes: Iterable[str], materials: Iterable[str]) -> dict[str, str]:
    """Return what is `installed`, and {path: hash} of the meshes, material files and folders of maps that names are."""
    from render.shapes import registry  # loads what meshes need

    parts = {part for material in set(materials) for part in components(material)}
    places = {*map(registry.own_file, shapes), *map(library.own_file, parts)}
    return describe_installation() | {f"{_FILE}{place}": _content_hash(place) for place in places if place is not None}


def _content_hash(place: Path) -> str:
    """Return the first digits of the hash of a file, or of a folder of maps."""
    try:
        files = map_names.find(place).paths if place.is_dir() else (place,)
        states = [(str(file), (state := file.stat()).st_mtime_ns, state.st_size) for file in files]
        return _hash(tuple(states))
    except (OSError, InputError):
        return "missing"


@lru_cache(maxsize=4096)
def _hash(files: tuple[tuple[str, int, int], ...]) -> str:
    """Return one hash of files; time of change and size, given with each, decide when they are read again."""
    whole = hashlib.sha256()
    for path, _, _ in files:
        whole.update(Path(path).name.encode() + bytes.fromhex(file_hash(path)))
    return whole.hexdigest()[:12]


@cache
def _commit() -> str:
    return provenance.commit()


def _requirements_of(chunk: Chunk) -> dict[str, str]:
    return requirements([chunk.shape], (scene.material for group in chunk.groups for scene in group))


def make_task(run: str, chunk: Chunk, timeout: float, serve: Callable[..., None] = serve) -> Task:
    """Return the task of a chunk, with what a worker must agree on."""
    return Task(run, chunk, _requirements_of(chunk), timeout, _commit(), serve)


def check(task: Task) -> None:
    """Refuse a task that would give other bytes here.

    Raises:
        Mismatch: the first thing that differs.
    """
    here = _requirements_of(task.chunk)
    for name, there in task.needs.items():
        if (found := here.get(name, "missing")) != there:
            remedy = "put it under the same path there" if name.startswith(_FILE) else "install the same sdps on both"
            raise Mismatch(f"has {name} {found}, the run {there}; {remedy}")


class ClusterWorker:
    """The rendering processes of a worker, one per task at a time, kept while there is work.

    Where there is a GPU, tasks take turns on it: together they would fill its memory.

    Args:
        folder: Folder for shards on their way.
        memory: Bytes of memory each process may take; 0: any.
    """

    def __init__(self, folder: Path, memory: int = 0) -> None:
        self.folder, self.memory = folder, memory
        self.idle: list[tuple[float, LocalPool]] = []  # since when
        self.lock, self.gpu = threading.Lock(), threading.Lock()
        self.stopped: set[str] = set()

    def render(self, task: Task) -> TaskResult:
        """Render a chunk, if its run was not stopped.

        Raises:
            Mismatch: this machine would give other bytes.
        """
        check(task)
        if variant.choose().variant == "cuda_ad_rgb":
            with self.gpu:
                return self._render(task)
        return self._render(task)

    def _render(self, task: Task) -> TaskResult:
        pool = self._borrow(task)
        outcomes: list[Outcome] = []
        reusable = False
        try:
            pool.submit([task.chunk])
            while pool.busy() and task.run not in self.stopped:
                outcomes += pool.poll()
                if any(isinstance(outcome, Fatal) for outcome in outcomes):
                    break  # it concerns the whole run
            shards = {item.line["id"]: _collect(pool, item) for item in outcomes if isinstance(item, Result)}
            reusable = not pool.busy()
        finally:
            if reusable:
                self._keep(pool)
            else:
                _remove(pool)
        return TaskResult(outcomes, shards)

    def stop(self, run: str) -> None:
        """Let the tasks of a run end, those under way within about a second, and the idle processes."""
        self.stopped.add(run)
        self.dismiss()

    def dismiss(self, after: float = 0.0) -> None:
        """End the processes that have been idle for some seconds."""
        with self.lock:
            ended = [pool for since, pool in self.idle if time.monotonic() - since >= after]
            self.idle = [(since, pool) for since, pool in self.idle if pool not in ended]
        for pool in ended:
            _remove(pool)

    def _borrow(self, task: Task) -> LocalPool:
        """Return an idle process that fits a task, or a new one."""
        with self.lock:
            for entry in self.idle:
                pool = entry[1]
                if pool.serve is task.serve and pool.commit == task.commit:
                    self.idle.remove(entry)
                    pool.timeout = task.timeout
                    return pool
        self.folder.mkdir(parents=True, exist_ok=True)
        folder = Path(tempfile.mkdtemp(prefix="sdps-", dir=self.folder))
        return LocalPool(
            folder, folder, workers=1, timeout=task.timeout, threads=1, memory=self.memory, serve=task.serve,
            commit=task.commit,
        )  # fmt: skip

    def _keep(self, pool: LocalPool) -> None:
        """Keep a process for the next task, and see to it that it ends if none comes."""
        with self.lock:
            self.idle.append((time.monotonic(), pool))
        timer = threading.Timer(IDLE, self.dismiss, [0.99 * IDLE])
        timer.daemon = True
        timer.start()


def _collect(pool: LocalPool, result: Result) -> bytes:
    """Return the bytes of a shard and remove its file."""
    assert pool.folder is not None
    path = pool.folder / "shards" / f"{result.line['id']}.exr"
    data = path.read_bytes()
    path.unlink()
    return data


def _remove(pool: LocalPool) -> None:
    pool.close()
    shutil.rmtree(pool.errors, ignore_errors=True)
