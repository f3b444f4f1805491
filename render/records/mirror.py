"""A data folder in object storage, or a packed one anywhere, seen through a folder on this disk.

The folder, the mirror, holds the small files (manifest, ledger, reports), a listing of the shards, and as many of the
shards as `--cache-gb` allows, fetched when they are asked for; of a packed set whole tars are, and unpacked. All that
reads a data folder reads a mirror: it asks `shard_path` for a shard's file, and `select_rendered` for which there are.
"""

import json
import os
import shutil
import time
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, nullcontext, suppress
from functools import cached_property, lru_cache
from pathlib import Path
from typing import NamedTuple

from render.records.manifest import FAILED, MANIFEST, SceneSpec
from render.records.packs import PACK, Plan, read_plan, unpack_tar
from render.records.shards import file_hash, is_sealed
from render.shared.errors import InputError
from render.shared.files import atomic_path, parse_json, read_bytes, write_text
from render.shared.storage import TOGETHER, Missing, Store, Stored, address, local_copy

CACHE_GB = 20.0
LOG = "log"
SHARDS = "shards"
CHECKSUMS = "checksums.txt"
_STATE = ".storage.json"
_IN_USE = 60.0  # seconds for which a file of the cache is kept after it was asked for, even over the limit
_FAILURES = f"{LOG}/failed-"


class Damaged(InputError):
    """A shard in the store is not what was sent."""


