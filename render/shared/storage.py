"""Object storage (`s3://`, `gs://`, `az://`; `https://` for reading) by way of fsspec's drivers.

Objects are read and written whole: a reader meets either a whole object or none. Where waiting helps (no connection, a
store that is full or busy) an operation is tried again; where it does not (a wrong key, a missing bucket) it ends in
one line. Addresses, keys and endpoints are those of the drivers: `AWS_PROFILE`, `AWS_ENDPOINT_URL` and so on.
"""

import errno
import hashlib
import logging
import os
import re
import sys
import threading
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

from render.shared.errors import InputError
from render.shared.files import cache_folder
from render.shared.temporary import is_temporary, temporary_path

WAIT = 900.0  # seconds that an operation is tried again for; $SDPS_STORAGE_WAIT
TOGETHER = 8  # objects sent or fetched at once
_ADDRESS = re.compile(r"([a-z][a-z0-9+.-]+):/{1,3}([^/].*)")  # `Path` makes one slash of two; a drive is one letter
_VERSIONS = ("ETag", "etag", "generation", "md5Hash", "mtime", "LastModified", "last_modified")
_DRIVERS = {"botocore", "aiobotocore", "aiohttp", "google", "gcsfs", "azure", "requests", "urllib3"}
"""Packages whose errors are about the connection or the store; errors of others are defects."""
_OPTIONS = {"s3": {"max_concurrency": 1}}  # else every read begins with a request for the size
_INSTALL = {"s3": "sdps[storage]", "gs": "gcsfs", "gcs": "gcsfs", "az": "adlfs", "abfs": "adlfs"}
_HOPELESS = {errno.EINVAL, errno.EISDIR, errno.ENOTDIR, errno.ENAMETOOLONG, errno.EROFS}
_log = logging.getLogger(__name__)
_T = TypeVar("_T")


class Missing(InputError):
    """There is no such object or bucket."""


class Stored(NamedTuple):
    """What a listing says of an object: its bytes, and a text that changes when it is written again."""

    size: int
    version: str


def address(place: str | Path) -> str | None:
    """Return a folder's address in a store, without a slash at its end; None for a folder of this machine."""
    match = _ADDRESS.fullmatch(str(place))
    slashes = "///" if match and match[1] == "file" else "//"
    return f"{match[1]}:{slashes}{match[2].rstrip('/')}" if match else None


def local_copy(url: str, purpose: str) -> Path:
    """Return the folder on this disk that stands for an address, in the user's cache folder."""
    words = re.sub(r"[^A-Za-z0-9]+", "-", url.partition("://")[2]).strip("-")[-60:]
    return cache_folder() / "storage" / f"{words}-{hashlib.sha256(url.encode()).hexdigest()[:12]}-{purpose}"


