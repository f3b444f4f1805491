"""Names of what is being written, and who may remove it.

`.<base>.<host>-<machine>-<pid>-<start>-<token>.tmp<suffix>` says which process of which machine gave the name. So on a
folder that several machines share nobody removes what another is still writing. With `old` in place of `tmp` it is a
folder that was moved aside until the new one stands in its place.
"""

import hashlib
import os
import re
import secrets
import shutil
import socket
import uuid
from collections.abc import Callable
from contextlib import suppress
from functools import cache, lru_cache
from pathlib import Path
from typing import Literal

AGE = 86_400.0  # seconds after which what another machine left is taken for abandoned; no write takes as long
_LONGEST = 255  # bytes of a name
_OWNER = r"[0-9A-Za-z]*-(?P<machine>[0-9a-f]{8})-(?P<pid>\d+)-(?P<start>\d+)-[0-9a-f]{8}"
_NAME = re.compile(rf"\.(?P<base>.+)\.(?:{_OWNER}|\d+)\.(?P<kind>tmp|old|part)(?:\.[^.]*)?", re.DOTALL)
"""A number alone is a process of an earlier version, on no machine in particular."""
_CUT = re.compile(r".*~[0-9a-f]{8}", re.DOTALL)


def temporary_path(path: Path, kind: Literal["tmp", "old"] = "tmp", *, suffix: bool = False) -> Path:
    """Return a name next to `path` that no other process, machine or thread gives.

    Args:
        path: What is to be written.
        kind: `tmp`: to be written; `old`: moved aside.
        suffix: End as `path` does, since several writers choose the format by it.
    """
    base, end = (path.stem, path.suffix) if suffix else (path.name, "")
    rest = f".{_owner(os.getpid())}-{secrets.token_hex(4)}.{kind}{end}"
    return path.with_name(f".{_shorten(base, _LONGEST - 1 - len(os.fsencode(rest)))}{rest}")


def is_temporary(name: str) -> bool:
    """Return whether a file's name is one that `temporary_path` gives, or that earlier versions gave."""
    return _NAME.fullmatch(name) is not None


def is_empty(folder: Path) -> bool:
    """Return whether a folder holds nothing, or only what is being written or was when its writer was killed."""
    return all(is_temporary(path.name) for path in folder.iterdir())


def may_be_alive(path: Path, clock: Callable[[], float | None]) -> bool:
    """Return whether the process that gave a temporary name may still be at work.

    Of this machine's processes the system knows. Of others, what was not touched for `AGE` is abandoned, by the clock
    of the file server: those of the machines may differ.

    Args:
        path: A file or folder with a temporary name.
        clock: Returns the time of the file server; None: not known, and nothing is taken for abandoned.
    """
    match = _NAME.fullmatch(path.name)
    if match is not None and match["machine"] == _machine():
        runs = _runs(int(match["pid"]), int(match["start"]))
        if runs is not None:
            return runs
    now = clock()
    return now is None or now - _last_change(path) < AGE


def tidy(folder: Path, *known: str) -> None:
    """Put back the folders that were moved aside and never replaced; remove what nobody is writing any more.

    A folder is put back whoever moved it: a writer that is alive moves it aside once more. What the system refuses is
    left as it is.

    Args:
        folder: Where to look; not below it.
        known: Names of folders that may have been moved aside; only one too long for a temporary name is needed.
    """
    try:
        with os.scandir(folder) as entries:
            found = [match for entry in entries if (match := _NAME.fullmatch(entry.name))]
    except OSError:
        return
    clock = cache(lambda: server_time(folder))
    for match in found:
        path = folder / match[0]
        with suppress(OSError):
            if match["kind"] == "old" and (home := _home(folder, match, known)) and not os.path.lexists(home):
                os.rename(path, home)
            elif not may_be_alive(path, clock):
                discard(path)


def _home(folder: Path, match: re.Match[str], known: tuple[str, ...]) -> Path | None:
    """Return the place of a folder that was moved aside; None where its name was cut and is not known."""
    base, whole = match["base"], len(os.fsencode(match[0]))
    room = _LONGEST - (whole - len(os.fsencode(base)))
    for name in known:
        if _shorten(name, room) == base:
            return folder / name
    cut = _CUT.fullmatch(base) and whole > _LONGEST - 4  # a letter has up to four bytes
    return None if cut else folder / base


def discard(path: Path) -> None:
    """Remove a file or folder with a temporary name, as far as the system lets."""
    match = _NAME.fullmatch(path.name)
    with suppress(OSError):
        if match is not None and match["kind"] == "old":
            doomed = temporary_path(path.with_name(match["base"]))
            os.rename(path, doomed)  # half removed, it must not be put back
            path = doomed
        if path.is_dir() and not path.is_symlink():
            shutil.rmtree(path, ignore_errors=True)
        else:
            path.unlink(missing_ok=True)


def server_time(folder: Path) -> float | None:
    """Return the time by the clock that dates the files of a folder; None where nothing can be written."""
    probe = temporary_path(folder / "clock")
    try:
        probe.touch(exist_ok=False)
        return probe.stat().st_mtime
    except OSError:
        return None
    finally:
        with suppress(OSError):
            probe.unlink(missing_ok=True)


def _shorten(base: str, room: int) -> str:
    """Return a base of at most so many bytes, different for different bases."""
    if len(os.fsencode(base)) <= room:
        return base
    tail = f"~{hashlib.sha256(os.fsencode(base)).hexdigest()[:8]}"
    return os.fsencode(base)[: max(room - len(tail), 1)].decode(errors="ignore") + tail


def _last_change(path: Path) -> float:
    """Return when a file, or anything in a folder, was last changed; copies may bear an older date."""
    states = [path.lstat(), *(below.lstat() for below in (path.rglob("*") if path.is_dir() else ()))]
    return max(max(state.st_mtime, state.st_ctime) for state in states)


@cache
def host() -> str:
    """Return the first word of this machine's name, in letters and digits, for people."""
    return re.sub(r"[^0-9A-Za-z]", "", socket.gethostname().split(".")[0])[:12]


@cache
def _machine() -> str:
    """Return eight digits of the processes that see each other: machines, and containers, may share their names."""
    try:
        boot = Path("/proc/sys/kernel/random/boot_id").read_text(encoding="ascii").strip()
        seen = f"{boot} {os.readlink('/proc/self/ns/pid')}"
    except OSError:
        seen = f"{socket.gethostname()} {uuid.getnode()}"
    return hashlib.sha256(seen.encode()).hexdigest()[:8]


@lru_cache(maxsize=4)  # after a fork it is another process
def _owner(pid: int) -> str:
    return f"{host()}-{_machine()}-{pid}-{_start(pid)}"


def _runs(pid: int, start: int) -> bool | None:
    """Return whether a process of this machine runs; None where the system does not report it."""
    if os.name != "posix":
        return None  # signal 0 is Ctrl-C on Windows
    try:
        os.kill(pid, 0)
    except (ProcessLookupError, OverflowError):
        return False
    except OSError:
        return True  # another user's
    now = _start(pid)
    return not (start and now) or start == now  # the number may be another process's by now


def _start(pid: int) -> int:
    """Return when a process started, in ticks since the machine did; 0: not known, -1: it has ended."""
    try:
        if os.readlink("/proc/self") != str(os.getpid()):
            return 0  # the numbers there are others
        state = Path(f"/proc/{pid}/stat").read_text(encoding="ascii", errors="replace").rpartition(")")[2].split()
        return -1 if state[0] in "XZ" else int(state[19])
    except (OSError, ValueError, IndexError):
        return 0
