"""Rendering a chunk for a run on another machine: what a worker of a cluster does, whatever engine brings it the task.

A station keeps its rendering process from one task to the next, so that kernels are compiled once, and supervises it as
a local run does: a crash or a hang costs one view, never the worker. Shards return as bytes; nothing is shared.
"""

import hashlib
import shutil
import tempfile
import threading
from collections.abc import Callable, Iterable, Sequence
from contextlib import AbstractContextManager, nullcontext
from functools import cache, lru_cache
from pathlib import Path
from typing import NamedTuple

import assets
from render.backend import variant
from render.materials import library
from render.materials.textures import map_names
from render.planning import provenance
from render.planning.chunks import Chunk
from render.planning.composition import components
from render.records.manifest import SceneSpec
from render.records.shards import file_hash
from render.running.crew import LocalCrew, News
from render.running.isolation import serve
from render.running.messages import Done, Fatal
from render.shared.errors import InputError
from render.shared.files import source_digest

_FILE = "file "  # before the path of what is no part of the package
IDLE = 60.0  # seconds after which a process without work ends: its run may be gone


class Task(NamedTuple):
    """What a worker is given.

    Attributes:
        run: Name of the run, for `stop`.
        chunk: What to render.
        digest: Of the manifest lines of its scenes, as planned.
        needs: What the worker must have (`needed`).
        timeout: Seconds without a finished scene after which the process is stopped.
        commit: The run's commit, for the shards' headers: workers of the same code may be no checkouts.
        serve: What the rendering process runs.
    """

    run: str
    chunk: Chunk
    digest: str
    needs: dict[str, str]
    timeout: float
    commit: str
    serve: Callable[..., None] = serve


class Rendered(NamedTuple):
    """What came of a chunk: news in order, and the bytes of the shards by scene id."""

    news: list[News]
    shards: dict[str, bytes]


class Mismatch(InputError):
    """The worker would render something else than was planned."""


@cache
def installed() -> dict[str, str]:
    """Return what decides the bytes of shards, as installed here: versions, code, fitted materials."""
    found = {name: version for name, version in provenance.versions().items() if name != "python"}
    materials = hashlib.sha256()
    folder = Path(str(assets.__file__)).parent / "materials"
    for path in sorted(folder.rglob("*.yaml")):
        materials.update(path.relative_to(folder).as_posix().encode() + path.read_bytes())
    code = source_digest(Path(__file__).parent.parent)
    return found | {"code of the renderer": code, "fitted materials": materials.hexdigest()[:12]}


def needed(shapes: Iterable[str], materials: Iterable[str]) -> dict[str, str]:
    """Return what is `installed`, and {path: hash} of the meshes, material files and folders of maps that names are."""
    from render.shapes import registry  # loads what meshes need

    parts = {part for material in set(materials) for part in components(material)}
    places = {*map(registry.own_file, shapes), *map(library.own_file, parts)}
    return installed() | {f"{_FILE}{place}": _content(place) for place in places if place is not None}


def _content(place: Path) -> str:
    """Return the first digits of the hash of a file, or of a folder of maps."""
    try:
        files = map_names.find(place).paths if place.is_dir() else (place,)
        states = [(str(file), (state := file.stat()).st_mtime_ns, state.st_size) for file in files]
        return _hashed(tuple(states))
    except (OSError, InputError):
        return "missing"


@lru_cache(maxsize=4096)
def _hashed(files: tuple[tuple[str, int, int], ...]) -> str:
    """Return one hash of files, given with time of change and size, which tell when to read them again."""
    whole = hashlib.sha256()
    for path, _, _ in files:
        whole.update(Path(path).name.encode() + bytes.fromhex(file_hash(path)))
    return whole.hexdigest()[:12]


@cache
def _commit() -> str:
    return provenance.commit()


def _needs(chunk: Chunk) -> dict[str, str]:
    return needed([chunk.shape], (scene.material for group in chunk.groups for scene in group))


def lines_digest(scenes: Sequence[SceneSpec]) -> str:
    """Return one hash of manifest lines."""
    return hashlib.sha256("".join(scene.digest() for scene in scenes).encode()).hexdigest()


