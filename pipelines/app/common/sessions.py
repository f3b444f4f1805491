"""Sessions: a cookie per browser, and a temporary folder that is removed when the session or the server ends."""

import os
import re
import secrets
import shutil
import tempfile
import threading
import time
import weakref
from collections import Counter
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

from pipelines.app.common.refusals import GONE, Refused, format_size
from render.shared.errors import InputError

try:
    import fcntl
except ImportError:  # Windows, where what is left of a killed server stays
    fcntl = None  # type: ignore[assignment]

_PREFIX = "sdps-pages-"
_NEW = 3600.0
COOKIE = "sdps-session"
_IDLE = 6 * 3600.0
_MOST = 32  # sessions at once; those without files go first, and of them those idle for longest
_AT_A_TIME = 4 * _MOST  # sessions between two clean-ups
_SET = re.compile(r"[0-9a-f]{16}")  # what `make_place` calls them; the other pages name their folders differently


@dataclass
class Session:
    """What belongs to one browser.

    Bytes count from before they are written until they are removed from the disk, so that `taken` is never too
    small. All methods are thread-safe and short: the event loop may call them.

    Attributes:
        token: Secret name.
        folder: Holds everything this session uploaded and made.
        used: Time of the last request (`time.monotonic`).
        taken: Bytes of uploads, unfinished ones included.
        lock: Held while files of the folder change.
        under_way: Number of unfinished uploads into each place.
    """

    token: str
    folder: Path
    used: float = field(default_factory=time.monotonic)
    taken: int = 0
    lock: threading.RLock = field(default_factory=threading.RLock, repr=False, compare=False)
    under_way: Counter[str] = field(default_factory=Counter)
    _kept: Counter[str] = field(default_factory=Counter)
    _sets: dict[str, None] = field(default_factory=dict)

    def take(self, size: int, most: int, what: str) -> None:
        """Count bytes before they are written.

        Raises:
            InputError: `taken` would exceed `most`; nothing is counted. The message begins with `what`.
        """
        with self.lock:
            if self.taken + size > most:
                raise InputError(f"{what}; {format_size(max(most - self.taken, 0))} are left for all uploads together")
            self.taken += size

    def give(self, size: int) -> None:
        """Stop counting bytes that were removed."""
        with self.lock:
            self.taken -= size

    def keep(self, place: str, size: int, *, replace: bool = False) -> int:
        """Record that a place holds `size` of the bytes taken; return the bytes it held that were replaced.

        Args:
            place: Name of a set, or a path that begins with it.
            size: Bytes.
            replace: They replace those it held; otherwise they are added.
        """
        with self.lock:
            old = self._kept.pop(place, 0)
            self._kept[place] = size if replace else old + size
            return old if replace else 0

    def find_place(self, name: str) -> Path:
        """Return the folder of a set of photographs.

        Raises:
            InputError: this session has no such set.
        """
        path = self.folder / name
        if not _SET.fullmatch(name) or not path.is_dir():
            raise InputError(GONE)
        with self.lock:
            self._sets.pop(name, None)
            self._sets[name] = None  # the one used last is last
        return path

    def make_place(self) -> str:
        """Make an empty folder for a set and return its name."""
        name = secrets.token_hex(8)
        (self.folder / name).mkdir(parents=True)
        with self.lock:
            self._sets[name] = None
        return name

    def set_aside(self, most: int, busy: Callable[[Path], bool]) -> list[tuple[str, Path]]:
        """Rename the sets that were unused for longest, until `most` are left; `clear` then removes them.

        Args:
            most: Sets that may stay.
            busy: Whether a job uses a folder; such a set stays, and so does one with unfinished uploads.

        Returns:
            (name of the set, where its folder lies now).

        Raises:
            Refused: too many of them are in use.
        """
        gone = []
        with self.lock:
            free = [name for name in self._sets if not self.under_way[name] and not busy(self.folder / name)]
            surplus = len(self._sets) - most
            if surplus > len(free):
                raise Refused("too many sets of photographs are being processed; wait until one is finished", 503)
            for name in free[: max(surplus, 0)]:
                aside = self.folder / f".gone-{secrets.token_hex(8)}"
                try:
                    os.rename(self.folder / name, aside)
                except FileNotFoundError:
                    pass
                except OSError:  # being read, which blocks it on some systems; it is removed the next time
                    continue
                del self._sets[name]
                gone.append((name, aside))
        return gone

    def clear(self, gone: list[tuple[str, Path]]) -> None:
        """Remove sets that were set aside, and stop counting their bytes; this may take a while."""
        for name, aside in gone:
            shutil.rmtree(aside, ignore_errors=True)
            with self.lock:
                for place in [place for place in self._kept if place.split("/")[0] == name]:
                    self.taken -= self._kept.pop(place)


