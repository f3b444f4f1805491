"""What a rendering process runs. It may fail, hang or die without taking the run along.

Its parent (`render.running.worker_pool`) never imports mitsuba; they speak as in `render.running.protocol`.
"""

import faulthandler
import os
import queue
import signal
import sys
import threading
import time
import traceback
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager, suppress
from multiprocessing.connection import Connection
from typing import Any

import numpy as np

from render.backend.orphans import end_with_parent
from render.planning.chunks import Chunk
from render.records.ledger import now
from render.records.manifest import SceneSpec
from render.records.shards import Shard
from render.running.protocol import Failure, Fatal, Finished, Message, Ready, Result, SceneArrays, Started, WorkerConfig
from render.shared.errors import InputError

TAIL = 12  # lines of a traceback that are kept
GRACE = 5.0  # seconds to unwind


def serve(connection: Connection, config: WorkerConfig) -> None:
    """Render chunks until None is received or the parent is gone."""
    prepare_process(config)
    with suppress(EOFError, BrokenPipeError, ConnectionResetError), _sender(connection, config.ahead) as send:
        try:
            from render.backend.jit import dr
            from render.running import rendered_view, scene_rendering
        except InputError as error:
            send(Fatal(str(error)))
            return
        dr.set_thread_count(config.threads)
        rendered_view.set_commit(config.commit)
        send(Ready())
        while (chunk := connection.recv()) is not None:
            try:
                sound = ChunkRenderer(send, chunk, config).run()
            except scene_rendering.Unwritable as error:
                send(Fatal(str(error)))
                return
            dr.flush_malloc_cache()
            send(Finished(sound))


def prepare_process(config: WorkerConfig) -> None:
    """Set signals, standard error, core dumps, and the parent's choice of variant."""
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


@contextmanager
def _sender(connection: Connection, ahead: int) -> Iterator[Callable[[Message], Any]]:
    """Yield a function that sends a message: at once, or by a thread that lets some of them wait."""
    if not ahead:
        yield connection.send
        return
    outbox: queue.Queue[Message | None] = queue.Queue(ahead)

    def send_all() -> None:
        while (message := outbox.get()) is not None:
            try:
                connection.send(message)
            except OSError:
                os._exit(1)  # nobody listens any more

    thread = threading.Thread(target=send_all, daemon=True)
    thread.start()
    yield outbox.put
    outbox.put(None)
    thread.join()


class ChunkRenderer:
    """Renders one chunk, scene by scene, and reports every step.

    Args:
        send: Takes the messages.
        chunk: What to render.
        config: Where results go.
    """

    def __init__(self, send: Callable[[Message], Any], chunk: Chunk, config: WorkerConfig) -> None:
        from render.running import scene_rendering

        self.send, self.chunk, self.config = send, chunk, config
        self.rendering, self.stages = scene_rendering, scene_rendering.Stages()
        self.sound = True
        self.start = time.perf_counter()

    def run(self) -> bool:
        """Render the chunk; return whether the process can go on, which a defect inside the renderer leaves open."""
        ids = [scene.id for scene in self.chunk.scenes()]
        self._begin(ids)
        try:
            with self.stages.time("shape"):
                mesh = self.rendering.load_shape(self.chunk.shape)
            with self.stages.time("build"):
                built = self.rendering.build(mesh)
        except Exception as error:
            self._fail(ids, error)
            return self.sound
        self.stages.spread("shape", len(ids))
        for group in self.chunk.groups:
            self._render_view(built, list(group))
            if not self.sound:
                break
        return self.sound

    def _render_view(self, built: Any, group: list[SceneSpec]) -> None:
        """Render one view; a material that fails is left out, anything else fails the view."""
        left = [scene.id for scene in group if scene.id in self.chunk.wanted]
        while left and self.sound:
            self._begin(left)
            try:
                for scene, shard in self.rendering.group_shards(built, group, set(left), self.stages):
                    self._deliver(scene, shard)
                    left.remove(scene.id)
            except self.rendering.Unwritable:
                raise
            except Exception as error:
                culprits = left[:1] if self.stages.view_traced else left
                self._fail(culprits, error)
                left = left[len(culprits) :]

    def _begin(self, ids: Collection[str]) -> None:
        self.start = time.perf_counter()
        self.send(Started(tuple(ids)))

    def _deliver(self, scene: SceneSpec, shard: Shard) -> None:
        """Write the shard, or send what training needs of it.

        Raises:
            InputError: images that are not finite.
            Unwritable: a full disk or an unwritable folder.
        """
        arrays = None
        if self.config.folder is not None:
            with self.stages.time("write"):
                size = self.rendering.write(self.config.folder / scene.file, shard)
        elif np.isfinite(shard.images).all():
            arrays = SceneArrays(shard.images, shard.normals, shard.mask, shard.depth)
            size = sum(array.nbytes for array in arrays)
        else:
            raise InputError(f"scene {scene.id}: the images have infinite or NaN values")
        stages = self.stages.lap()
        line = {
            "id": scene.id, "spec": scene.digest(), "bytes": size, "seconds": round(sum(stages.values()), 4),
            "stages": {name: round(seconds, 4) for name, seconds in stages.items()},
            "time": now(), "worker": self.config.number,
        }  # fmt: skip
        self.send(Result(line, arrays))
        self.start = time.perf_counter()

    def _fail(self, ids: Collection[str], error: Exception) -> None:
        # A mistake in the data takes one line; anything else is a defect that may leave Dr.Jit half-way.
        mistake = isinstance(error, InputError)
        self.sound = self.sound and mistake
        reason = str(error) if mistake else f"{type(error).__name__}: {(str(error).splitlines() or [''])[0]}"
        trace = "" if mistake else "".join(traceback.format_exception(error))
        tail = "\n".join(trace.splitlines()[-TAIL:])
        self.stages.lap()
        self.send(Failure(tuple(ids), reason, tail, round(time.perf_counter() - self.start, 3)))
