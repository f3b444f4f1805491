"""Rendering a plan endlessly without storing it, for a reader that takes each scene as it is finished.

The scenes come shape by shape, since making a shape and its acceleration structure takes more than half as long as
rendering the eight scenes that a preset has of it. Shapes, and the views of a shape, come in a new seeded order in
every pass over the plan. The number of a scene in this order determines the scene, and its arrays are those its shard
would hold, to the bit; so a reader may start anywhere, and a renderer may be replaced by another.

`serve` is what a process of its own runs; `pipelines.train.streaming` is its parent. The pipe between them carries
tuples: `("scene", id, RenderedScene)`, `("failed", reason)`, and `("end",)` after as many scenes as were asked for.
"""

import os
import queue
import signal
import threading
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import groupby, islice
from multiprocessing.connection import Connection
from typing import NamedTuple

import numpy as np

from render.backend.orphans import end_with_parent
from render.planning.chunks import view_groups
from render.records.manifest import SceneSpec
from render.shared.errors import InputError
from render.shared.seeds import generator


class RenderedScene(NamedTuple):
    """What training needs of a scene, as in `render.records.shards.Shard`."""

    images: np.ndarray  # (L, H, W, 3) float16, linear radiance under irradiance pi
    normals: np.ndarray  # (H, W, 3) float32, unit, camera frame, zero outside the mask
    mask: np.ndarray  # (H, W) bool


_Message = tuple[str] | tuple[str, str] | tuple[str, str, RenderedScene]


@dataclass(frozen=True)
class StreamWorkerConfig:
    """What a streaming process is told at its start.

    Attributes:
        scenes: The plan, views whole.
        seed: Seed of the order.
        start: Number of the first scene.
        count: Scenes after which to end.
        depth: Finished scenes kept ready; rendering pauses while nobody takes them.
        threads: Threads that render.
    """

    scenes: Sequence[SceneSpec]
    seed: int
    start: int
    count: int
    depth: int
    threads: int


def stream_order(scenes: Sequence[SceneSpec], *, seed: int, start: int = 0) -> Iterator[tuple[list[SceneSpec], int]]:
    """Yield the views of a plan endlessly, in the order of the stream, from scene number `start` on.

    Args:
        scenes: The plan, views whole and the views of a shape together.
        seed: Seed of the order.
        start: Number of the first scene; a pass has `len(scenes)`.

    Yields:
        The scenes of a view, and how many of them lie before `start` (0 but for the first view).
    """
    groups = view_groups(scenes)
    shapes = [list(run) for _, run in groupby(groups, key=lambda group: group[0].shape)]
    number, skip = divmod(start, len(scenes))
    while True:
        rng = generator(seed, "stream", "order", number)
        for shape in rng.permutation(len(shapes)):
            for view in rng.permutation(len(shapes[shape])):
                group = shapes[shape][view]
                if skip < len(group):
                    yield group, skip
                skip = max(skip - len(group), 0)
        number += 1


def rendered_scenes(
    scenes: Sequence[SceneSpec], *, seed: int, start: int = 0
) -> Iterator[tuple[SceneSpec, RenderedScene]]:
    """Render the scenes of `stream_order` in this process, one by one as they are asked for.

    Args:
        scenes: The plan, views whole and the views of a shape together.
        seed: Seed of the order.
        start: Number of the first scene.

    Raises:
        InputError: an unusable shape or material, an object outside the frame, or images that are not finite.
    """
    from render.backend.jit import dr
    from render.running import worker

    order = stream_order(scenes, seed=seed, start=start)
    for shape, run in groupby(order, key=lambda item: item[0][0].shape):
        built, stages = worker.build(worker.load_shape(shape)), worker.Stages()
        for group, skip in run:
            wanted = {scene.id for scene in group[skip:]}
            for scene, shard in worker.group_shards(built, group, wanted, stages):
                if not np.isfinite(shard.images).all():
                    raise InputError(f"scene {scene.id}: the images have infinite or NaN values")
                yield scene, RenderedScene(shard.images, shard.normals, shard.mask)
        dr.flush_malloc_cache()


def serve(connection: Connection, config: StreamWorkerConfig) -> None:
    """Render as configured, sending each scene through `connection`; end with the parent, whatever it ends by."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches the whole group; the parent decides
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    end_with_parent()  # whatever the renderer is doing
    outbox: queue.Queue[_Message | None] = queue.Queue(config.depth)
    sender = threading.Thread(target=_send, args=(connection, outbox), daemon=True)
    sender.start()
    outbox.put(_render(config, outbox))
    outbox.put(None)
    sender.join()


def _render(config: StreamWorkerConfig, outbox: queue.Queue[_Message | None]) -> _Message:
    """Put the scenes into the outbox; return the last message."""
    try:
        from render.backend.jit import dr

        dr.set_thread_count(config.threads)
        rendered = rendered_scenes(config.scenes, seed=config.seed, start=config.start)
        for scene, arrays in islice(rendered, config.count):
            outbox.put(("scene", scene.id, arrays))
    except InputError as error:
        return "failed", str(error)
    except Exception as error:
        reason = f"{type(error).__name__}: {(str(error).splitlines() or [''])[0]}"
        return "failed", f"the renderer failed ({reason}); `sdps render-data` of the same plan tells where"
    return ("end",)


def _send(connection: Connection, outbox: queue.Queue[_Message | None]) -> None:
    while (message := outbox.get()) is not None:
        try:
            connection.send(message)
        except OSError:
            os._exit(1)  # nobody listens any more
