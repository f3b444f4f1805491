"""Batches of scenes that lie in the memory of the device that trains: for GPUs, which loader processes cannot feed.

Every scene is decoded once and stays. A folder that is still being rendered is trained on meanwhile: its new scenes are
taken in as they appear, until the memory set aside is full.
"""

import logging
import os
import time
from collections.abc import Generator, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from multiprocessing import get_context
from pathlib import Path
from threading import Event, Thread
from typing import Any

import torch

from render.records.manifest import MANIFEST, SceneSpec, read_manifest
from render.records.mirror import select_rendered
from render.records.shards import file_hash
from render.shared.errors import InputError
from render.shared.progress import progress_bar
from render.shared.seeds import generator
from sdps.data.dataset import Batch, SampleOptions, require_lights
from sdps.data.interrupts import leave_signals_to_parent
from sdps.data.resident.device_samples import Held, Prepared, make_batch, prepare, require_possible
from sdps.data.scene_store import SceneStore, list_finished
from sdps.data.sources import share_of_batch

_log = logging.getLogger(__name__)
_SHARE = 0.5
"""Of the memory that is free when training begins: the rest is for the network and its batches."""
_LOOK_EVERY = 5.0  # seconds, for scenes that were rendered meanwhile
_ENOUGH = 4  # batches of scenes with which training on an unfinished folder begins


class ResidentScenes:
    """Batches of the scenes of a data folder, made on a device; a `BatchSource`.

    Batch k is drawn without replacement from the scenes that are held, by a random stream of its own. Of a folder that
    is finished all are held before the first batch, and the same seed gives the same batches.

    Args:
        folder: Data folder.
        options: How samples are made; the seed also draws scenes.
        batch: Samples per batch, of all processes together.
        device: Holds the scenes.
        workers: Processes that decode them.
        growing: Begin with the scenes that are there, and take in others while training.
        rank: Number of this process among those that train together; each holds all scenes.
        world: Number of processes that train together.

    Raises:
        InputError: no manifest or scene, missing shards, samples that only loader processes make, or scenes of which
            not even a batch fits into memory.
    """

    def __init__(
        self, folder: str | Path, options: SampleOptions, *, batch: int, device: torch.device, workers: int = 2,
        growing: bool = False, rank: int = 0, world: int = 1,
    ) -> None:  # fmt: skip
        self.folder, self.options, self.batch, self.growing = Path(folder), options, batch, growing
        self._part, self._workers = share_of_batch(batch, rank, world), max(workers, 1)
        require_possible(options)
        self._planned = read_manifest(self.folder, "train") if growing else list_finished(self.folder, "train")
        require_lights(folder, self._planned, options)
        lights = {len(scene.lights) for scene in self._planned}
        if len(lights) > 1:
            raise InputError(f"{folder}: scenes of {min(lights)} to {max(lights)} lights; resident needs equally many")
        self.scenes = len(self._planned)
        each = Held.bytes_each(max(lights), options.size)
        room = min(self.scenes, int(_SHARE * free_memory(device)) // each)
        if room < min(batch, self.scenes):
            raise InputError(
                f"{folder}: {each * min(batch, self.scenes) / 1e9:.1f} GB of scenes do not fit into the memory of "
                f"{device}; lower batch_scenes or size, or set resident to false"
            )
        if room < self.scenes:
            about = "%s: %d of %d scenes fit into the memory of %s; the others are not trained on"
            _log.warning(about, folder, room, self.scenes, device)
        self.held = Held(room, max(lights), options.size, device)
        self._room, self._stop, self._failed = room, Event(), list[BaseException]()
        self._filling: Thread | None = None

    def batches(self, taken: int) -> Iterator[Batch | InputError]:
        """Yield batches endlessly, from sample `taken` on."""
        if self._filling is None:
            self._filling = Thread(target=self._fill, name="hold scenes", daemon=True)
            self._filling.start()
        return self._make(taken // self.batch)

    def _make(self, number: int) -> Generator[Batch | InputError, None, None]:
        wanted = min(self._room, _ENOUGH * self.batch if self.growing else self._room)
        with progress_bar(total=wanted, desc="scenes into memory", leave=False) as bar:
            while self.held.count < wanted and not self._failed:
                bar.update(self.held.count - bar.n)
                time.sleep(0.1)
        while not self._failed:
            rng = generator(self.options.seed, "resident", number)
            count = self.held.count
            drawn = rng.choice(count, self.batch, replace=count < self.batch)
            yield make_batch(self.held, drawn[self._part], self.options, rng)
            number += 1
        error = self._failed[0]
        yield error if isinstance(error, InputError) else InputError(f"{self.folder}: a scene was not read ({error})")

    def _fill(self) -> None:
        """Take in scenes as they are there, until there is no room or none is missing."""
        try:
            with ProcessPoolExecutor(self._workers, get_context("spawn"), leave_signals_to_parent, (0,)) as pool:
                missing = list(self._planned)
                while missing and self.held.count < self._room and not self._stop.is_set():
                    there = select_rendered(self.folder, missing)
                    taken = {scene.id for scene in there}
                    missing = [scene for scene in missing if scene.id not in taken]
                    self._take(pool, there)
                    if missing and not there:
                        self._stop.wait(_LOOK_EVERY)
        except BaseException as error:  # a thread's own would be lost
            self._failed.append(error)

    def _take(self, pool: ProcessPoolExecutor, scenes: list[SceneSpec]) -> None:
        """Decode scenes, a few ahead of the one that is taken in, in their order."""
        coming: list[Future[Prepared]] = []
        for scene in [*scenes, *[None] * (2 * self._workers)]:
            if scene is not None:
                coming.append(pool.submit(_read, self.folder, scene, self.options.size))
            if coming and (scene is None or len(coming) > 2 * self._workers):
                wait(coming[:1], return_when=FIRST_COMPLETED)
                found = coming.pop(0).result()
                if self.held.count < self._room:
                    self.held.add(found)
            if self._stop.is_set() or self.held.count >= self._room:
                break
        for left in coming:
            left.cancel()

    def identity(self) -> dict[str, Any]:
        """Return the hash of the manifest, the number of scenes planned, and that samples are made on the device."""
        return {"data": file_hash(self.folder / MANIFEST), "scenes": self.scenes, "resident": True}

    def close(self) -> None:
        """End the processes that decode."""
        self._stop.set()
        if self._filling is not None:
            self._filling.join()


def _read(folder: Path, scene: SceneSpec, size: int) -> Prepared:
    torch.set_num_threads(1)
    return prepare(scene, SceneStore(folder, cache=False).load(scene), size)


def free_memory(device: torch.device) -> int:
    """Return bytes of memory that are free on a device."""
    if device.type == "cuda":
        return int(torch.cuda.mem_get_info(device)[0])
    return os.sysconf("SC_AVPHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
