"""Writing files so that a reader meets either the whole file or none."""

import errno
import hashlib
import json
import os
import random
import re
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from functools import lru_cache
from pathlib import Path
from typing import Any

from render.shared.errors import InputError
from render.shared.temporary import discard, temporary_path, tidy

_SURROGATE = re.compile(r"\\u[dD][89a-fA-F]")
_DIGITS = re.compile(r"[0-9a-fA-F_:]+")
_LONG_NUMBER = re.compile(r"[0-9a-fA-F_:]{256}")
_PUTTING = threading.Lock()  # threads of this process take turns; other processes are waited for
# What a rename says where another process has just put a folder (or, replacing a link, a file); Windows' own first.
_ANOTHER = {errno.EACCES if os.name == "nt" else errno.ENOTEMPTY, errno.ENOTEMPTY, errno.EEXIST, errno.ENOTDIR}
_WAIT_S = 30.0  # how long to try to put a folder in place, while other processes put theirs
_PLAIN_NAME = re.compile(r"(?!\.)[^/\\\0-\x1f\x7f]{1,200}")


def is_plain_name(name: str) -> bool:
    """Return whether a name from a file can be that of a file in a given folder, and of nothing outside it."""
    return _PLAIN_NAME.fullmatch(name) is not None


def cache_folder() -> Path:
    """Return the per-user folder for things fetched once: $SDPS_CACHE, else `users_cache_folder`."""
    chosen = os.environ.get("SDPS_CACHE")
    return Path(chosen) if chosen else users_cache_folder()


def users_cache_folder() -> Path:
    """Return `sdps` in the user's cache folder; $SDPS_CACHE does not count."""
    base = os.environ.get("XDG_CACHE_HOME") or os.environ.get("LOCALAPPDATA")
    return (Path(base) if base else Path.home() / ".cache") / "sdps"


@contextmanager
def atomic_path(path: str | Path) -> Iterator[Path]:
    """Yield a temporary path next to `path`; on success flush it to disk and rename it, on failure remove it.

    The temporary name keeps the suffix, since several writers choose the format by it.

    Raises:
        InputError: the disk is full or the folder cannot be written; nothing is left behind.
    """
    path = Path(path)
    temporary = temporary_path(path, suffix=True)
    try:
        with writing(path):
            path.parent.mkdir(parents=True, exist_ok=True)
            _tidy_once(path.parent)
            yield temporary
            _flush(temporary)
            os.replace(temporary, path)
    finally:
        with suppress(OSError):
            temporary.unlink(missing_ok=True)


@contextmanager
def atomic_folder(path: str | Path) -> Iterator[Path]:
    """Yield an empty folder next to `path` and rename it to `path` on success, in place of what is there.

    Whenever it ends, the old folder or the new one stands at `path`; after a kill between two renamings the old one
    lies next to it, and comes back with the next call for any folder of the same parent, or with `tidy`.

    Raises:
        InputError: the disk is full or the parent cannot be written; nothing new is left behind.
    """
    path = Path(path)
    temporary = temporary_path(path)
    try:
        with writing(path):
            path.parent.mkdir(parents=True, exist_ok=True)
            tidy(path.parent, path.name)
            temporary.mkdir()
            yield temporary
            for below in temporary.rglob("*"):
                if below.is_file():
                    _flush(below)
                elif below.is_dir():
                    _flush_folder(below)
            _flush_folder(temporary)
            with _PUTTING:
                _put_in_place(temporary, path)
    finally:
        discard(temporary)


@lru_cache(maxsize=1000)
def _tidy_once(folder: Path) -> None:
    """Remove what killed processes left in a folder, before this one first writes there."""
    tidy(folder)


def _put_in_place(new: Path, path: Path) -> None:
    """Rename a folder to `path`. What was there is moved aside, and removed only once the new one stands there."""
    aside, given_up = [], time.monotonic() + _WAIT_S
    try:
        while True:
            if os.path.lexists(path):
                aside.append(temporary_path(path, "old"))
                with suppress(FileNotFoundError):  # another process was faster
                    os.replace(path, aside[-1])
            try:
                os.replace(new, path)
                break
            except OSError as error:
                if error.errno not in _ANOTHER or time.monotonic() > given_up:
                    raise
            time.sleep(random.uniform(0, 0.02))  # or processes in step would meet again and again
        _flush_folder(path.parent)  # before the old one is removed
    finally:
        for old in reversed(aside):
            if not os.path.lexists(path):
                with suppress(OSError):  # another process was faster
                    os.rename(old, path)
            if os.path.lexists(path):
                discard(old)


def _flush(path: Path) -> None:
    """Bring a file to the disk, or a loss of power after the renaming could leave an empty one under its name."""
    writable = os.access(path, os.W_OK)
    if os.name == "nt" and not writable:
        return  # Windows flushes only what was opened for writing
    with open(path, "r+b" if writable else "rb") as handle:
        os.fsync(handle.fileno())


