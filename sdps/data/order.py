"""In which order a trainer takes scenes: a matter of seed, epoch and place alone, so training can resume at any place.

Of a packed set, too large to be shuffled as a whole, the tars come in random order and every scene is moved back at
random by less than a window. So only the tars of about a window are in use at a time, and what a buffer of a stream
would hold need not be saved: the order is drawn from numbers, before anything is read.
"""

import math
from collections import defaultdict, deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from queue import SimpleQueue
from threading import Thread
from typing import Any, NamedTuple

import numpy as np

from render.records.mirror import Packed, display_name
from render.records.packs import PACK
from render.records.shards import file_hash
from render.shared.errors import InputError
from render.shared.seeds import generator
from sdps.data.dataset import SampleKey, SceneDataset

_TARS_AHEAD = 2


class Windows(NamedTuple):
    """How the order of a packed set is drawn: the numbers of the scenes in each tar, and the window."""

    tars: list[np.ndarray]
    window: int


class SampleStream:
    """Batches of sample keys, endlessly: every epoch a new order of the scenes, joined end to end.

    Batches run across epoch borders, so the state of the stream is the number of samples already taken.

    Args:
        scenes: Number of scenes.
        batch: Samples per batch.
        seed: Root seed.
        taken: Samples taken before this run.
        part: Which samples of every batch to yield; all by default.
        windows: Draw the order of a packed set; by default any order is as likely as another.
    """

    def __init__(
        self, scenes: int, batch: int, seed: int, taken: int = 0, part: slice = slice(None),
        windows: Windows | None = None,
    ) -> None:  # fmt: skip
        self.scenes, self.batch, self.seed, self.taken, self.part = scenes, batch, seed, taken, part
        self.windows = windows

    def __iter__(self) -> Iterator[list[SampleKey]]:
        epoch, position = divmod(self.taken, self.scenes)
        keys = []
        while True:
            order = self.order(epoch)
            for place in range(position, self.scenes):
                keys.append(SampleKey(int(order[place]), epoch, place))
                if len(keys) == self.batch:
                    yield keys[self.part]
                    keys = []
            epoch, position = epoch + 1, 0

    def order(self, epoch: int) -> np.ndarray:  # (N,)
        """Draw the numbers of the scenes in the order of an epoch."""
        rng = generator(self.seed, "order", epoch)
        if self.windows is None:
            return rng.permutation(self.scenes)
        tars, window = self.windows
        lined_up = np.concatenate([tars[number] for number in rng.permutation(len(tars))])
        return lined_up[np.argsort(np.arange(self.scenes) + window * rng.random(self.scenes), kind="stable")]


class PackedOrder:
    """How the scenes of a packed set are streamed.

    Args:
        dataset: The scenes.
        packed: Their tars.
        window: Scenes among which the order is drawn; the whole set, in the order of an unpacked one, if it is smaller.

    Raises:
        InputError: the cache cannot hold what is in use at a time.
    """

    def __init__(self, dataset: SceneDataset, packed: Packed, window: int) -> None:
        numbers: dict[str, list[int]] = defaultdict(list)
        for number, tar in enumerate(packed.tars):
            numbers[tar].append(number)
        self.windows = Windows([np.array(tar) for tar in numbers.values()], window) if window < len(dataset) else None
        self.ahead = _TARS_AHEAD * math.ceil(len(dataset) / len(numbers))  # scenes
        self.dataset = dataset
        # A scene waits for at most a window to be used, and counts as just used for as long again.
        in_use = min(2 * window + 2 * self.ahead, len(dataset)) * packed.size / len(dataset)
        if packed.limit < in_use:
            raise InputError(
                f"{display_name(dataset.store.folder)}: shuffling among {window} scenes keeps {in_use / 1e9:.3g} GB "
                f"on this disk, and --cache-gb is {packed.limit / 1e9:.3g}; raise it, or lower shuffle_window"
            )

    def identity(self) -> dict[str, Any]:
        """Return what the order depends on besides the scenes and the seed."""
        if self.windows is None:
            return {}
        return {"pack": file_hash(self.dataset.store.folder / PACK), "shuffle_window": self.windows.window}

    def prefetch(self, batches: Iterable[list[SampleKey]], size: int) -> Iterator[list[SampleKey]]:
        """Yield batches of keys while a thread fetches what those to come are made of.

        Args:
            batches: Keys, endlessly.
            size: Samples of a batch of all processes, which says how many batches the scenes to look ahead are.
        """
        wanted: SimpleQueue[list[SampleKey] | None] = SimpleQueue()
        Thread(target=self._fetch, args=(wanted.get,), name="fetch tars", daemon=True).start()
        coming: deque[list[SampleKey]] = deque()
        try:
            for batch in batches:
                coming.append(batch)
                wanted.put(batch)
                if len(coming) > self.ahead / size:
                    yield coming.popleft()
        finally:
            wanted.put(None)

    def _fetch(self, wanted: "Callable[[], Sequence[SampleKey] | None]") -> None:
        while (batch := wanted()) is not None:
            for key in batch:
                with suppress(InputError):  # whoever makes the sample meets it, too
                    self.dataset.store.fetch(self.dataset.scenes[key.scene])