class Mirror:
    """A data folder in a store and its place on this disk.

    Args:
        folder: The place.
        url: Address of the data folder.
        limit: Bytes of shards and decoded scenes to keep.
        objects: Listing of the data folder.
    """

    def __init__(self, folder: Path, url: str, limit: int, objects: dict[str, Stored]) -> None:
        self.folder, self.limit, self.objects = folder, limit, objects
        self.store = Store(url)
        self.sums: dict[str, str] = {}  # of the small files, as they are in the store

    def fetch(self, scene: SceneSpec) -> Path:
        """Return the file of a shard, whose digest was checked when it came."""
        path = self.folder / scene.file
        with suppress(OSError):
            os.utime(path)  # the cache forgets what was not used for longest
            return path
        name = self.holder(scene)
        assert name is not None, scene.file
        with _lock(self.folder / f".{name.replace('/', '-')}.lock", only=name != scene.file):
            if path.is_file():  # unpacked by another process meanwhile
                return path
            for id, data in self._shards(name, scene).items():
                with atomic_path(self.folder / SHARDS / f"{id}.exr") as temporary:
                    temporary.write_bytes(data)
        self._make_room()
        return path

    def _shards(self, name: str, scene: SceneSpec) -> dict[str, bytes]:
        """Return the shards of an object by scene, which is one shard or a tar."""
        for _ in range(2):  # damaged on the way: once more
            data = self.store.read(name)
            if name != scene.file:
                found = unpack_tar(data, self.plan[name])
                if found is not None:
                    return found
            elif is_sealed(data):
                return {scene.id: data}
        again = "render it again" if name == scene.file else "pack it again"
        raise Damaged(f"{self.store.url}/{name}: truncated or altered; remove it and {again}")

    @cached_property
    def plan(self) -> Plan:
        """The tars of a packed set that are there; none of a folder of shards."""
        tars = read_plan(self.folder) if PACK in self.objects else {}
        return {name: scenes for name, scenes in tars.items() if name in self.objects}

    @cached_property
    def tars(self) -> dict[str, str]:
        """The tar of every scene of a packed set."""
        return {id: name for name, scenes in self.plan.items() for id in scenes}

    def holder(self, scene: SceneSpec) -> str | None:
        """Return the object that holds a shard: itself or a tar; None where there is none."""
        return scene.file if scene.file in self.objects else self.tars.get(scene.id)

    def sizes(self) -> dict[str, int]:
        """Return the bytes of every shard in the store by scene id."""
        packed = {id: size for scenes in self.plan.values() for id, size in scenes.items()}
        return packed | {
            name[len(SHARDS) + 1 : -4]: what.size
            for name, what in self.objects.items()
            if name.startswith(f"{SHARDS}/") and name.endswith(".exr")
        }

    def _make_room(self) -> None:
        """Remove the files that were not used for longest, until the rest is within the limit."""
        files = []
        for name in (SHARDS, "cache"):
            for entry in os.scandir(self.folder / name) if (self.folder / name).is_dir() else ():
                # Shards that are not in the store yet must stay; another process may have removed a file meanwhile.
                known = name == "cache" or f"{name}/{entry.name}" in self.objects or entry.name[:-4] in self.tars
                if known and not entry.name.startswith("."):
                    with suppress(FileNotFoundError):
                        files.append((entry.stat(), entry.path))
        total = sum(status.st_size for status, _ in files)
        for status, path in sorted(files, key=lambda file: file[0].st_mtime):
            if total <= self.limit or status.st_mtime > time.time() - _IN_USE:
                return
            Path(path).unlink(missing_ok=True)
            total -= status.st_size

    def refresh(self) -> None:
        """Bring listing and small files up to date; forget what has been written again since."""
        before = self.objects
        self.objects = self._listing()
        stale = [name for name, what in before.items() if self.objects.get(name) != what]
        for name in stale:
            (self.folder / name).unlink(missing_ok=True)
        if PACK in stale:
            shutil.rmtree(self.folder / SHARDS, ignore_errors=True)
        small = [name for name in self.objects if "/" not in name or name.startswith(f"{LOG}/")]
        for path in self.folder.glob("*.*"):
            if path.is_file() and path.name not in self.objects and not path.name.startswith("."):
                path.unlink()
        with ThreadPoolExecutor(TOGETHER) as pool:
            list(pool.map(self._fetch_small, [name for name in small if not (self.folder / name).is_file()]))
        failures = sorted(name for name in small if name.startswith(_FAILURES))
        if failures:
            write_text(self.folder / FAILED, "".join(read_bytes(self.folder / name).decode() for name in failures))
        self._note()
        self.remember()

    def _fetch_small(self, name: str) -> None:
        data = self.store.read(name)
        with atomic_path(self.folder / name) as temporary:
            temporary.write_bytes(data)

    def _listing(self) -> dict[str, Stored]:
        """List the data folder; of a web server, what its `checksums.txt` names."""
        if not self.store.read_only:
            return self.store.files()
        try:
            rows = [line.split(maxsplit=1) for line in self.store.read(CHECKSUMS).decode().splitlines()]
        except Missing as error:
            if PACK in self.store.look([PACK]):
                self._fetch_small(PACK)
                return self.store.look([MANIFEST, PACK, *read_plan(self.folder)])
            raise InputError(
                f"{self.store.url}: no {CHECKSUMS} there, and a web server has no listing; write it with `sdps data "
                "card` before publishing, or name the data folder"
            ) from error
        sums = {name.lstrip("*"): sum for sum, name in rows}
        found = self.store.look([*sums, CHECKSUMS])
        return {name: Stored(size, sums.get(name, version)) for name, (size, version) in found.items()}

    def remember(self) -> None:
        """Write down the listing, for other processes and the next command."""
        state = {"url": self.store.url, "limit": self.limit, "objects": self.objects, "sums": self.sums}
        write_text(self.folder / _STATE, json.dumps(state))

    def publish(self) -> None:
        """Send the small files that are new or changed, and remove those that are gone."""
        names = {path.name for path in self.folder.glob("*.*") if path.is_file() and not path.name.startswith(".")}
        names -= {FAILED}  # in the store it is many objects, see `render.records.sending`
        gone = [name for name in self.objects if "/" not in name and name not in names]
        changed = {name: data for name in names if (data := self._changed(name)) is not None}
        if self.store.read_only or not (changed or gone):
            return
        for name, data in changed.items():
            if name == MANIFEST and not self.store.create(name, data) and self.store.read(name) != data:
                raise InputError(f"{self.store.url}/{name}: holds another plan; choose another --out")
            if name != MANIFEST:
                self.store.write(name, data)
        for name in gone:
            self.store.remove(name)
        sent = {name: Stored(len(data), "") for name, data in changed.items()}
        self.objects = {name: what for name, what in self.objects.items() if name not in gone} | sent
        self._note()
        self.remember()

    def _changed(self, name: str) -> bytes | None:
        """Return the bytes of a small file that is not in the store as it is here."""
        path = self.folder / name
        return None if name in self.objects and self.sums.get(name) == file_hash(path) else path.read_bytes()

    def _note(self) -> None:
        """Remember the small files as they are now: those that differ later are sent."""
        self.sums = {name: file_hash(self.folder / name) for name in self.objects if (self.folder / name).is_file()
                      and "/" not in name}  # fmt: skip


def mirror_of(folder: Path) -> Mirror | None:
    """Return the mirror that a folder is; None for a plain data folder."""
    try:
        status = os.stat(folder / _STATE)
    except (FileNotFoundError, NotADirectoryError):
        return None
    return _mirror_at(folder, status.st_mtime_ns, status.st_ino)


@lru_cache(maxsize=4)
def _mirror_at(folder: Path, _: int, __: int) -> Mirror:
    state = parse_json(read_bytes(folder / _STATE).decode())
    objects = {name: Stored(*values) for name, values in state["objects"].items()}
    mirror = Mirror(folder, state["url"], state["limit"], objects)
    mirror.sums = state["sums"]
    return mirror


