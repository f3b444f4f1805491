"""Rendering planned scenes into shards: view by view, resumable, each shard whole or absent.

`render_scenes` does it in this process and stops at the first mistake; `render.running.worker_process` uses the same
pieces in a process of its own, and goes on after failures.
"""

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from render.backend.jit import dr
from render.kernel.scene import Scene, build
from render.materials.kernels.packed import pack
from render.planning.chunks import cut
from render.records.manifest import SceneSpec
from render.records.shards import Shard, is_whole, write_shard
from render.running.rendered_view import trace_views
from render.shapes import load as load_shape
from render.shared.errors import InputError
from render.shared.progress import progress_bar


class Unwritable(InputError):
    """The disk is full or the folder cannot be written: a mistake that every further scene would meet, too."""


class Stages:
    """Seconds per stage of the work, split among the scenes that share them.

    What several scenes share (a shape and its acceleration structure, the rays of a view) is spread over them in equal
    parts; `lap` returns what one scene took.

    Attributes:
        view_traced: Whether the rays of the view at work are done, so that a failure concerns one material only.
    """

    def __init__(self) -> None:
        self.view_traced = False
        self._seconds: dict[str, float] = {}
        self._shares: dict[str, dict[str, float]] = {}

    @contextmanager
    def time(self, stage: str) -> Iterator[None]:
        """Count the time spent inside as `stage`."""
        start = time.perf_counter()
        try:
            yield
        finally:
            self._seconds[stage] = self._seconds.get(stage, 0.0) + time.perf_counter() - start

    def each(self, stage: str, items: Iterator[Any]) -> Iterator[Any]:
        """Iterate over `items`, counting the time they take to appear as `stage`."""
        while True:
            with self.time(stage):
                item = next(items, None)
            if item is None:
                return
            yield item

    def spread(self, level: str, count: int) -> None:
        """Share what was counted since the last call or lap among `count` scenes, until `level` is spread again."""
        self._shares[level] = {stage: seconds / max(count, 1) for stage, seconds in self._seconds.items()}
        self._seconds = {}
        self.view_traced = level == "view"

    def lap(self) -> dict[str, float]:
        """Return the seconds per stage of the scene just finished, its shares included."""
        total = dict(self._seconds)
        for share in self._shares.values():
            for stage, seconds in share.items():
                total[stage] = total.get(stage, 0.0) + seconds
        self._seconds = {}
        return total


def render_scenes(
    scenes: Sequence[SceneSpec], folder: str | Path, *, on_shard: Callable[[SceneSpec], None] | None = None
) -> int:
    """Render every scene that has no whole shard yet in `folder`, with a progress bar and ETA.

    Args:
        scenes: The manifest, whole; consecutive scenes that differ only in material share their rays.
        folder: Data folder; shards go to its `shards/`.
        on_shard: Called after each shard is written.

    Returns:
        Number of shards rendered now.

    Raises:
        InputError: an unusable shape or material, or a full disk. Finished shards stay.
    """
    folder = Path(folder)
    missing = {scene.id for scene in scenes if not is_whole(folder / scene.file, scene)}
    with progress_bar(total=len(scenes), initial=len(scenes) - len(missing), unit="scene", desc="render") as bar:
        for chunk in cut(scenes, missing):
            built, stages = build(load_shape(chunk.shape)), Stages()
            for group in chunk.groups:
                for scene, shard in group_shards(built, group, missing, stages):
                    write(folder / scene.file, shard)
                    bar.update()
                    if on_shard:
                        on_shard(scene)
            dr.flush_malloc_cache()
    return len(missing)


def group_shards(
    built: Scene, group: Sequence[SceneSpec], missing: set[str], stages: Stages
) -> Iterator[tuple[SceneSpec, Shard]]:
    """Render the missing scenes of one view, always from the whole group's rays, in the order of the group.

    Raises:
        InputError: an unusable material or an object outside the frame.
    """
    stages.view_traced = False
    only = [number for number, scene in enumerate(group) if scene.id in missing]
    with stages.time("render"):
        surfaces = pack([scene.material for scene in group], built.mesh)
        views = trace_views(built, group, surfaces, only)
    stages.spread("view", len(only))
    for view in stages.each("render", views):
        yield view.scene, view.shard()


def write(path: Path, shard: Shard) -> int:
    """Write a shard and return its bytes; distinguish a disk that refuses it from images that must not be written.

    Raises:
        Unwritable: the disk is full or the folder unwritable.
        InputError: non-finite values.
    """
    try:
        write_shard(path, shard)
        return path.stat().st_size
    except InputError as error:
        if isinstance(error.__cause__, OSError):
            raise Unwritable(str(error)) from error
        raise