def _flush_folder(path: Path) -> None:
    """Write the names in a folder to the disk, where the system can do that; otherwise a rename may reach it later."""
    if os.name == "nt":
        return  # has no such call
    with suppress(OSError):
        descriptor = os.open(path, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)


@contextmanager
def writing(path: Path) -> Iterator[None]:
    """Turn what the disk refuses into one line.

    Raises:
        InputError: the disk is full or the file cannot be written.
    """
    try:
        yield
    except OSError as error:
        raise InputError(
            f"{path}: cannot be written ({error.strerror or error}); free space or choose another --out"
        ) from error


def read_bytes(path: str | Path, missing: str = "no such file") -> bytes:
    """Read a whole file.

    Args:
        path: The file.
        missing: What to say where there is none.

    Raises:
        InputError: the file is missing or unreadable.
    """
    try:
        return Path(path).read_bytes()
    except FileNotFoundError as error:
        raise InputError(f"{path}: {missing}") from error
    except (OSError, ValueError) as error:  # a path may hold a zero
        raise InputError(f"{path}: cannot be read ({getattr(error, 'strerror', '') or error})") from error


def write_text(path: str | Path, text: str) -> None:
    """Write `text` (UTF-8) atomically."""
    with atomic_path(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def write_json(path: str | Path, value: Any) -> None:
    """Write `value` as indented JSON, atomically."""
    write_text(path, json.dumps(value, indent=2) + "\n")


def write_jsonl(path: str | Path, rows: list[dict[str, Any]]) -> None:
    """Write one JSON object per line, atomically."""
    write_text(path, "".join(json.dumps(row) + "\n" for row in rows))


def check_digits(text: str) -> None:
    """Refuse text with a number that no float can hold; it would end in an `OverflowError` wherever it is used.

    Raises:
        ValueError: there are 256 digits, decimal or hexadecimal, in a row.
    """
    # A run of 256 covers a whole block of 128; most blocks are left at their first letter.
    if any(_DIGITS.fullmatch(text, at, at + 128) for at in range(0, len(text), 128)) and _LONG_NUMBER.search(text):
        raise ValueError("a number of more than 255 digits")


def parse_json(text: str) -> Any:
    """Parse JSON, with one kind of error: numbers of hundreds of digits and lists in lists without end have others.

    Raises:
        ValueError: not JSON, a number beyond those of floating point, or text that no file can hold (one half of a
            surrogate pair).
    """
    check_digits(text)
    try:
        value = json.loads(text)
        if _SURROGATE.search(text):
            json.dumps(value, ensure_ascii=False).encode()
        return value
    except RecursionError as error:
        raise ValueError("nested too deeply") from error


def read_json(path: str | Path, remedy: str) -> Any:
    """Read a JSON file.

    Raises:
        InputError: the file is missing, or is not JSON.
    """
    text = read_text(path)
    try:
        return parse_json(text)
    except ValueError as error:
        raise InputError(f"{path}: is not JSON ({error}); {remedy}") from error


def read_jsonl(path: str | Path) -> list[dict[str, Any]]:
    """Read one JSON object per line.

    Raises:
        InputError: the file is missing, or a line is not JSON (named by its number).
    """
    rows = []
    for number, line in enumerate(read_text(path).splitlines(), start=1):
        try:
            rows.append(parse_json(line))
        except ValueError as error:
            reason = getattr(error, "msg", error)
            raise InputError(f"{path}: line {number} is not JSON ({reason}); plan the data again") from error
    return rows


def read_whole_lines(path: Path) -> Iterator[Any]:
    """Yield the JSON values of a file of lines that is appended to, which may be missing; a torn line is passed over.

    Raises:
        InputError: the file cannot be read.
    """
    try:
        text = path.read_text(encoding="utf-8", errors="replace")
    except FileNotFoundError:
        return
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error})") from error
    for line in text.splitlines():
        try:
            yield parse_json(line)
        except ValueError:
            continue


def read_text(path: str | Path) -> str:
    """Read a UTF-8 text file, without the mark that Windows' editors put at its beginning.

    Raises:
        InputError: the file is missing, unreadable or not text.
    """
    try:
        return Path(path).read_text(encoding="utf-8-sig")
    except FileNotFoundError as error:
        raise InputError(f"{path}: no such file") from error
    except (OSError, ValueError) as error:  # of the text, or of a zero in the path
        raise InputError(f"{path}: cannot be read as text ({error})") from error


def source_digest(*folders: Path) -> str:
    """Return a short hash of all Python files in folders, by name and content."""
    digest = hashlib.sha256()
    for folder in folders:
        for path in sorted(folder.rglob("*.py")):
            digest.update(str(path.relative_to(folder.parent)).encode() + path.read_bytes())
    return digest.hexdigest()[:12]