@contextmanager
def open_folder(place: str | Path, cache_gb: float = CACHE_GB, purpose: str = "read") -> Iterator[Path]:
    """Yield a folder of this disk that stands for a data folder: itself, or a mirror of one in a store, or packed.

    What a command writes into the mirror apart from shards (a report, a card) is sent when it ends well.

    Raises:
        InputError: the store cannot be read; a cache of no size.
    """
    url = mirror_address(place)
    if url is None:
        yield Path(place)
        return
    if not cache_gb > 0:
        raise InputError(f"--cache-gb must be above 0, got {cache_gb:g}")
    folder = local_copy(url, purpose)
    with _lock_run(folder, url) if purpose == "run" else nullcontext():
        known = mirror_of(folder)
        mirror = Mirror(folder, url, round(cache_gb * 1e9), known.objects if known else {})
        mirror.refresh()
        if purpose == "run" and PACK in mirror.objects:
            raise InputError(f"{url}: holds a packed set, which is only read; choose another --out")
        if purpose != "run" and MANIFEST not in mirror.objects:
            raise InputError(f"{url}: no {MANIFEST} there; name a data folder, such as s3://bucket/run/data")
        yield folder
        publish(folder)


def mirror_address(place: str | Path) -> str | None:
    """Return the address of a data folder that is read through a mirror, which a packed one on this disk is, too."""
    return address(place) or (f"file://{Path(place).resolve()}" if (Path(place) / PACK).is_file() else None)


def publish(folder: Path) -> None:
    """Send what is new of a mirror's small files now."""
    mirror = mirror_of(folder)
    if mirror:
        mirror.publish()


@contextmanager
def _lock_run(folder: Path, url: str) -> Iterator[None]:
    """Hold a mirror that shards are rendered into; a second run on this machine would send the first one's shards."""
    folder.mkdir(parents=True, exist_ok=True)
    try:
        with _lock(folder / ".lock", wait=False):
            yield
    except BlockingIOError as error:
        raise InputError(
            f"{url}: another run on this machine renders into it; wait for it, or give this one a cache of its own "
            "(SDPS_CACHE=FOLDER)"
        ) from error


@contextmanager
def _lock(path: Path, *, wait: bool = True, only: bool = True) -> Iterator[None]:
    """Hold a lock among the processes of this machine; with `only` false, or on Windows, hold none.

    Raises:
        BlockingIOError: with `wait` false, another process holds it.
    """
    try:
        import fcntl
    except ImportError:
        only = False
    if not only:
        yield
        return
    with open(path, "w") as handle:
        fcntl.flock(handle, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
        yield


def display_name(folder: Path, *, written: bool = False) -> str:
    """Return what to call a data folder: its path, or its address unless what is meant is written where none can be."""
    mirror = mirror_of(folder)
    return mirror.store.url if mirror and not (written and mirror.store.read_only) else str(folder)


def shard_path(folder: Path, scene: SceneSpec) -> Path:
    """Return the file of a scene's shard, fetched where the folder is a mirror; it need not exist where it is not.

    Raises:
        InputError: the store cannot be read; `Damaged`: what it holds is not whole.
    """
    mirror = mirror_of(folder)
    return mirror.fetch(scene) if mirror and mirror.holder(scene) else folder / scene.file


def touch_files(folder: Path, *paths: Path) -> bool:
    """Return whether files made of shards are all there; in a mirror they are then kept for another minute at least."""
    if mirror_of(folder) is None:
        return all(path.is_file() for path in paths)
    try:
        for path in paths:
            os.utime(path)
    except FileNotFoundError:
        return False
    return True


def select_rendered(folder: str | Path, scenes: Iterable[SceneSpec]) -> list[SceneSpec]:
    """Return the scenes that have a shard."""
    folder = Path(folder)
    mirror = mirror_of(folder)
    if mirror:
        return [scene for scene in scenes if mirror.holder(scene) or (folder / scene.file).is_file()]
    return [scene for scene in scenes if (folder / scene.file).is_file()]


def measure_stored(folder: Path, scene: SceneSpec) -> tuple[int, str]:
    """Return a shard's bytes and what distinguishes it from one written later.

    Raises:
        FileNotFoundError: there is no such shard.
    """
    mirror = mirror_of(folder)
    if mirror and (name := mirror.holder(scene)):
        size, version = mirror.objects[name]
        return (size if name == scene.file else mirror.plan[name][scene.id]), version
    status = (folder / scene.file).stat()
    return status.st_size, str(status.st_mtime_ns)


class Packed(NamedTuple):
    """How scenes of a packed set are stored and kept: the tar of each, the bytes of their shards, and the cache's."""

    tars: list[str]
    size: int
    limit: int


def describe_packing(folder: Path, scenes: Sequence[SceneSpec]) -> Packed | None:
    """Return how finished scenes are packed; None where they are files or objects of their own."""
    mirror = mirror_of(folder)
    if mirror is None or not mirror.tars:
        return None
    tars = [mirror.tars[scene.id] for scene in scenes]
    sizes = (mirror.plan[tar][scene.id] for tar, scene in zip(tars, scenes, strict=True))
    return Packed(tars, sum(sizes), mirror.limit)