class Store:
    """The objects below an address.

    Args:
        url: Such as `s3://bucket/run`.

    Raises:
        InputError: no driver for such an address. Every method: wrong keys, no such bucket, or a store that could not
            be reached for `WAIT` seconds.
    """

    def __init__(self, url: str) -> None:
        self.url = url
        self.wait = float(os.environ.get("SDPS_STORAGE_WAIT") or WAIT)
        self.stopped = threading.Event()  # ends waiting in other threads
        self._open()

    @property
    def read_only(self) -> bool:
        """Whether nothing can be written there."""
        return self.url.partition("://")[0] in ("http", "https")

    def _open(self) -> tuple[Any, str]:
        """Return driver and root; fsspec keeps one driver per process, also after a fork."""
        try:
            from fsspec.core import url_to_fs

            return url_to_fs(self.url, **_OPTIONS.get(self.url.partition(":")[0], {}))
        except ImportError as error:
            python = f"{sys.executable} -m " if sys.executable else ""
            driver = _INSTALL.get(self.url.partition(":")[0], _INSTALL["s3"])
            raise InputError(f"{self.url}: needs a driver: {python}pip install '{driver}'") from error
        except ValueError as error:
            raise InputError(f"{self.url}: {error}; use s3://, gs://, az:// or https://") from error

    def files(self) -> dict[str, Stored]:
        """Return all objects below the address by name; an address that has none is empty.

        Raises:
            InputError: a web server, which has no listing.
        """
        driver, root = self._open()
        if self.read_only:
            raise InputError(f"{self.url}: cannot be listed")
        driver.invalidate_cache()
        found = self._patiently("list", "", lambda: driver.find(root, detail=True))
        prefix = len(root.rstrip("/")) + 1
        return {
            name[prefix:]: _read_description(info)
            for name, info in found.items()
            if len(name) > prefix and not is_temporary(name.rpartition("/")[2])  # being written, in a folder
        }

    def look(self, names: Sequence[str]) -> dict[str, Stored]:
        """Return those of the named objects that are there, at one request each."""

        def one(name: str) -> Stored | None:
            driver, root = self._open()
            try:
                return _read_description(self._patiently("look at", name, lambda: driver.info(f"{root}/{name}")))
            except Missing:
                return None

        with ThreadPoolExecutor(TOGETHER) as pool:
            return {name: info for name, info in zip(names, pool.map(one, names), strict=True) if info}

    def read(self, name: str) -> bytes:
        """Return an object's bytes; `Missing` where there is none."""
        driver, root = self._open()
        return self._patiently("read", name, lambda: driver.cat_file(f"{root}/{name}"))

    def write(self, name: str, data: bytes) -> Stored:
        """Write an object, in place of what is there; its version is left to the next listing."""
        driver, root = self._open()
        self._patiently("write", name, lambda: _put(driver, f"{root}/{name}", data))
        return Stored(len(data), "")

    def create(self, name: str, data: bytes) -> bool:
        """Write an object unless there is one; return whether it was written."""
        driver, root = self._open()
        try:
            self._patiently("write", name, lambda: _put(driver, f"{root}/{name}", data, mode="create"))
        except FileExistsError:
            return False
        return True

    def remove(self, name: str) -> None:
        """Remove an object, if it is there."""
        driver, root = self._open()
        try:
            self._patiently("remove", name, lambda: driver.rm_file(f"{root}/{name}"))
        except Missing:
            return

    def _patiently(self, what: str, name: str, action: Callable[[], _T]) -> _T:
        """Do something, again while waiting may help."""
        where = f"{self.url}/{name}" if name else self.url
        start, pause, warned = time.monotonic(), 1.0, False
        while True:
            try:
                return action()
            except Exception as error:
                if isinstance(error, FileExistsError) or not _of_the_store(error):
                    raise
                if hopeless := _hopeless(where, error):
                    raise hopeless from error
                left = start + self.wait - time.monotonic()
                if left <= 0 or self.stopped.is_set():
                    raise InputError(
                        f"{where}: cannot {what} it ({error}); what is finished is kept, run the same command again "
                        "once the store is there"
                    ) from error
                if not warned:
                    _log.warning("%s: cannot %s it now (%s); trying again for %.0f s", where, what,
                                 _short(error), left)  # fmt: skip
                warned = True
            self.stopped.wait(min(pause, left))
            pause = min(2 * pause, 20.0)


def _put(driver: Any, path: str, data: bytes, **mode: str) -> None:
    """Write an object whole or not at all, which a folder does not do by itself.

    Raises:
        FileExistsError: with mode `create`, there is one.
    """
    if "file" not in driver.protocol:
        driver.pipe_file(path, data, **mode)
        return
    part = str(temporary_path(Path(path)))
    driver.makedirs(path.rpartition("/")[0], exist_ok=True)
    try:
        driver.pipe_file(part, data)
        (os.link if mode else os.replace)(part, path)
    finally:
        Path(part).unlink(missing_ok=True)


def _read_description(info: dict[str, Any]) -> Stored:
    """Return what the project needs of a driver's description."""
    return Stored(int(info.get("size") or 0), str(next((info[key] for key in _VERSIONS if info.get(key)), "")))


def _of_the_store(error: Exception) -> bool:
    """Return whether an error is one of store or connection, not a defect of this project."""
    return isinstance(error, OSError | TimeoutError) or type(error).__module__.partition(".")[0] in _DRIVERS


def _hopeless(where: str, error: Exception) -> InputError | None:
    """Return what to say of an error that waiting does not help."""
    if isinstance(error, FileNotFoundError):
        return Missing(f"{where}: {_short(error)}; create the bucket, or correct the address")
    if isinstance(error, PermissionError) or "Credential" in type(error).__name__:
        return InputError(f"{where}: refused ({_short(error)}); check the keys (for s3: `aws sts get-caller-identity`)")
    if isinstance(error, OSError) and error.errno in _HOPELESS:
        return InputError(f"{where}: {_short(error)}; correct the address")
    status = getattr(error, "status", 0)  # of aiohttp
    if status in (400, 401, 403, 404, 410):
        return Missing(f"{where}: {_short(error)}; correct the address")
    return None


def _short(error: Exception) -> str:
    return " ".join(str(error).split())[:200] or type(error).__name__
