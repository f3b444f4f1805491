"""Rendering a plan endlessly without storing it, for a reader that takes each scene as it is finished.

The scenes come shape by shape, since making a shape and its acceleration structure takes more than half as long as
rendering the eight scenes that a preset has of it. Shapes, and the views of a shape, come in a new seeded order in
every pass over the plan. The number of a scene in this order determines the scene, and its arrays are those its shard
would hold, to the bit; so a reader may start anywhere, and a process may be replaced by another.
"""

import tempfile
import threading
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from itertools import groupby
from pathlib import Path

from render.planning import budget
from render.planning.chunks import Chunk, view_groups
from render.records.manifest import SceneSpec
from render.running.protocol import Failure, Fatal, Result, SceneArrays
from render.running.worker_pool import LocalPool
from render.running.worker_process import serve
from render.shared.errors import InputError
from render.shared.seeds import generator


def stream_chunks(scenes: Sequence[SceneSpec], *, seed: int, start: int = 0) -> Iterator[Chunk]:
    """Yield a plan endlessly, a chunk for each shape, from scene number `start` on.

    Args:
        scenes: The plan, views whole and the views of a shape together.
        seed: Seed of the order.
        start: Number of the first scene; a pass has `len(scenes)`.
    """
    shapes = [list(run) for _, run in groupby(view_groups(scenes), key=lambda group: group[0].shape)]
    number, skip = divmod(start, len(scenes))
    while True:
        rng = generator(seed, "stream", "order", number)
        for shape in rng.permutation(len(shapes)):
            views = [tuple(shapes[shape][view]) for view in rng.permutation(len(shapes[shape]))]
            ids = [scene.id for view in views for scene in view]
            if chunk := Chunk(views[0][0].shape, tuple(views), frozenset(ids)).without(ids[:skip]):
                yield chunk
            skip = max(skip - len(ids), 0)
        number += 1


class RenderedStream:
    """The scenes of a plan from number `start` on, endlessly, rendered by a process of their own.

    Args:
        scenes: The plan, views whole and the views of a shape together.
        seed: Seed of the order.
        start: Number of the first scene.
        depth: Finished scenes kept ready; rendering pauses while nobody takes them.
        threads: Threads that render; 0 takes half of the cores.
        recycle: Scenes after which the process is replaced.
        timeout: Seconds to wait for a scene before giving up; 0 waits for ever.
        serve: What the rendering process runs, a module-level function.

    Raises:
        InputError: from `next`: a scene cannot be rendered, the process died or hangs, or the stream is closed.
    """

    def __init__(
        self,
        scenes: Sequence[SceneSpec],
        *,
        seed: int,
        start: int = 0,
        depth: int = 4,
        threads: int = 0,
        recycle: int = 500,
        timeout: float = 600.0,
        serve: Callable[..., None] = serve,
    ) -> None:
        self._by_id = {scene.id: scene for scene in scenes}
        self._chunks = stream_chunks(scenes, seed=seed, start=start)
        self._lock, self._closed = threading.Lock(), False
        self._results: deque[Result] = deque()
        self._errors = tempfile.TemporaryDirectory(ignore_cleanup_errors=True)
        self._pool = LocalPool(
            None, Path(self._errors.name), workers=1, timeout=timeout, recycle=recycle, serve=serve, ahead=depth,
            threads=threads or max(1, budget.cores() // 2),
        )  # fmt: skip

    def __iter__(self) -> "RenderedStream":
        return self

    def __next__(self) -> tuple[SceneSpec, SceneArrays]:
        """Wait for the next scene."""
        self._pool.restart_clock()
        while not self._results:
            self._poll()
        line, arrays = self._results.popleft()
        assert arrays is not None
        return self._by_id[line["id"]], arrays

    def _poll(self) -> None:
        """Keep the process at work, and take in what it has finished."""
        with self._lock:
            if self._closed:
                raise InputError("the stream of rendered scenes is closed")
            if not self._pool.queue:
                self._pool.submit([next(self._chunks)])
            outcomes = self._pool.poll()
        for outcome in outcomes:
            match outcome:
                case Result():
                    self._results.append(outcome)
                case Failure(ids, reason):
                    self.close()
                    remedy = "raise stream.timeout or lower data.spp" if "timed out" in reason else (
                        "`sdps render-data` with the same preset shows where"
                    )  # fmt: skip
                    raise InputError(f"rendering while training: scene {ids[0]}: {reason}; {remedy}")
                case Fatal(reason):
                    self.close()
                    raise InputError(f"rendering while training: {reason}")

    def close(self) -> None:
        """End the process at once; may be called from another thread than waits for a scene."""
        self._closed = True  # first: a waiting thread gives up when its poll ends, within about a second
        with self._lock:
            self._pool.close()
            self._errors.cleanup()
