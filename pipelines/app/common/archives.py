"""ZIP archives from outside: their usable files, under harmless names, and no more bytes than there is room for."""

import io
import re
import stat
import zipfile
from pathlib import Path

from pipelines.app.common.incoming import Incoming
from pipelines.app.common.refusals import explain_full_disk
from pipelines.app.common.uploads import Limits, check_pixels, clean_name, list_kinds, most_bytes
from render.shared.errors import InputError

_CHUNK = 2**20
_MOST_LISTING = 4 * 2**20
_METHODS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)  # zipfile unpacks what others hold whole, however much it is


def unpack(archive: Path, folder: Path, limits: Limits, coming: Incoming) -> list[Path]:
    """Unpack the usable files of a ZIP into a new folder, without their folders, check them, and return them.

    The archive is used up: it is unpacked from its end and cut off where it was read, so that it and its files never
    take much more together than either does alone. Sizes are counted while reading, since an archive may lie.

    Raises:
        InputError: not a ZIP, nothing usable in it, a name twice, a link, a password, another method than Deflate, too
            many files or bytes, a picture of too many pixels.
    """
    files = []
    folder.mkdir()
    try:
        with _Archive(archive, "r+") as handle, zipfile.ZipFile(handle) as opened:
            left = archive.stat().st_size
            for item in sorted(_choose_files(opened, archive.name, limits), key=lambda item: -item.header_offset):
                files.append(folder / clean_name(item.filename))
                _extract(opened, item, files[-1], coming)
                check_pixels(files[-1], limits)
                handle.truncate(item.header_offset)
                coming.give(left - item.header_offset)
                left = item.header_offset
        archive.unlink()
        coming.give(left)
    except InputError:
        raise
    except Exception as error:  # damaged archives end in errors of many kinds: zlib.error, OSError of a seek
        refusal = explain_full_disk(archive.name, error) if isinstance(error, OSError) else None
        raise refusal or InputError(f"{archive.name}: cannot be unpacked ({error}); make the ZIP again") from error
    return files


class _Archive(io.FileIO):
    """A file of which nobody reads very much at once: `zipfile` would load a table of contents of gigabytes."""

    def read(self, size: int | None = -1, /) -> bytes:
        if size is not None and size > _MOST_LISTING:
            raise InputError(f"{Path(str(self.name)).name}: holds too many files; leave some out")
        return super().read(size if size is not None and size >= 0 else _MOST_LISTING) or b""


def _choose_files(opened: zipfile.ZipFile, name: str, limits: Limits) -> list[zipfile.ZipInfo]:
    """Return what is to be unpacked.

    Raises:
        InputError: as `unpack`, of what the table of contents tells.
    """
    chosen: dict[str, zipfile.ZipInfo] = {}
    for item in opened.infolist():
        last = None if item.is_dir() or _is_hidden(item.filename) else _name(item.filename)
        if last is None:
            continue
        if stat.S_ISLNK(item.external_attr >> 16):
            raise InputError(f"{name}: {last} in it is a link; put the file itself there")
        if item.flag_bits & 1:
            raise InputError(f"{name}: is locked with a password; make the ZIP without one")
        if item.compress_type not in _METHODS:
            raise InputError(f"{name}: is packed in a way that is not read here; make the ZIP with Deflate")
        if last in chosen:
            raise InputError(f"{last}: is twice in the archive, in two folders; send one folder at a time")
        chosen[last] = item
        if len(chosen) > limits.files:
            raise InputError(f"{name}: more than {limits.files} files; leave some out")
    if not chosen:
        raise InputError(f"{name}: no pictures in it; put {list_kinds()} files there")
    return list(chosen.values())


def _extract(opened: zipfile.ZipFile, item: zipfile.ZipInfo, path: Path, coming: Incoming) -> None:
    """Write one file of an archive."""
    most, size = most_bytes(path.name), 0
    name = Path(str(opened.filename)).name
    with opened.open(item) as source, path.open("xb") as target:
        while chunk := source.read(_CHUNK):
            size += len(chunk)
            if most is not None and size > most:
                raise InputError(f"{name}: unpacks to too many bytes, {path.name} alone to more than {most >> 20} MiB")
            coming.take(len(chunk), f"{name}: unpacks to too many bytes")
            target.write(chunk)


def _is_hidden(name: str) -> bool:
    return any(part.startswith((".", "__MACOSX")) for part in re.split(r"[/\\]", name) if part not in ("", ".", ".."))


def _name(name: str) -> str | None:
    """Return what a file of an archive will be called, None where it is of no use."""
    try:
        return clean_name(name)
    except InputError:
        return None
