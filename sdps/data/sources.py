"""Where a trainer's batches come from: rendered folders here, a renderer at work in `sdps.data.streamed_scenes`.

A source is asked for batches from a given place on, and gives the same ones whenever it is asked for that place again:
that makes a stopped run resumable to the batch. Where several processes train together, each takes its share of every
batch, so that together they see what one process would.
"""

from collections.abc import Generator, Iterator
from typing import Any, Protocol

from torch.utils.data import DataLoader

from render.records.manifest import MANIFEST
from render.records.shards import file_hash
from render.shared.errors import InputError
from sdps.data.dataset import Batch, SceneDataset, collate
from sdps.data.interrupts import leave_signals_to_parent
from sdps.data.order import PackedOrder, SampleStream


class BatchSource(Protocol):
    """What a trainer needs of its data.

    Attributes:
        scenes: Scenes per epoch.
    """

    scenes: int

    def batches(self, taken: int) -> Iterator[Batch | InputError]:
        """Yield batches endlessly, from the one that starts at sample `taken` of the run on.

        Args:
            taken: Samples that all processes have taken together. An earlier iterator ends.

        Yields:
            Batches of this process's share, or the mistake that was met on the way to one: raising it is left to the
            trainer, since torch would wrap one raised in a worker into a text of many lines.
        """
        ...

    def identity(self) -> dict[str, Any]:
        """Return what a run must share with its checkpoint to see the same batches; plain values, `data` a hash."""
        ...

    def close(self) -> None:
        """End the processes behind the source; `batches` starts them again."""
        ...


def share_of_batch(batch: int, rank: int, world: int) -> slice:
    """Return which samples of every batch fall to one of several processes, a contiguous part.

    Args:
        batch: Samples per batch of all processes together.
        rank: Number of this process, from 0.
        world: Number of processes.

    Raises:
        InputError: the processes cannot share a batch equally.
    """
    if not 0 <= rank < world:
        raise InputError(f"rank must be from 0 to {world - 1} among {world} processes, got {rank}")
    if batch % world:
        raise InputError(
            f"batch_scenes {batch} cannot be shared by {world} processes equally; make it a multiple of {world}"
        )
    share = batch // world
    return slice(rank * share, (rank + 1) * share)


class StoredScenes:
    """Batches of the scenes of a data folder; a `BatchSource`.

    Every epoch is a new permutation of the scenes. Batches do not depend on the number of workers.

    Args:
        dataset: Scenes and how samples are made of them; its seed also orders them.
        batch: Samples per batch, of all processes together.
        workers: Loader processes; 0 loads in this one.
        pin_memory: Hand out page-locked tensors, which a GPU copies while it computes.
        rank: Number of this process among those that train together.
        world: Number of processes that train together.
        window: Of a packed set, scenes among which the order is drawn (`sdps.data.order`).

    Raises:
        InputError: `world` does not divide `batch`, or the cache of a packed set is too small for the window.
    """

    def __init__(
        self,
        dataset: SceneDataset,
        *,
        batch: int,
        workers: int = 0,
        pin_memory: bool = False,
        rank: int = 0,
        world: int = 1,
        window: int = 1024,
    ) -> None:
        self.dataset, self.batch, self.workers, self.pin_memory = dataset, batch, workers, pin_memory
        self.scenes = len(dataset)
        self._part = share_of_batch(batch, rank, world)
        self._packed = PackedOrder(dataset, dataset.packed, window) if dataset.packed else None
        self._running: Generator[Batch | InputError, None, None] | None = None

    def batches(self, taken: int) -> Iterator[Batch | InputError]:
        """Yield batches endlessly, from sample `taken` on."""
        self.close()
        self._running = self._load(taken)
        return self._running

    def _load(self, taken: int) -> Generator[Batch | InputError, None, None]:
        seed, packed = self.dataset.options.seed, self._packed
        windows = packed.windows if packed else None
        keys = SampleStream(self.scenes, self.batch, seed, taken, self._part, windows)
        # The generator alone holds the loader, so closing it ends the workers.
        yield from DataLoader(
            self.dataset,
            batch_sampler=packed.prefetch(keys, self.batch) if packed else keys,
            num_workers=self.workers,
            collate_fn=collate,
            pin_memory=self.pin_memory,
            persistent_workers=self.workers > 0,
            worker_init_fn=leave_signals_to_parent,
        )

    def identity(self) -> dict[str, Any]:
        """Return the hash of the manifest, the number of scenes that have a shard, and how a packed set is shuffled."""
        about = {"data": file_hash(self.dataset.store.folder / MANIFEST), "scenes": self.scenes}
        return about | (self._packed.identity() if self._packed else {})

    def close(self) -> None:
        """End the loader's processes."""
        running, self._running = self._running, None
        if running is not None:
            running.close()
