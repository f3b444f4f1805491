"""What may be uploaded: so many files, bytes and pixels, under harmless names, out of harmless archives."""

import re
import stat
import zipfile
from collections.abc import AsyncIterator
from dataclasses import dataclass
from pathlib import Path

from render.shared.errors import InputError

PICTURES = (".png", ".tif", ".tiff", ".jpg", ".jpeg", ".exr")
_BESIDE = (".txt", ".json")
_NAME = re.compile(r"[^\w.,()+ -]+")
_CHUNK = 2**20


@dataclass(frozen=True, kw_only=True)
class Limits:
    """What one session may upload.

    Attributes:
        files: Files of one set.
        bytes: Bytes of the session, archives unpacked.
        pixels: Pixels of one picture.
    """

    files: int = 300
    bytes: int = 2 * 2**30
    pixels: int = 25_000_000


def safe_name(name: str, allowed: tuple[str, ...] = PICTURES + _BESIDE) -> str:
    """Return the last part of a name without odd characters.

    Raises:
        InputError: another suffix than those allowed, or nothing left.
    """
    last = _NAME.sub("_", re.split(r"[/\\]", name)[-1]).strip(" .")[-120:].strip(" .")
    if Path(last).suffix.lower() not in allowed or not Path(last).stem:
        raise InputError(f"{last or 'file'}: cannot be used here; allowed are {', '.join(allowed)}")
    return last


async def receive(stream: AsyncIterator[bytes], path: Path, room: int) -> int:
    """Write a request's body into a new file, and return its bytes; a body above `room` leaves nothing.

    Raises:
        InputError: more bytes than `room`, or a name that is taken.
    """
    size = 0
    try:
        with path.open("xb") as handle:
            async for chunk in stream:
                size += len(chunk)
                if size > room:
                    raise InputError(f"{path.name}: too large; all uploads together may have {_spelled(room)} more")
                handle.write(chunk)
    except FileExistsError as error:
        raise InputError(f"{path.name}: there are two files of this name; rename one") from error
    except BaseException:
        path.unlink(missing_ok=True)
        raise
    return size


def unpack(archive: Path, folder: Path, limits: Limits, room: int) -> int:
    """Unpack the usable files of a ZIP, without their folders, and return their bytes.

    Sizes are counted while reading, since an archive may lie about them.

    Raises:
        InputError: not a ZIP, nothing usable in it, a name twice, a link, a password, too many files or bytes.
    """
    size = count = 0
    try:
        with zipfile.ZipFile(archive) as opened:
            for item in opened.infolist():
                if item.is_dir() or _hidden(item.filename) or _unusable(item.filename):
                    continue
                if stat.S_ISLNK(item.external_attr >> 16):
                    raise InputError(f"{archive.name}: holds a link; put the files themselves in it")
                count += 1
                if count > limits.files:
                    raise InputError(f"{archive.name}: more than {limits.files} files; leave some out")
                size += _extract(opened, item, folder / safe_name(item.filename), room - size)
    except (zipfile.BadZipFile, RuntimeError, NotImplementedError, EOFError, ValueError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(f"{archive.name}: cannot be unpacked ({error}); make the ZIP again") from error
    if not count:
        raise InputError(f"{archive.name}: no pictures in it; put PNG, TIFF, JPEG or EXR files there")
    return size


def check_pixels(path: Path, limits: Limits) -> None:
    """Refuse a picture of too many pixels by its header, before anything decodes it.

    Raises:
        InputError: too large, or a header that cannot be read.
    """
    if path.suffix.lower() not in PICTURES:
        return
    width, height = _size(path)
    if width * height > limits.pixels or min(width, height) < 1:
        raise InputError(
            f"{path.name}: is {width}x{height} pixels; at most {limits.pixels / 1e6:.0f} million are allowed here, "
            "scale the pictures down or use `sdps infer`"
        )


def _size(path: Path) -> tuple[int, int]:
    """Return (width, height) that the header tells."""
    try:
        if path.suffix.lower() == ".exr":
            import OpenEXR

            low, high = OpenEXR.File(str(path), header_only=True).header()["dataWindow"]
            return int(high[0]) - int(low[0]) + 1, int(high[1]) - int(low[1]) + 1
        if path.suffix.lower() in (".tif", ".tiff"):
            import tifffile

            with tifffile.TiffFile(path) as opened:
                page = opened.pages[0]
                return int(page.imagewidth), int(page.imagelength)  # type: ignore[union-attr]
        from PIL import Image

        with Image.open(path) as image:
            return image.size
    except Exception as error:  # the libraries' errors on damaged files are of many kinds
        raise InputError(f"{path.name}: is no picture that can be read; save it again") from error


def _extract(opened: zipfile.ZipFile, item: zipfile.ZipInfo, path: Path, room: int) -> int:
    """Write one file of an archive."""
    size = 0
    try:
        with opened.open(item) as source, path.open("xb") as target:
            while chunk := source.read(_CHUNK):
                size += len(chunk)
                if size > room:
                    raise InputError(f"{opened.filename and Path(opened.filename).name}: unpacks to too many bytes")
                target.write(chunk)
    except FileExistsError as error:
        raise InputError(f"{path.name}: is twice in the archive, in two folders; send one folder at a time") from error
    return size


def _hidden(name: str) -> bool:
    return any(part.startswith((".", "__MACOSX")) for part in re.split(r"[/\\]", name) if part not in ("", ".", ".."))


def _unusable(name: str) -> bool:
    return Path(name).suffix.lower() not in PICTURES + _BESIDE


def _spelled(size: int) -> str:
    return f"{size / 2**20:.0f} MiB" if size < 2**30 else f"{size / 2**30:.1f} GiB"