def task_of(run: str, chunk: Chunk, timeout: float, serve: Callable[..., None] = serve) -> Task:
    """Return the task of a chunk, with what a worker must agree on."""
    return Task(run, chunk, lines_digest(chunk.scenes()), _needs(chunk), timeout, _commit(), serve)


def check(task: Task) -> None:
    """Refuse a task that would give other bytes here.

    Raises:
        Mismatch: the first thing that differs.
    """
    here = _needs(task.chunk)
    for name, there in task.needs.items():
        if (found := here.get(name, "missing")) != there:
            remedy = "put it under the same path there" if name.startswith(_FILE) else "install the same sdps on both"
            raise Mismatch(f"has {name} {found}, the run {there}; {remedy}")
    if lines_digest(task.chunk.scenes()) != task.digest:
        raise Mismatch("reads the plan otherwise than it was written; install the same sdps on both")


class Station:
    """The rendering processes of a worker, one per task at a time, kept while there is work.

    Where there is a GPU, tasks take turns on it: side by side they would fill its memory.

    Args:
        folder: Folder for what is on its way.
        memory: Bytes of memory each process may take; 0: any.
    """

    def __init__(self, folder: Path, memory: int = 0) -> None:
        self.folder, self.memory = folder, memory
        self.idle: dict[LocalCrew, threading.Timer] = {}
        self.lock, self.gpu = threading.Lock(), threading.Lock()
        self.stopped: set[str] = set()

    def render(self, task: Task) -> Rendered:
        """Render a chunk, if its run was not stopped.

        Raises:
            Mismatch: this machine would give other bytes.
        """
        check(task)
        with self._turn():
            return self._rendered(task)

    def _turn(self) -> AbstractContextManager[object]:
        return self.gpu if variant.choose().variant == "cuda_ad_rgb" else nullcontext()

    def _rendered(self, task: Task) -> Rendered:
        crew = self._borrow(task)
        news: list[News] = []
        try:
            crew.give([task.chunk])
            while crew.busy() and task.run not in self.stopped:
                step = crew.step()
                news += step
                if any(isinstance(item, Fatal) for item in step):
                    break  # what concerns the whole run
            ended = not crew.busy()
            shards = {item.line["id"]: self._collect(crew, item) for item in news if isinstance(item, Done)}
        except BaseException:
            self._remove(crew)
            raise
        if ended:
            self._give_back(crew)
        else:
            self._remove(crew)
        return Rendered(news, shards)

    def stop(self, run: str) -> None:
        """Let the tasks of a run end, those under way within about a second, and the idle processes."""
        self.stopped.add(run)
        self.dismiss()

    def dismiss(self) -> None:
        """End the idle processes."""
        with self.lock:
            idle, self.idle = self.idle, {}
        for crew, timer in idle.items():
            timer.cancel()
            self._remove(crew)

    def _borrow(self, task: Task) -> LocalCrew:
        with self.lock:
            for crew in self.idle:
                if crew.serve is task.serve and crew.commit == task.commit:
                    self.idle.pop(crew).cancel()
                    crew.timeout = task.timeout
                    return crew
        self.folder.mkdir(parents=True, exist_ok=True)
        folder = Path(tempfile.mkdtemp(prefix="sdps-", dir=self.folder))
        return LocalCrew(
            folder, folder, workers=1, timeout=task.timeout, threads=1, memory=self.memory, serve=task.serve,
            commit=task.commit,
        )  # fmt: skip

    def _give_back(self, crew: LocalCrew) -> None:
        timer = threading.Timer(IDLE, self._expire, [crew])
        timer.daemon = True
        with self.lock:
            self.idle[crew] = timer
        timer.start()

    def _expire(self, crew: LocalCrew) -> None:
        """End a process whose timer ran out, unless it has worked meanwhile: it has another timer, or none, then."""
        with self.lock:
            if self.idle.get(crew) is not threading.current_thread():
                return
            del self.idle[crew]
        self._remove(crew)

    @staticmethod
    def _collect(crew: LocalCrew, done: Done) -> bytes:
        """Return the bytes of a shard and remove its file."""
        path = crew.folder / "shards" / f"{done.line['id']}.exr"
        data = path.read_bytes()
        path.unlink()
        return data

    @staticmethod
    def _remove(crew: LocalCrew) -> None:
        crew.close()
        shutil.rmtree(crew.folder, ignore_errors=True)
