"""The ledger of a run whose data folder lies in object storage: it sends shards while others are rendered.

Shards are rendered into the mirror. Threads send them; when a batch of them is there, their ledger lines follow as one
small object that is never written again, and the files here are removed. Failures are such objects, too. So the store
never lists a line without its shard, and a run killed at any moment leaves here what is not there.
"""

import json
import time
from concurrent.futures import Future, ThreadPoolExecutor, wait
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import Any

from render.records.ledger import LOG, SHARDS, Ledger
from render.records.manifest import read_events
from render.records.mirror import Mirror, mirror_of
from render.shared.files import write_text
from render.shared.storage import TOGETHER
from render.shared.temporary import is_temporary

WAITING = ".waiting.jsonl"
BATCH = 64  # lines that make a ledger object full
PERIOD = 10.0  # seconds after which a batch is sent, full or not


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


class UploadingLedger(Ledger):
    """A ledger whose finished shards go to a store.

    Args:
        mirror: The data folder.

    Raises:
        InputError: from `is_crowded` and at the end: the store refused something, or stayed away for long.
    """

    def __init__(self, mirror: Mirror) -> None:
        super().__init__(mirror.folder)
        self.run = self.path.stem.removeprefix("done-")
        self.path = mirror.folder / WAITING
        self.mirror, self.numbers = mirror, 0
        self.pool = ThreadPoolExecutor(TOGETHER, thread_name_prefix="upload")
        self.sending: dict[Future[None], dict[str, Any]] = {}  # shards on their way, and the line of each
        self.lines: dict[str, list[dict[str, Any]]] = {"done": [], "failed": []}  # for the next batch
        self.listing: dict[Future[None], int] = {}  # batches of lines on their way, and the bytes of their shards
        self.since = time.monotonic()  # there are lines for the next batch
        self.waiting = 0  # bytes finished, and still on this disk
        self.error: Exception | None = None

    def is_crowded(self) -> bool:
        """Go on sending; return whether as much waits to be sent as the disk should hold."""
        self._advance()
        return self.waiting > self.mirror.limit

    def add(self, line: dict[str, Any]) -> None:
        """Note a finished shard, and send it soon."""
        super().add(line)
        self.send(line)

    def send(self, line: dict[str, Any]) -> None:
        """Send a finished shard, and its line after it."""
        self.waiting += line["bytes"]
        self.sending[self.pool.submit(self._send_shard, line)] = line

    def fail(self, line: dict[str, Any]) -> None:
        """Note a failure, here and soon in the store."""
        super().fail(line)
        self.lines["failed"].append(line)

    def __exit__(self, kind: type | None, error: BaseException | None, trace: TracebackType | None) -> None:
        super().__exit__(kind, error, trace)
        if kind is not None:
            self.mirror.store.stopped.set()  # send what can be sent at once; the rest waits for the next run
        with suppress(Exception):  # it is in `self.error`
            while self.sending or self.listing or any(self.lines.values()):
                wait([*self.sending, *self.listing], timeout=1.0)  # in parts, so that Ctrl-C is heard
                self._advance(flush=not self.sending)
        self.pool.shutdown(cancel_futures=True)
        self.mirror.remember()
        if self.error is None:
            self.path.unlink(missing_ok=True)
        elif kind is None:
            raise self.error

    def _advance(self, *, flush: bool = False) -> None:
        """Take in what has been sent; send the lines of a batch that is full or old, or with `flush` any."""
        try:
            for future in [future for future in self.sending if future.done()]:
                line = self.sending.pop(future)
                future.result()
                self.lines["done"].append(line)
            for future in [future for future in self.listing if future.done()]:
                size = self.listing.pop(future)
                future.result()
                self.waiting -= size
        except Exception as error:
            self.error = error
            self.mirror.store.stopped.set()
            raise
        count = sum(map(len, self.lines.values()))
        if count == 0:
            self.since = time.monotonic()
        elif flush or count >= BATCH or time.monotonic() - self.since > PERIOD:
            for kind, lines in self.lines.items():
                if lines:
                    size = sum(line["bytes"] for line in lines) if kind == "done" else 0
                    name = f"{LOG}/{kind}-{self.run}-{self.numbers:05d}.jsonl"
                    self.listing[self.pool.submit(self._send_lines, name, lines)] = size
                    self.numbers += 1
            self.lines = {"done": [], "failed": []}

    # ---- In threads ----

    def _send_shard(self, line: dict[str, Any]) -> None:
        name = f"{SHARDS}/{line['id']}.exr"
        data = _file(self.folder, line["id"]).read_bytes()
        self.mirror.objects[name] = self.mirror.store.write(name, data)

    def _send_lines(self, name: str, lines: list[dict[str, Any]]) -> None:
        """Send lines as one object, and remove the files of the shards they list."""
        text = "".join(json.dumps(line) + "\n" for line in lines)
        write_text(self.folder / name, text)  # as the next reader will have it
        self.mirror.objects[name] = self.mirror.store.write(name, text.encode())
        if name.startswith(f"{LOG}/done-"):
            for line in lines:
                _file(self.folder, line["id"]).unlink(missing_ok=True)
