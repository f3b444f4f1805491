"""ZIP archives: what users upload, unpacked under safe names and within their limits, and what they take away."""

import threading
import zipfile
from pathlib import Path, PurePosixPath

from pipelines.app.common.incoming import Incoming
from pipelines.app.common.refusals import explain_full_disk
from pipelines.app.common.uploads import Limits, check_pixels, clean_place, most_bytes
from render.shared.errors import InputError
from render.shared.files import atomic_path
from sdps.photos.pictures.sources.archive_files import Unpacking, unpack_files

_PACKING = threading.Lock()


def unpack(archive: Path, folder: Path, limits: Limits, coming: Incoming) -> list[Path]:
    """Unpack the usable files of a ZIP into a new folder, below those of poses alone; check and return them.

    The archive is consumed: it is unpacked from its end and truncated as it is read.

    Raises:
        InputError: as `unpack_files`; too many bytes, or a picture with too many pixels.
    """
    sizes: dict[Path, int] = {}

    def take(path: Path, size: int) -> None:
        most = most_bytes(path.name)
        sizes[path] = sizes.get(path, 0) + size
        if most is not None and sizes[path] > most:
            raise InputError(f"{archive.name}: is too large unpacked; {path.name} alone has more than {most >> 20} MiB")
        coming.take(size, f"{archive.name}: is too large unpacked")

    how = Unpacking(
        place=_find_place, files=limits.files, take=take, check=lambda path: check_pixels(path, limits),
        consume=coming.give,
    )  # fmt: skip
    try:
        return unpack_files(archive, folder, how)
    except OSError as error:
        refusal = explain_full_disk(archive.name, error)
        if refusal is None:
            raise
        raise refusal from error


def _find_place(name: str) -> PurePosixPath | None:
    """Return the safe place of a file of an archive, None if it cannot be used."""
    try:
        return clean_place(name)
    except InputError:
        return None


def pack(folder: Path, archive: Path) -> None:
    """Write all files below a folder into a ZIP, unless it is there."""
    with _PACKING:  # two requests for the same run would write the same file
        if archive.is_file():
            return
        with atomic_path(archive) as temporary, zipfile.ZipFile(temporary, "w", zipfile.ZIP_DEFLATED) as opened:
            for path in sorted(folder.rglob("*")):
                if path.is_file():
                    opened.write(path, path.relative_to(folder))
