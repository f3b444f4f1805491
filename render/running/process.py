"""A rendering process as its parent sees it: what it was given, since when, and how it ended."""

import multiprocessing
import os
import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

from render.planning.chunks import Chunk
from render.records.ledger import is_finished
from render.running.isolation import TAIL
from render.running.messages import Begun, Done, Ended, Failed, Fatal, Message, Ready, WorkerConfig

_STARTING = threading.Lock()


class Worker:
    """A rendering process and what it is working on."""

    def __init__(self, serve: Callable[[Connection, WorkerConfig], None], config: WorkerConfig) -> None:
        context = multiprocessing.get_context("spawn")  # forking would copy the state of a started backend
        self.connection, theirs = context.Pipe()
        self.errors = config.errors
        self.process = context.Process(target=serve, args=(theirs, config), daemon=True)
        with _may_have_children():
            self.process.start()
        theirs.close()
        self.ready, self.busy, self.rendered = False, False, 0
        self.given: Chunk | None = None
        self.left: Chunk | None = None  # of the chunk it works on
        self.current: tuple[str, ...] = ()
        self.since = self.view_start = time.monotonic()

    def take(self, chunk: Chunk) -> None:
        """Give it a chunk to render."""
        self.given = self.left = chunk
        self.busy, self.since = True, time.monotonic()
        with suppress(OSError):  # if it is dead, reading tells
            self.connection.send(chunk)

    def hear(self, folder: Path) -> Message | None:
        """Read a message; None where it is none, or tells of scenes or shards that are not those it was given.

        Raises:
            EOFError, OSError: the process has ended.
        """
        try:
            message = self.connection.recv()
        except (EOFError, OSError):
            raise
        except Exception:  # whatever unpickling raises
            return None
        try:
            return message if self._may_say(message, folder) else None
        except (TypeError, ValueError, KeyError, AttributeError, OSError):
            return None

    def _may_say(self, message: Any, folder: Path) -> bool:
        """Tell whether a sound process can send this; values of a wrong type may raise."""
        given = self.left.wanted if self.left else frozenset()
        match message:
            case Ready() | Ended() | Fatal():
                return True
            case Begun(ids) | Failed(ids):
                return set(ids) <= given
            case Done(line) if line["id"] in given and self.left:
                scene = next(scene for scene in self.left.scenes() if scene.id == line["id"])
                path = folder / scene.file
                there = path.stat().st_size if path.parent.is_dir() else line["bytes"]  # or the folder is gone
                return (line["spec"], line["bytes"]) == (scene.digest(), there) and is_finished(line)
        return False

    def to_blame(self) -> tuple[str, ...]:
        """Return the scenes it was at when it ended; where it had not begun its chunk, those of the first view."""
        if self.current or not self.left or self.left is not self.given:
            return self.current
        view = self.left.groups[0]
        return tuple(scene.id for scene in view if scene.id in self.left.wanted)

    def finished(self, id: str) -> None:
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

    def close(self) -> None:
        """Wait for a process that was told to end, but not for long."""
        self.process.join(5)
        if self.process.is_alive():
            self.process.kill()
            self.process.join()
        self.connection.close()

    def exit_reason(self) -> str:
        """Tell how the process ended."""
        self.process.join()
        code = self.process.exitcode or 0
        return f"worker died, signal {-code}" if code < 0 else f"worker died, exit code {code}"

    def stderr_tail(self) -> str:
        """Return the tail of its standard error."""
        with suppress(OSError):
            return "\n".join(self.errors.read_text(encoding="utf-8", errors="replace").splitlines()[-TAIL:])
        return ""


@contextmanager
def _may_have_children() -> Iterator[None]:
    """Let a daemon start processes, which multiprocessing forbids lest they outlive it.

    A worker of Dask is a daemon of its nanny. Our processes end with their parent, killed or not
    (`render.running.isolation`).
    """
    config = vars(multiprocessing.current_process())["_config"]
    with _STARTING:
        daemon = config.pop("daemon", None)
        try:
            yield
        finally:
            if daemon is not None:
                config["daemon"] = daemon
