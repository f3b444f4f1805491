"""What may be uploaded: so many files, bytes and pixels, under harmless names, out of harmless archives."""

import asyncio
import re
import stat
import struct
import zipfile
from collections.abc import AsyncIterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from render.shared.errors import InputError
from render.shared.files import parse_json
from sdps.photos.pictures.picture_kinds import SUFFIXES, picture_kind

PICTURES = tuple(SUFFIXES)
_BESIDE = (".txt", ".json")
_NAME = re.compile(r"[^\w.,()+ -]+")
_CHUNK = 2**20
_EXR_HEADER = 2**16
_EXR_WINDOW = re.compile(rb"(?:data|display)Window\0box2i\0\x10\0\0\0(.{16})", re.DOTALL)
_MOST_SETTINGS = 64 << 10


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


async def receive_archive(
    stream: AsyncIterator[bytes], archive: Path, folder: Path, limits: Limits, room: int
) -> int:  # fmt: skip
    """Unpack a request's body, a ZIP, into a folder that is there, and return the bytes of its files.

    Raises:
        InputError: as `receive`, `unpack` and `check_pixels`.
    """
    try:
        await receive(stream, archive, room)
        size = await asyncio.to_thread(unpack, archive, folder, limits, room)
        for path in folder.iterdir():
            await asyncio.to_thread(check_pixels, path, limits)
        return size
    finally:
        archive.unlink(missing_ok=True)


async def settings(stream: AsyncIterator[bytes]) -> dict[str, Any]:
    """Return the JSON object of a request's body.

    Raises:
        InputError: more than 64 KiB, or no JSON object.
    """
    body = bytearray()
    async for chunk in stream:
        body += chunk
        if len(body) > _MOST_SETTINGS:
            raise InputError(f"the request: more than {_MOST_SETTINGS >> 10} KiB of settings; load the page again")
    try:
        asked = parse_json(body.decode())
    except ValueError as error:
        raise InputError(f"the request: is not JSON ({error}); load the page again") from error
    if not isinstance(asked, dict):
        raise InputError("the request: must be a JSON object; load the page again")
    return asked


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
    except InputError:
        raise
    except Exception as error:  # damaged archives end in errors of many kinds: zlib.error, OSError of a seek
        raise InputError(f"{archive.name}: cannot be unpacked ({error}); make the ZIP again") from error
    if not count:
        raise InputError(f"{archive.name}: no pictures in it; put PNG, TIFF, JPEG or other pictures there")
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
    """Return (width, height) that the header tells; the bytes say of what kind it is, as they do later."""
    try:
        with path.open("rb") as opened:
            kind = picture_kind(opened.read(_EXR_HEADER), path.name)
        if kind == "EXR":
            return _exr_size(path)
        if kind == "TIFF":
            import tifffile

            with tifffile.TiffFile(path) as opened:
                page = opened.pages[0]
                return int(page.imagewidth), int(page.imagelength)  # type: ignore[union-attr]
        from PIL import Image

        with Image.open(path) as image:
            return image.size
    except Exception as error:  # the libraries' errors on damaged files are of many kinds
        raise InputError(f"{path.name}: is no picture that can be read; save it again") from error


def _exr_size(path: Path) -> tuple[int, int]:
    """Return (width, height) of an OpenEXR file's largest window, read by hand: its library could take the server down.

    A header is a magic number and a version, then attributes: name, type, length, value.
    """
    with path.open("rb") as opened:
        head = opened.read(_EXR_HEADER)
    found = [struct.unpack("<4i", corners) for corners in _EXR_WINDOW.findall(head)]  # of all parts
    if not found or not head.startswith(b"\x76\x2f\x31\x01"):
        raise ValueError("no dataWindow")
    sizes = [(right - left + 1, high - low + 1) for left, low, right, high in found]
    return max(sizes, key=lambda size: size[0] * size[1])


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
