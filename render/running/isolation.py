"""A renderer in a process of its own, which may fail, hang or die without taking the run along.

The parent (`render.running.supervisor`) never imports mitsuba. It sends chunks through a pipe and receives the messages
of `render.running.messages`.
"""

import faulthandler
import os
import signal
import sys
import time
import traceback
from collections.abc import Callable, Collection
from contextlib import suppress
from multiprocessing.connection import Connection
from typing import Any

from render.backend.orphans import end_with_parent
from render.planning.chunks import Chunk
from render.records.ledger import now
from render.records.manifest import SceneSpec
from render.running.messages import Begun, Done, Ended, Failed, Fatal, Message, Ready, WorkerConfig
from render.shared.errors import InputError

TAIL = 12  # lines of a traceback that are kept
GRACE = 5.0  # seconds to unwind


def serve(connection: Connection, config: WorkerConfig) -> None:
    """Render chunks until told to stop (None) or the parent is gone."""
    settle(config)
    with suppress(EOFError, BrokenPipeError, ConnectionResetError):
        try:
            from render.backend.jit import dr
            from render.running import rendered, worker
        except InputError as error:
            connection.send(Fatal(str(error)))
            return
        dr.set_thread_count(config.threads)
        rendered.stamp(config.commit)
        connection.send(Ready())
        while (chunk := connection.recv()) is not None:
            try:
                sound = Work(connection.send, chunk, config).run()
            except worker.Unwritable as error:
                connection.send(Fatal(str(error)))
                return
            dr.flush_malloc_cache()
            connection.send(Ended(sound))


def settle(config: WorkerConfig) -> None:
    """Prepare the process: signals, standard error, core dumps, and the parent's choice of variant."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches the whole group; the parent decides
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(0))  # unwinds, so that a half-written shard is removed
    with suppress(ImportError, ValueError, OSError):
        import resource

        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    end_with_parent(GRACE)
    descriptor = os.open(config.errors, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o600)
    os.dup2(descriptor, 2)
    os.close(descriptor)
    faulthandler.enable(file=2)
    os.environ["SDPS_VARIANT"] = config.variant
    if config.llvm:
        os.environ["DRJIT_LIBLLVM_PATH"] = config.llvm


class Work:
    """Rendering one chunk, scene by scene, telling the parent what happens."""

    def __init__(self, send: Callable[[Message], Any], chunk: Chunk, config: WorkerConfig) -> None:
        from render.running import worker

        self.send, self.chunk, self.config = send, chunk, config
        self.worker, self.stages = worker, worker.Stages()
        self.sound = True
        self.start = time.perf_counter()

    def run(self) -> bool:
        """Render the chunk; return whether the process can go on, which a defect inside the renderer leaves open."""
        scenes = self.chunk.scenes()
        self._begin([scene.id for scene in scenes])
        try:
            with self.stages.time("shape"):
                mesh = self.worker.load_shape(self.chunk.shape)
            with self.stages.time("build"):
                built = self.worker.build(mesh)
        except Exception as error:
            self._failed([scene.id for scene in scenes], error)
            return self.sound
        self.stages.spread("shape", len(scenes))
        for group in self.chunk.groups:
            self._view(built, group)
            if not self.sound:
                break
        return self.sound

    def _view(self, built: Any, group: Collection[SceneSpec]) -> None:
        """Render one view; a material that fails is left out, anything else fails the view."""
        left = [scene.id for scene in group if scene.id in self.chunk.wanted]
        while left and self.sound:
            self._begin(left)
            try:
                for scene in self.worker.render_group(built, list(group), self.config.folder, set(left), self.stages):
                    self._done(scene)
                    left.remove(scene.id)
                left = []
            except self.worker.Unwritable:
                raise
            except Exception as error:
                culprits = left[:1] if self.stages.view_traced else left
                self._failed(culprits, error)
                left = left[len(culprits) :]

    def _begin(self, ids: Collection[str]) -> None:
        self.start = time.perf_counter()
        self.send(Begun(tuple(ids)))

    def _done(self, scene: Any) -> None:
        stages = self.stages.lap()
        self.send(Done({
            "id": scene.id, "spec": scene.digest(), "bytes": (self.config.folder / scene.file).stat().st_size,
            "seconds": round(sum(stages.values()), 4),
            "stages": {name: round(seconds, 4) for name, seconds in stages.items()},
            "time": now(), "worker": self.config.number,
        }))  # fmt: skip
        self.start = time.perf_counter()

    def _failed(self, ids: Collection[str], error: Exception) -> None:
        # A mistake in the data is told in one line; anything else is a defect that may leave Dr.Jit half-way.
        mistake = isinstance(error, InputError)
        self.sound = self.sound and mistake
        reason = str(error) if mistake else f"{type(error).__name__}: {(str(error).splitlines() or [''])[0]}"
        trace = "" if mistake else "".join(traceback.format_exception(error))
        tail = "\n".join(trace.splitlines()[-TAIL:])
        self.stages.lap()
        self.send(Failed(tuple(ids), reason, tail, round(time.perf_counter() - self.start, 3)))
