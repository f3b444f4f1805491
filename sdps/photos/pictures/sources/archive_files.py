"""ZIP archives: their usable files, under safe names, whole or not at all, and never more than announced limits.

`sdps infer` and the app unpack with this. An archive may lie about everything: sizes are counted while reading, a huge
table of contents is not loaded, and names are taken apart, cleaned and put together again.
"""

import errno
import io
import re
import shutil
import stat
import zipfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

from render.shared.decoding import largest_unpacked
from render.shared.errors import InputError
from sdps.photos.pictures.picture_kinds import NAMED

MOST_FILES = 5000
MOST_LISTING = 4 * 2**20
"""Bytes of a table of contents."""

_CHUNK = 2**20
_METHODS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)  # zipfile unpacks other methods in one piece, however large
_UNUSUAL = re.compile(r'[\x00-\x1f<>:"|?*\x7f]')
_LONGEST = 200  # bytes of a name; file systems allow 255, and writers add a prefix or suffix
_SPARE = 2**28  # bytes of a disk that are left alone
_FULL = (errno.ENOSPC, getattr(errno, "EDQUOT", errno.ENOSPC))


@dataclass(frozen=True, kw_only=True)
class Unpacking:
    """What becomes of the files of an archive.

    Attributes:
        place: Where a file of this name goes, below the folder; None: it is not used.
        files: How many there may be.
        take: Called with a file and a number of its bytes, before they are written; may refuse.
        check: Called with each file when it is complete; may refuse.
        consume: Called with the bytes that the archive has lost: it is unpacked from its end and truncated as it is
            read, so that it and its files never take much more space than either alone. None: it stays as it is.
    """

    place: Callable[[str], PurePosixPath | None]
    files: int
    take: Callable[[Path, int], None]
    check: Callable[[Path], None] = lambda path: None
    consume: Callable[[int], None] | None = None


def unpack_files(archive: Path, folder: Path, how: Unpacking) -> list[Path]:
    """Unpack the usable files of a ZIP into a new folder and return them.

    Raises:
        InputError: not a ZIP, no usable file, a file twice, a link, a password, a method other than Deflate, too many
            files, or what `how` refuses.
        OSError: the disk is full.
    """
    files = []
    folder.mkdir()
    try:
        with _Archive(archive, "r" if how.consume is None else "r+") as handle, zipfile.ZipFile(handle) as opened:
            left = archive.stat().st_size
            chosen = _choose_files(opened, archive.name, how)
            for place, item in sorted(chosen.items(), key=lambda pair: -pair[1].header_offset):
                files.append(folder / place)
                files[-1].parent.mkdir(parents=True, exist_ok=True)
                _extract(opened, item, files[-1], how)
                how.check(files[-1])
                if how.consume is not None:
                    handle.truncate(item.header_offset)
                    how.consume(left - item.header_offset)
                    left = item.header_offset
        if how.consume is not None:
            archive.unlink()
            how.consume(left)
    except InputError:
        raise
    except Exception as error:  # damaged archives raise many kinds of errors: zlib.error, OSError of a seek
        if isinstance(error, OSError) and error.errno in _FULL:
            raise
        raise InputError(f"{archive.name}: cannot be unpacked ({error}); make the ZIP again") from error
    return files


def unpack_folders(archive: Path, folder: Path, suffixes: tuple[str, ...]) -> list[Path]:
    """Unpack the files of a ZIP that have one of these suffixes, with its folders, into a new folder.

    At most 5,000 files are unpacked, 128 MiB or 128 times the archive's size, and as long as the disk has room.

    Args:
        archive: The file.
        folder: To be made; its parent is there.
        suffixes: In lower case.

    Raises:
        InputError: as `unpack_files`; too many bytes, or a full disk. The line begins with the archive's path.
    """
    room = min(largest_unpacked(archive), shutil.disk_usage(folder.parent).free - _SPARE)

    def take(path: Path, size: int) -> None:
        nonlocal room
        room -= size
        if room < 0:
            raise InputError(
                f"{archive.name}: is too large unpacked ({path.name} is where it stopped); unpack it yourself and give "
                "the folder"
            )

    def place(name: str) -> PurePosixPath | None:
        found = clean_place(name)
        return found if found is not None and found.suffix.lower() in suffixes else None

    try:
        return unpack_files(archive, folder, Unpacking(place=place, files=MOST_FILES, take=take))
    except InputError as error:
        said = str(error)
        where = f"{archive.parent / said}" if said.startswith(f"{archive.name}:") else f"{archive}: {said}"
        raise InputError(where) from error
    except OSError as error:
        raise InputError(f"{archive}: no room to unpack it in {folder.parent}; free some, or set TMPDIR") from error


def clean_place(name: str) -> PurePosixPath | None:
    """Return where a file of an archive goes: its path without drives, `..` and characters that no system allows; None
    for hidden files, what macOS adds, and names of nothing.
    """
    parts = [part for part in re.split(r"[/\\]", re.sub(r"^[A-Za-z]:", "", name)) if part.strip(" .")]
    if not parts or is_hidden(name):
        return None
    return PurePosixPath(*(_shorten(_UNUSUAL.sub("_", part).strip()) for part in parts))


def is_hidden(name: str) -> bool:
    """Tell whether a file of an archive is hidden, or one that macOS adds."""
    return any(part.startswith((".", "__MACOSX")) for part in re.split(r"[/\\]", name) if part not in ("", ".", ".."))


def _shorten(part: str) -> str:
    """Return the end of a name, which has the suffix, with at most 200 bytes."""
    return part.encode("utf-8", "replace")[-_LONGEST:].decode("utf-8", "ignore")


class _Archive(io.FileIO):
    """A file that refuses huge reads: `zipfile` would load a table of contents of gigabytes."""

    def read(self, size: int | None = -1, /) -> bytes:
        if size is not None and size > MOST_LISTING:
            raise InputError(f"{Path(str(self.name)).name}: contains too many files; leave some out")
        return super().read(size if size is not None and size >= 0 else MOST_LISTING) or b""


def _choose_files(opened: zipfile.ZipFile, name: str, how: Unpacking) -> dict[PurePosixPath, zipfile.ZipInfo]:
    """Return the entries to unpack, by where they go.

    Raises:
        InputError: as `unpack_files`, as far as the table of contents shows it.
    """
    chosen: dict[PurePosixPath, zipfile.ZipInfo] = {}
    for item in opened.infolist():
        place = None if item.is_dir() or is_hidden(item.filename) else how.place(item.filename)
        if place is None:
            continue
        if stat.S_ISLNK(item.external_attr >> 16):
            raise InputError(f"{name}: {place} is a link; put the file itself into the ZIP")
        if item.flag_bits & 1:
            raise InputError(f"{name}: needs a password; make the ZIP without one")
        if item.compress_type not in _METHODS:
            raise InputError(f"{name}: uses a compression method that is not supported; make the ZIP with Deflate")
        if place in chosen:
            raise InputError(f"{place}: two folders of the archive have a file of this name; send one folder at a time")
        chosen[place] = item
        if len(chosen) > how.files:
            raise InputError(f"{name}: more than {how.files} files; leave some out")
    if not chosen:
        raise InputError(f"{name}: contains no pictures; add {NAMED} files")
    return chosen


def _extract(opened: zipfile.ZipFile, item: zipfile.ZipInfo, path: Path, how: Unpacking) -> None:
    """Write one file of an archive."""
    with opened.open(item) as source, path.open("xb") as target:
        while chunk := source.read(_CHUNK):
            how.take(path, len(chunk))
            target.write(chunk)
