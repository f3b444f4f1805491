"""The ledger of a run whose data folder lies in object storage: it sends shards while others are rendered.

Shards are rendered into the mirror. A thread sends them, several at once; when all of a batch are there, their ledger
lines follow as one small object that is never written again, and the files here are removed. Failures are such objects,
too. So the store never lists a line without its shard, and a run killed at any moment leaves here what is not there.
"""

import json
import threading
import time
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from queue import Empty, SimpleQueue
from types import TracebackType
from typing import Any, NamedTuple

from render.records.ledger import LOG, SHARDS, Ledger
from render.records.manifest import read_events
from render.records.mirror import Mirror, mirror_of
from render.shared.files import write_text
from render.shared.storage import TOGETHER
from render.shared.temporary import is_temporary

WAITING = ".waiting.jsonl"
BATCH = 64  # shards of one ledger object, at most
PERIOD = 10.0  # seconds after which a batch goes out, full or not


def open_ledger(folder: Path) -> Ledger:
    """Return the ledger of a new run, open for appending; of a mirror, one that sends."""
    mirror = mirror_of(folder)
    return UploadingLedger(mirror) if mirror else Ledger(folder)


def send_leftovers(folder: Path) -> int:
    """Send what a run that was killed has finished and not sent, if the folder is a mirror; return how many shards.

    A shard without a ledger line, finished at the very moment of the end, is rendered again.

    Raises:
        InputError: the store cannot be written.
    """
    mirror = mirror_of(folder)
    if mirror is None:
        return 0
    waiting = folder / WAITING
    lines = {line["id"]: line for line in read_events(waiting) if _file(folder, line["id"]).is_file()}
    with UploadingLedger(mirror) as ledger:
        for line in lines.values():
            ledger.send(line)
    waiting.unlink(missing_ok=True)
    for path in (folder / SHARDS).glob("*.exr"):
        if f"{SHARDS}/{path.name}" not in mirror.objects and not is_temporary(path.name):
            path.unlink()
    return len(lines)


def _file(folder: Path, id: str) -> Path:
    return folder / SHARDS / f"{id}.exr"


class _Entry(NamedTuple):
    """A line on its way: `done` or `failed`, and of a finished shard its sending."""

    kind: str
    line: dict[str, Any]
    sent: Future[None] | None = None


class UploadingLedger(Ledger):
    """A ledger whose finished shards go to a store.

    Args:
        mirror: The data folder.

    Raises:
        InputError: from `crowded`, `add` and at the end: the store refused something, or stayed away for long.
    """

    def __init__(self, mirror: Mirror) -> None:
        super().__init__(mirror.folder)
        self.run = self.path.stem.removeprefix("done-")
        self.path = mirror.folder / WAITING
        self.mirror, self.numbers = mirror, 0
        self.queue: SimpleQueue[_Entry | None] = SimpleQueue()
        self.pool = ThreadPoolExecutor(TOGETHER, thread_name_prefix="upload")
        self.waiting = 0  # bytes finished and not sent
        self.error: Exception | None = None
        self._thread = threading.Thread(target=self._work, name="uploads", daemon=True)
        self._thread.start()

    @property
    def crowded(self) -> bool:
        """Whether as much waits to be sent as the disk should hold; raises what the store said."""
        if self.error is not None:
            raise self.error
        return self.waiting > self.mirror.limit

    def add(self, line: dict[str, Any]) -> None:
        """Note a finished shard, and send it soon."""
        super().add(line)
        self.send(line)

    def send(self, line: dict[str, Any]) -> None:
        """Send a finished shard, and its line after it."""
        self.waiting += line["bytes"]
        self.queue.put(_Entry("done", line, self.pool.submit(self._send_shard, line)))

    def fail(self, line: dict[str, Any]) -> None:
        """Note a failure, here and soon in the store."""
        super().fail(line)
        self.queue.put(_Entry("failed", line))

    def __exit__(self, kind: type | None, error: BaseException | None, trace: TracebackType | None) -> None:
        super().__exit__(kind, error, trace)
        if kind is not None:
            self.mirror.store.stopped.set()  # send what can be sent at once; the rest waits for the next run
        self.queue.put(None)
        while self._thread.is_alive():
            self._thread.join(1.0)  # in parts, so that Ctrl-C is heard
        self.mirror.remember()
        if self.error is None:
            self.path.unlink(missing_ok=True)
        elif kind is None:
            raise self.error

    # ---- In the thread ----

    def _work(self) -> None:
        """Send batches until the end, or until the store refuses one."""
        going = True
        while going and self.error is None:
            batch, going = self._batch()
            try:
                self._send(batch)
            except Exception as error:  # told, and raised, in the main thread
                self.error = error
                self.mirror.store.stopped.set()
        self.pool.shutdown(cancel_futures=True)

    def _batch(self) -> tuple[list["_Entry"], bool]:
        """Wait for some lines; also tell whether more will come."""
        entry = self.queue.get()
        batch: list[_Entry] = []
        end = time.monotonic() + PERIOD
        while entry is not None:
            batch.append(entry)
            if len(batch) == BATCH:
                return batch, True
            try:
                entry = self.queue.get(timeout=max(0.0, end - time.monotonic()))
            except Empty:
                return batch, True
        return batch, False

    def _send(self, batch: list["_Entry"]) -> None:
        """Wait for the shards of a batch, send its lines, and remove the files."""
        for kind in ("done", "failed"):
            lines = [entry.line for entry in batch if entry.kind == kind]
            if not lines:
                continue
            for entry in batch:
                if entry.sent is not None:
                    entry.sent.result()
            name = f"{LOG}/{kind}-{self.run}-{self.numbers:05d}.jsonl"
            text = "".join(json.dumps(line) + "\n" for line in lines)
            write_text(self.folder / name, text)  # as the next reader will have it
            self.mirror.objects[name] = self.mirror.store.write(name, text.encode())
            self.numbers += 1
            if kind == "done":
                for line in lines:
                    _file(self.folder, line["id"]).unlink(missing_ok=True)
                self.waiting -= sum(line["bytes"] for line in lines)

    def _send_shard(self, line: dict[str, Any]) -> None:
        name = f"{SHARDS}/{line['id']}.exr"
        data = _file(self.folder, line["id"]).read_bytes()
        self.mirror.objects[name] = self.mirror.store.write(name, data)