class Sessions:
    """All sessions of a server, below one temporary folder."""

    def __init__(self) -> None:
        self.folder = Path(tempfile.mkdtemp(prefix=_PREFIX))
        handle = _lock_folder(self.folder)
        self._release = weakref.finalize(self, os.close, handle) if handle is not None else lambda: None
        _remove_leftovers(self.folder.parent)
        self._sessions: dict[str, Session] = {}
        self._lock = threading.Lock()

    def find(self, token: str | None) -> Session | None:
        """Return the session of a cookie, None where there is none."""
        with self._lock:
            session = self._sessions.get(token or "")
            if session is not None:
                session.used = time.monotonic()
            return session

    def create(self) -> Session:
        """Start a session. If very many start at once, the oldest one without files ends."""
        token = secrets.token_urlsafe(32)
        session = Session(token, self.folder / secrets.token_hex(8))
        session.folder.mkdir()
        with self._lock:
            if len(self._sessions) >= _AT_A_TIME:
                self._end_an_empty_one()
            self._sessions[token] = session
        return session

    def _end_an_empty_one(self) -> None:
        for session in sorted(self._sessions.values(), key=lambda item: item.used):
            try:
                session.folder.rmdir()
            except OSError:  # it holds something
                continue
            del self._sessions[session.token]
            return

    def expire(
        self, idle: float = _IDLE, most: int = _MOST, ended: Callable[[str], None] = lambda _: None
    ) -> list[str]:
        """Remove sessions that were idle for `idle` seconds, and those in excess of `most`; return their tokens.

        Those without files go first: a program that keeps loading the page without a cookie must not end the session
        of somebody who is reading results. Sessions with unfinished uploads stay.

        Args:
            idle: Seconds.
            most: Sessions that may stay.
            ended: Called with each token before its files are removed.
        """
        with self._lock:
            there = list(self._sessions.values())
        full = {item.token for item in there if _is_used(item.folder)}
        now = time.monotonic()
        with self._lock:
            newest = sorted(there, key=lambda item: (item.token in full, item.used), reverse=True)
            gone = [item for place, item in enumerate(newest) if now - item.used > idle or place >= most]
            gone = [item for item in gone if item.token in self._sessions and not item.under_way.total()]
            for session in gone:
                del self._sessions[session.token]
        for session in gone:
            ended(session.token)
            shutil.rmtree(session.folder, ignore_errors=True)
        return [session.token for session in gone]

    def close(self) -> None:
        """Remove everything."""
        shutil.rmtree(self.folder, ignore_errors=True)
        self._release()


def _is_used(folder: Path) -> bool:
    try:
        with os.scandir(folder) as found:
            return any(found)
    except OSError:  # it has just been removed
        return False


def _lock_folder(folder: Path) -> int | None:
    """Lock a folder for as long as this process lives; return the handle, None where it is locked or cannot be."""
    if fcntl is None:
        return None
    handle = None
    try:
        handle = os.open(folder, os.O_RDONLY)
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        return handle
    except OSError:
        if handle is not None:
            os.close(handle)
        return None


def _remove_leftovers(parent: Path) -> None:
    """Remove the folders of killed servers: no process locks them. A very new folder may not be locked yet."""
    for folder in parent.glob(f"{_PREFIX}*"):
        with suppress(OSError):
            handle = _lock_folder(folder) if time.time() - folder.stat().st_mtime > _NEW else None
            if handle is not None:
                shutil.rmtree(folder, ignore_errors=True)
                os.close(handle)
