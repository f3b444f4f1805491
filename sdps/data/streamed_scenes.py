"""Batches of scenes that are rendered while the network trains, and stored nowhere.

Rendering a scene takes longer than learning from it once. So the latest scenes are kept in a window, every batch is
drawn from it, and for every batch the window moves on by a few new scenes, or by a fraction of one. How far it moves is
a matter of the batch's number alone, not of how fast the renderer happens to be: it waits for the trainer, or the
trainer for it, and the same seed gives the same batches.
"""

import hashlib
import math
from collections import deque
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from fractions import Fraction
from typing import Any, Protocol

import numpy as np

from render.records.manifest import SceneSpec
from render.shared.errors import InputError
from render.shared.progress import progress_bar
from render.shared.seeds import generator
from sdps.data.dataset import Batch, SampleOptions, collate, make_sample, require_lights
from sdps.data.scene_store import StoredScene
from sdps.data.sources import share_of_batch


class SceneStream(Protocol):
    """Scenes as they are rendered, endlessly; `next` waits for one and raises InputError where rendering fails."""

    def __next__(self) -> tuple[SceneSpec, tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]]:
        """Return a scene, and its images, normals, mask and depth as in `StoredScene`."""
        ...

    def close(self) -> None:
        """End the renderer; a `next` that waits in another thread ends, too."""
        ...


class StreamedScenes:
    """Batches of scenes as they are rendered; a `BatchSource`.

    Batch k is drawn without replacement from the `window` scenes of the stream that end at number
    window + ceil(k fresh), by a random stream of its own. So a scene is drawn batch / fresh times on average.

    What it costs. Memory: `window` times 6 bytes per light and pixel and 13 per pixel, which is 6.5 MB per scene of 64
    lights at 128x128, and 1.7 GB for 256 of them. Time: the first batch, also after a resume, waits until the window
    has been rendered; after that a batch takes at least as long as `fresh` scenes do. Of several processes that train
    together each pays all of this, since any scene may fall to any of them.

    A thread makes the next batch while the trainer works on the last, so `close` must be called in the end.

    Args:
        scenes: The plan that is streamed.
        open_stream: Opens the stream at a scene number, 0 being the first. The same number must give the same scenes.
        options: How samples are made of scenes; the seed also draws them from the window.
        batch: Samples per batch, of all processes together.
        window: Scenes kept in memory, at least `batch`.
        fresh: New scenes per batch, above 0 and at most `window`.
        pin_memory: Hand out page-locked tensors, which a GPU copies while it computes.
        rank: Number of this process among those that train together.
        world: Number of processes that train together.

    Raises:
        InputError: a window smaller than a batch, `fresh` out of range, scenes with too few lights for equally many
            images, or a `world` that does not divide `batch`.
    """

    def __init__(
        self,
        scenes: Sequence[SceneSpec],
        open_stream: Callable[[int], SceneStream],
        options: SampleOptions,
        *,
        batch: int,
        window: int,
        fresh: float,
        pin_memory: bool = False,
        rank: int = 0,
        world: int = 1,
    ) -> None:
        if not scenes:
            raise InputError("stream: the plan has no scene to train on; plan more")
        if window < batch:
            raise InputError(f"stream.window {window} must be at least batch_scenes {batch}")
        if not 0 < fresh <= window:
            raise InputError(f"stream.fresh must be above 0 and at most stream.window ({window}), got {fresh}")
        require_lights("stream", scenes, options)
        self.scenes = len(scenes)
        self.options, self.batch, self.window, self.fresh = options, batch, window, fresh
        self._plan, self._open_stream, self._pin_memory, self._rank = scenes, open_stream, pin_memory, rank
        self._part = share_of_batch(batch, rank, world)
        self._identity: dict[str, Any] | None = None
        self._stream: SceneStream | None = None
        self._running: Generator[Batch | InputError, None, None] | None = None

    def first(self, number: int) -> int:
        """Return the number of the first scene in the window of batch `number`."""
        return math.ceil(number * Fraction(str(self.fresh)))  # exact: 30 x 0.1 is 3, not above it

    def batches(self, taken: int) -> Iterator[Batch | InputError]:
        """Yield batches endlessly, from sample `taken` on, a multiple of the batch; end after a mistake."""
        number, rest = divmod(taken, self.batch)
        if rest:
            raise InputError(f"a stream resumes at a multiple of batch_scenes ({self.batch}) samples, not at {taken}")
        self.close()
        self._running = self._run(number)
        return self._running

    def _run(self, number: int) -> Generator[Batch | InputError, None, None]:
        self._stream = self._open_stream(self.first(number))
        window = _Window(self._stream, self.first(number), self.window, show=self._rank == 0)
        # One thread, one batch ahead: the window is only ever touched in it, in the order of the batches.
        with ThreadPoolExecutor(1) as maker, closing(self._stream):
            ahead = maker.submit(self._make, window, number)
            while True:
                try:
                    batch = ahead.result()
                except InputError as error:
                    yield error
                    return
                number += 1
                ahead = maker.submit(self._make, window, number)
                yield batch

    def _make(self, window: "_Window", number: int) -> Batch:
        """Make this process's share of a batch."""
        scenes = window.move(self.first(number))
        drawn = generator(self.options.seed, "stream", "batch", number).permutation(len(scenes))[: self.batch]
        samples = []
        for place in range(self.batch)[self._part]:
            rng = generator(self.options.seed, "stream", "sample", number, place)
            scene, stored = scenes[int(drawn[place])]
            samples.append(make_sample(scene, stored, self.options, rng))
        batch = collate(samples)
        assert isinstance(batch, Batch)  # no sample is an error
        return Batch(*(tensor.pin_memory() for tensor in batch)) if self._pin_memory else batch

    def identity(self) -> dict[str, Any]:
        """Return the hash of the plan, the seed, and how the window moves."""
        if self._identity is None:
            plan = hashlib.sha256("".join(scene.digest() for scene in self._plan).encode()).hexdigest()
            self._identity = {
                "data": plan,
                "scenes": self.scenes,
                "stream_seed": self.options.seed,
                "window": self.window,
                "fresh": self.fresh,
            }
        return dict(self._identity)

    def close(self) -> None:
        """End the renderer and forget the window."""
        stream, self._stream = self._stream, None
        if stream is not None:
            stream.close()  # first, as the thread may be waiting for it
        running, self._running = self._running, None
        if running is not None:
            running.close()


class _Window:
    """The latest scenes of a stream.

    Args:
        stream: Where the scenes come from.
        start: Number of the scene the stream gives next.
        size: Scenes kept.
        show: Show the progress of filling the window, which takes as long as rendering it.
    """

    def __init__(self, stream: SceneStream, start: int, size: int, *, show: bool) -> None:
        self.stream, self.end, self.size, self.show = stream, start, size, show
        self.scenes: deque[tuple[SceneSpec, StoredScene]] = deque(maxlen=size)

    def move(self, first: int) -> list[tuple[SceneSpec, StoredScene]]:
        """Return the scenes from number `first` on, waiting for those that are still to be rendered."""
        missing = range(self.end, first + self.size)
        filling = self.show and not self.scenes
        for _ in progress_bar(missing, desc="render window", unit="scene", leave=False, disable=not filling):
            scene, arrays = next(self.stream)
            self.scenes.append((scene, StoredScene(*arrays)))
            self.end += 1
        return list(self.scenes)
