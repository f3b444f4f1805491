"""An unfinished upload: it has a folder of its own until it is complete and checked, and its bytes are counted.

If it fails, is refused or breaks off, it leaves neither files nor counted bytes; nobody sees half of an upload.
"""

import asyncio
import os
import secrets
import shutil
from collections import Counter
from collections.abc import AsyncIterator, Callable, Sequence
from contextlib import asynccontextmanager, suppress
from pathlib import Path
from typing import BinaryIO, TypeVar

from pipelines.app.common.refusals import GONE, Refused, explain_full_disk, format_size
from pipelines.app.common.sessions import Session
from render.shared.errors import InputError

_BLOCK = 2**20  # bytes written at a time
_STALLED = 120.0  # seconds without a byte
T = TypeVar("T")


class Incoming:
    """One upload. Its methods may be called from any thread.

    Attributes:
        folder: Its own, empty at first.
        size: Bytes of the session that it uses.
    """

    def __init__(self, session: Session, most: int, place: str) -> None:
        """Start an upload into a place of a session whose uploads may have `most` bytes in total."""
        self.folder = session.folder / f".incoming-{secrets.token_hex(8)}"
        self.size = 0
        self._session, self._most, self._place = session, most, place

    def take(self, size: int, what: str) -> None:
        """Count bytes before they are written.

        Raises:
            InputError: they exceed the limit; the message begins with `what`.
        """
        self._session.take(size, self._most, what)
        self.size += size

    def give(self, size: int) -> None:
        """Stop counting bytes that were removed."""
        self._session.give(size)
        self.size -= size

    def add(self, files: Sequence[Path], folder: Path, most: int, base: Path | None = None) -> int:
        """Move files into the place's folder, all or none, and return how many files are there then.

        Args:
            files: Complete and checked.
            folder: Of the place.
            most: Files that may be there.
            base: A folder above the files, below which they lie as they shall lie in the place's; None: just there.

        Raises:
            InputError: a duplicate name, too many files, or a place that was removed.
        """
        names = [file.name if base is None else file.relative_to(base).as_posix() for file in files]
        with self._session.lock:
            there = list_files(folder)
            folders = {name.rpartition("/")[0] for name in (*there, *names)}
            for name in names:
                if name in there | folders or name.rpartition("/")[0] in there:
                    raise InputError(f"{name}: there are two files of this name; rename one")
            if len(there) + len(files) > most:
                raise InputError(f"more than {most} files; leave some out")
            moved: list[tuple[Path, Path]] = []
            try:
                for file, target in zip(files, (folder / name for name in names), strict=True):
                    target.parent.mkdir(exist_ok=True)
                    os.rename(file, target)
                    moved.append((file, target))
            except OSError:
                for file, target in moved:
                    os.rename(target, file)
                raise
            self._session.keep(self._place, self.size)
            self.size = 0
            return len(there) + len(files)

    def put(self, made: Path, path: Path, most: int | None = None) -> None:
        """Move a file or a folder to a path; what was there is removed with this upload's folder.

        Args:
            made: Complete and checked.
            path: Its new place; nobody else writes there.
            most: Entries that the path's folder may have.

        Raises:
            InputError: too many entries, or a place that was removed.
        """
        old = self.folder / f".old-{secrets.token_hex(8)}"
        with self._session.lock:
            there = list_names(path.parent)
            if most is not None and path.name not in there and len(there) >= most:
                raise InputError(f"more than {most} files; reuse a name, or restart `sdps app`")
            if path.name in there:
                os.rename(path, old)
            try:
                os.rename(made, path)
            except OSError:
                if old.exists():
                    os.rename(old, path)
                raise
            self.size = self._session.keep(self._place, self.size, replace=True)

    def remove(self, path: Path) -> None:
        """Remove a file that was put there, if it exists, and stop counting its bytes."""
        with self._session.lock:
            path.unlink(missing_ok=True)
            self.size += self._session.keep(self._place, 0, replace=True)


@asynccontextmanager
async def open_upload(session: Session, most: int, place: str) -> AsyncIterator[Incoming]:
    """Yield an upload; when it ends, files that it has not moved to their place are removed and no longer counted.

    Args:
        session: The session that uploads.
        most: Bytes that the session's uploads may have in total.
        place: What the bytes are counted for: a set's name, or a path that begins with it.
    """
    coming = Incoming(session, most, place)
    owner = place.split("/")[0]
    with session.lock:
        session.under_way[owner] += 1
    try:
        with suppress(FileNotFoundError):  # the session has ended; writing there says so
            coming.folder.mkdir()
        yield coming
    except OSError as error:
        if not session.folder.is_dir():
            raise InputError(GONE) from error
        refusal = explain_full_disk("the upload", error)
        if refusal is None:
            raise
        raise refusal from error
    finally:
        try:
            await run_in_thread(shutil.rmtree, coming.folder, True)
        finally:
            coming.give(coming.size)
            with session.lock:
                session.under_way -= Counter([owner])  # which drops those that are zero


async def receive(stream: AsyncIterator[bytes], path: Path, coming: Incoming, most: int | None = None) -> int:
    """Write a request's body into a new file, and return its size. Bytes are counted before they are stored.

    Args:
        stream: The body.
        path: In the upload's folder.
        coming: The upload.
        most: Bytes that such a file may have.

    Raises:
        InputError: too many bytes.
        Refused: nothing arrived for two minutes.
    """
    size, block = 0, bytearray()
    try:
        async with asyncio.timeout(_STALLED) as clock:
            with path.open("xb") as handle:
                async for chunk in stream:
                    coming.take(len(chunk), f"{path.name}: too large")
                    size += len(chunk)
                    if most is not None and size > most:
                        raise InputError(f"{path.name}: too large; such a file may have at most {format_size(most)}")
                    block += chunk
                    if len(block) >= _BLOCK:
                        await run_in_thread(_write, handle, bytes(block))
                        block.clear()
                    clock.reschedule(asyncio.get_running_loop().time() + _STALLED)
                await run_in_thread(_write, handle, bytes(block))
    except TimeoutError as error:
        raise Refused(f"{path.name}: nothing arrived for {_STALLED:.0f} s; send it again", 408) from error
    return size


def _write(handle: BinaryIO, block: bytes) -> None:
    handle.write(block)
    handle.flush()


def list_names(folder: Path) -> set[str]:
    """Return the names in a place's folder.

    Raises:
        InputError: the place was removed.
    """
    try:
        return set(os.listdir(folder))
    except FileNotFoundError as error:
        raise InputError(GONE) from error


def list_files(folder: Path) -> set[str]:
    """Return the files in a place's folder and in folders in it, by their paths.

    Raises:
        InputError: the place was removed.
    """
    found = set()
    for name in list_names(folder):
        below = folder / name
        found |= {f"{name}/{inner}" for inner in list_names(below)} if below.is_dir() else {name}
    return found


async def run_in_thread(function: Callable[..., T], *values: object) -> T:
    """Call a function in a thread. A caller that is cancelled meanwhile continues only once the function has ended.

    Otherwise the caller would clean up while the function still uses the files.
    """
    running = asyncio.ensure_future(asyncio.to_thread(function, *values))
    cancelled: asyncio.CancelledError | None = None
    while not running.done():
        try:
            await asyncio.shield(running)
        except asyncio.CancelledError as error:
            cancelled = error
        except Exception:  # it is that of the function
            break
    if cancelled is not None:
        if not running.cancelled():
            running.exception()  # retrieved, so that asyncio does not warn
        raise cancelled
    return running.result()
