"""Who is who: a cookie per browser, a temporary folder per session, gone when the session or the server ends."""

import secrets
import shutil
import tempfile
import threading
import time
from dataclasses import dataclass, field
from pathlib import Path

from render.shared.errors import InputError

COOKIE = "sdps-session"
_IDLE = 6 * 3600.0
_MOST = 32  # sessions at once; the one that was idle longest goes


@dataclass
class Session:
    """What belongs to one browser.

    Attributes:
        token: Secret name.
        folder: Holds everything this session uploaded and made.
        used: Time of the last request (`time.monotonic`).
        taken: Bytes uploaded.
    """

    token: str
    folder: Path
    used: float = field(default_factory=time.monotonic)
    taken: int = 0

    def place(self, name: str) -> Path:
        """Return the folder of a set of photographs or of a scene.

        Raises:
            InputError: no such folder in this session.
        """
        path = self.folder / name
        if not name.isalnum() or not path.is_dir():
            raise InputError("that is no longer here; load it again")
        return path

    def new_place(self) -> str:
        """Make an empty folder and return its name."""
        name = secrets.token_hex(8)
        (self.folder / name).mkdir(parents=True)
        return name


class Sessions:
    """All sessions of a server, below one temporary folder."""

    def __init__(self) -> None:
        self.folder = Path(tempfile.mkdtemp(prefix="sdps-app-"))
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
        """Begin a session."""
        token = secrets.token_urlsafe(32)
        session = Session(token, self.folder / secrets.token_hex(8))
        session.folder.mkdir()
        with self._lock:
            self._sessions[token] = session
        return session

    def expire(self, idle: float = _IDLE, most: int = _MOST) -> list[str]:
        """Remove sessions that were not used for `idle` seconds, and the oldest above `most`; return their tokens."""
        now = time.monotonic()
        with self._lock:
            newest = sorted(self._sessions.values(), key=lambda item: item.used, reverse=True)
            gone = [item for place, item in enumerate(newest) if now - item.used > idle or place >= most]
            for session in gone:
                del self._sessions[session.token]
        for session in gone:
            shutil.rmtree(session.folder, ignore_errors=True)
        return [session.token for session in gone]

    def close(self) -> None:
        """Remove everything."""
        shutil.rmtree(self.folder, ignore_errors=True)
