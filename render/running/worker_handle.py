"""A rendering process as its parent sees it: what it was given, since when, and how it ended."""

import multiprocessing
import os
import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from multiprocessing.connection import Connection
from typing import Any

from render.planning.chunks import Chunk
from render.records.ledger import is_finished
from render.running.protocol import Failure, Fatal, Finished, Message, Ready, Result, Started, WorkerConfig
from render.running.worker_process import TAIL

_STARTING = threading.Lock()


class WorkerHandle:
    """A rendering process and what it is working on.

    Args:
        serve: What the process runs, a module-level function.
        config: What it is started with.
    """

    def __init__(self, serve: Callable[[Connection, WorkerConfig], None], config: WorkerConfig) -> None:
        context = multiprocessing.get_context("spawn")  # forking would copy the state of a started backend
        self.connection, theirs = context.Pipe()
        self.config = config
        self.process = context.Process(target=serve, args=(theirs, config), daemon=True)
        with _children_allowed():
            self.process.start()
        theirs.close()
        self.ready, self.busy, self.rendered = False, False, 0
        self.given: Chunk | None = None
        self.left: Chunk | None = None  # of the chunk it works on
        self.current: tuple[str, ...] = ()
        self.since = self.view_start = time.monotonic()

    def assign(self, chunk: Chunk) -> None:
        """Give it a chunk to render."""
        self.given = self.left = chunk
        self.busy, self.since = True, time.monotonic()
        with suppress(OSError):  # if it is dead, reading shows it
            self.connection.send(chunk)

    def receive(self) -> Message | None:
        """Read a message; None where it is damaged, or about scenes or shards that are not those it was given.

        Raises:
            EOFError, OSError: the process has ended.
        """
        try:
            message = self.connection.recv()
        except (EOFError, OSError):
            raise
        except Exception:  # unpickling may raise anything
            return None
        try:
            return message if self._is_sound(message) else None
        except (TypeError, ValueError, KeyError, AttributeError, OSError):
            return None

    def _is_sound(self, message: Any) -> bool:
        """Return whether a sound process can send this; values of a wrong type may raise."""
        given = self.left.wanted if self.left else frozenset()
        match message:
            case Ready() | Finished() | Fatal():
                return True
            case Started(ids) | Failure(ids):
                return set(ids) <= given
            case Result(line, arrays) if line["id"] in given and self.left:
                scene = next(scene for scene in self.left.scenes() if scene.id == line["id"])
                size = line["bytes"]
                if self.config.folder is None:
                    size = sum(array.nbytes for array in arrays or ())
                elif (path := self.config.folder / scene.file).parent.is_dir():  # or the folder is gone
                    size = path.stat().st_size
                return (line["spec"], line["bytes"]) == (scene.digest(), size) and is_finished(line)
        return False

    def find_blamed(self) -> tuple[str, ...]:
        """Return the scenes it was at when it ended; if it had not begun its chunk, those of the first view."""
        if self.current or not self.left or self.left is not self.given:
            return self.current
        view = self.left.groups[0]
        return tuple(scene.id for scene in view if scene.id in self.left.wanted)

    def tick_off(self, id: str) -> None:
        """Note that a scene is done or failed."""
        self.left = self.left.without([id]) if self.left else None
        self.current = tuple(other for other in self.current if other != id)

    def dismiss(self) -> None:
        """Let an idle process end."""
        with suppress(OSError):
            self.connection.send(None)
        self.process.join(5)

    def abort(self) -> None:
        """Stop a process that hangs; its fault handler first writes where it hung."""
        if self.process.pid is not None:
            with suppress(OSError):
                os.kill(self.process.pid, signal.SIGABRT)
        self.process.join(2)
        if self.process.is_alive():
            self.process.kill()

    def terminate(self) -> None:
        """Tell the process to end; one that has nothing to clean up ends at once."""
        if self.config.folder is None:
            self.process.kill()
        else:
            self.process.terminate()

    def close(self) -> None:
        """Wait a little for a process that is ending, then kill it."""
        self.process.join(5)
        if self.process.is_alive():
            self.process.kill()
            self.process.join()
        self.connection.close()

    def exit_reason(self) -> str:
        """Say how the process ended."""
        self.process.join()
        code = self.process.exitcode or 0
        return f"worker died, signal {-code}" if code < 0 else f"worker died, exit code {code}"

    def stderr_tail(self) -> str:
        """Return the tail of its standard error."""
        with suppress(OSError):
            text = self.config.errors.read_text(encoding="utf-8", errors="replace")
            return "\n".join(text.splitlines()[-TAIL:])
        return ""


@contextmanager
def _children_allowed() -> Iterator[None]:
    """Let a daemon start processes, which multiprocessing forbids lest they outlive it.

    A worker of Dask is a daemon of its nanny. Our processes end with their parent, killed or not
    (`render.running.worker_process`).
    """
    config = vars(multiprocessing.current_process())["_config"]
    with _STARTING:
        daemon = config.pop("daemon", None)
        try:
            yield
        finally:
            if daemon is not None:
                config["daemon"] = daemon
