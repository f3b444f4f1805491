"""Training whose data, checkpoints and weights lie in object storage: copies on this disk, sent after every save."""

import logging
import os
import shutil
from collections.abc import Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from render.records.mirror import mirror_address, open_folder
from render.shared.errors import InputError
from render.shared.files import atomic_path
from render.shared.storage import Store, address, local_copy

if TYPE_CHECKING:
    from sdps.training.distributed import Team

_UNSENT = ".unsent"
_log = logging.getLogger(__name__)


def _first_of_machine() -> bool:
    """Return whether this process is the one of its machine that fetches for the others."""
    return os.environ.get("LOCAL_RANK", "0") == "0"


@contextmanager
def data_folder(place: Path, cache_gb: float, here: "Team") -> Iterator[Path]:
    """Yield the data folder, or this machine's mirror of it, which its first process opens.

    Raises:
        InputError: the store cannot be read.
    """
    url = mirror_address(place)
    if url is None or _first_of_machine():
        with open_folder(place, cache_gb) as folder:
            here.wait()
            yield folder
    else:
        here.wait()
        yield local_copy(url, "read")


class StoredRuns:
    """The `models` folder of an output folder, which may lie in a store.

    The leader sends what changed after every checkpoint, in a thread. A store that is away does not stop training: the
    next checkpoint is another try, and what could not be sent in the end is sent by the next start.

    Args:
        out: Output folder, or the address of one.
        models: Name of the folder of runs in it.
        here: The processes that train.
    """

    def __init__(self, out: Path, models: str, here: "Team") -> None:
        url = address(out)
        self.here, self.models = here, models
        self.folder = local_copy(url, "train") if url else out
        self.store = Store(f"{url}/{models}") if url else None
        self._sent: dict[Path, tuple[int, int]] = {}
        self._thread = ThreadPoolExecutor(1, thread_name_prefix="checkpoints")
        self._sending: Future[None] | None = None

    def fetch(self, names: Sequence[str]) -> None:
        """Bring runs here as the store has them, on every machine, before one of them resumes.

        Raises:
            InputError: the store cannot be read.
        """
        if self.store is None:
            return
        if self.here.leads:
            for name in names:
                if (self._run(name) / _UNSENT).exists():
                    self.send(name, wait=True)
        self.here.wait()
        if _first_of_machine():
            objects = self.store.files()
            for name in names:
                shutil.rmtree(self._run(name), ignore_errors=True)
                for key in [key for key in objects if key.startswith(f"{name}/")]:
                    path = self.folder / self.models / key
                    with atomic_path(path) as temporary:
                        temporary.write_bytes(self.store.read(key))
                    self._sent[path] = _state(path)
        self.here.wait()

    def send(self, name: str, *, wait: bool = False) -> None:
        """Send what changed of a run; with `wait`, return when it is there.

        Raises:
            InputError: with `wait`: the store refused it or stayed away.
        """
        if self.store is None or not self.here.leads:
            return
        folder = self._run(name)
        (folder / _UNSENT).touch()
        if wait and self._sending is not None:
            self._sending.exception()
        if not wait and self._sending is not None and not self._sending.done():
            return  # still busy with the last; the next checkpoint takes this one's place
        self._sending = self._thread.submit(self._send, folder)
        if wait:
            self._sending.result()

    def _send(self, folder: Path) -> None:
        assert self.store is not None
        try:
            for path in sorted(path for path in folder.rglob("*") if path.is_file() and not path.name.startswith(".")):
                state = _state(path)
                if self._sent.get(path) != state:
                    self.store.write(str(path.relative_to(self.folder / self.models)), path.read_bytes())
                    self._sent[path] = state
        except InputError as error:
            _log.warning("%s", error)
            raise
        (folder / _UNSENT).unlink(missing_ok=True)

    def _run(self, name: str) -> Path:
        return self.folder / self.models / name

    def shown(self, text: str) -> str:
        """Return a text with the places on this disk replaced by their addresses."""
        return text.replace(str(self.folder / self.models), self.store.url) if self.store else text


def _state(path: Path) -> tuple[int, int]:
    status = path.stat()
    return status.st_size, status.st_mtime_ns
