"""ZIP archives that users upload: their usable files, under safe names, within the limits."""

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
_METHODS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)  # zipfile unpacks other methods in one piece, however large


def unpack(archive: Path, folder: Path, limits: Limits, coming: Incoming) -> list[Path]:
    """Unpack the usable files of a ZIP into a new folder, without subfolders; check and return them.

    The archive is consumed: it is unpacked from its end and truncated as it is read, so that it and its files together
    never take much more space than either alone. Sizes are counted while reading, since an archive may lie.

    Raises:
        InputError: not a ZIP, no usable file, a duplicate name, a link, a password, a method other than Deflate, too
            many files or bytes, a picture with too many pixels.
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
    except Exception as error:  # damaged archives raise many kinds of errors: zlib.error, OSError of a seek
        refusal = explain_full_disk(archive.name, error) if isinstance(error, OSError) else None
        raise refusal or InputError(f"{archive.name}: cannot be unpacked ({error}); make the ZIP again") from error
    return files


class _Archive(io.FileIO):
    """A file that refuses huge reads: `zipfile` would load a table of contents of gigabytes."""

    def read(self, size: int | None = -1, /) -> bytes:
        if size is not None and size > _MOST_LISTING:
            raise InputError(f"{Path(str(self.name)).name}: contains too many files; leave some out")
        return super().read(size if size is not None and size >= 0 else _MOST_LISTING) or b""


def _choose_files(opened: zipfile.ZipFile, name: str, limits: Limits) -> list[zipfile.ZipInfo]:
    """Return the entries to unpack.

    Raises:
        InputError: as `unpack`, as far as the table of contents shows it.
    """
    chosen: dict[str, zipfile.ZipInfo] = {}
    for item in opened.infolist():
        last = None if item.is_dir() or _is_hidden(item.filename) else _find_safe_name(item.filename)
        if last is None:
            continue
        if stat.S_ISLNK(item.external_attr >> 16):
            raise InputError(f"{name}: {last} is a link; put the file itself into the ZIP")
        if item.flag_bits & 1:
            raise InputError(f"{name}: needs a password; make the ZIP without one")
        if item.compress_type not in _METHODS:
            raise InputError(f"{name}: uses a compression method that is not supported; make the ZIP with Deflate")
        if last in chosen:
            raise InputError(f"{last}: two folders of the archive have a file of this name; send one folder at a time")
        chosen[last] = item
        if len(chosen) > limits.files:
            raise InputError(f"{name}: more than {limits.files} files; leave some out")
    if not chosen:
        raise InputError(f"{name}: contains no pictures; add {list_kinds()} files")
    return list(chosen.values())


def _extract(opened: zipfile.ZipFile, item: zipfile.ZipInfo, path: Path, coming: Incoming) -> None:
    """Write one file of an archive."""
    most, size = most_bytes(path.name), 0
    name = Path(str(opened.filename)).name
    with opened.open(item) as source, path.open("xb") as target:
        while chunk := source.read(_CHUNK):
            size += len(chunk)
            if most is not None and size > most:
                raise InputError(f"{name}: is too large unpacked; {path.name} alone has more than {most >> 20} MiB")
            coming.take(len(chunk), f"{name}: is too large unpacked")
            target.write(chunk)


def _is_hidden(name: str) -> bool:
    return any(part.startswith((".", "__MACOSX")) for part in re.split(r"[/\\]", name) if part not in ("", ".", ".."))


def _find_safe_name(name: str) -> str | None:
    """Return the safe name of a file of an archive, None if it cannot be used."""
    try:
        return clean_name(name)
    except InputError:
        return None
