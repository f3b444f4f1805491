"""What may be uploaded: kinds of files, safe names, and limits of files, bytes and pixels."""

import re
import struct
from collections.abc import AsyncIterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path, PurePosixPath
from typing import Any

from PIL import Image

from render.shared.errors import InputError
from render.shared.files import parse_json
from sdps.photos.light_files import SUFFIXES as LIGHT_FILES
from sdps.photos.pictures.picture_kinds import FILMS, SUFFIXES, picture_kind
from sdps.photos.pictures.picture_names import name_layout

PICTURES = tuple(SUFFIXES)
"""Suffixes of the pictures that `sdps infer` and the app read."""
USABLE = (*PICTURES, *LIGHT_FILES, *FILMS)
"""Suffixes of what may be uploaded as, or with, photographs."""
_NAME = re.compile(r"[^\w.,()+ -]+")
_LONGEST = 200  # bytes of a name; file systems allow 255, and we may add a prefix or suffix
_TEXTS = (*LIGHT_FILES, ".yaml", ".yml")
_MOST_TEXT = 8 * 2**20
_EXR, _EXR_HEADER = b"\x76\x2f\x31\x01", 2**16
_EXR_WINDOW = re.compile(rb"(?:dataWindow|displayWindow)\0box2i\0\x10\0\0\0(.{16})", re.DOTALL)
_TIFF = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")
_MOST_SETTINGS = 64 << 10


@dataclass(frozen=True, kw_only=True)
class Limits:
    """What one session may upload.

    Attributes:
        files: Files of one set.
        bytes: Bytes of the session, with archives unpacked.
        pixels: Pixels of one picture.
    """

    files: int = 300
    bytes: int = 2 * 2**30
    pixels: int = 25_000_000


def clean_name(name: str, allowed: tuple[str, ...] = USABLE) -> str:
    """Return the last part of a name without unusual characters, at most 200 bytes.

    Raises:
        InputError: a suffix that is not allowed, or nothing is left.
    """
    last = _NAME.sub("_", re.split(r"[/\\]", name)[-1]).strip(" .")
    last = last.encode("utf-8", "replace")[-_LONGEST:].decode("utf-8", "ignore").strip(" .")
    if Path(last).suffix.lower() not in allowed or not Path(last).stem:
        raise InputError(f"{last or 'file'}: cannot be used here; give one of {', '.join(allowed)}")
    return last


def clean_place(name: str, allowed: tuple[str, ...] = USABLE) -> PurePosixPath:
    """Return where a file of this path goes: its clean name, below its folder where that is one of several poses.

    Raises:
        InputError: as `clean_name`.
    """
    last, folders = clean_name(name, allowed), re.split(r"[/\\]", name)[:-1]
    folder = _NAME.sub("_", folders[-1]).strip(" .")[-_LONGEST // 4 :] if folders else ""
    return PurePosixPath(folder, last) if name_layout(folder) else PurePosixPath(last)


async def read_settings(stream: AsyncIterator[bytes]) -> dict[str, Any]:
    """Return the JSON object of a request's body.

    Raises:
        InputError: more than 64 KiB, or not a JSON object.
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


def most_bytes(name: str) -> int | None:
    """Return how many bytes a file of this name may have (text files are read whole); None: as many as the session."""
    return _MOST_TEXT if Path(name).suffix.lower() in _TEXTS else None


def list_kinds() -> str:
    """Return the kinds of pictures as text: PNG, TIFF, ... or EXR."""
    *others, last = dict.fromkeys(SUFFIXES.values())
    return f"{', '.join(others)} or {last}"


def check_pixels(path: Path, limits: Limits) -> None:
    """Refuse a picture with too many pixels by its header, before anything decodes it.

    Raises:
        InputError: too large, or a header that cannot be read.
    """
    if path.suffix.lower() not in PICTURES:
        return
    try:
        width, height = _read_size(path)
    except Image.DecompressionBombError as error:
        raise InputError(_describe_excess(path, "has more pixels than a photograph", limits)) from error
    if width * height > limits.pixels or min(width, height) < 1:
        raise InputError(_describe_excess(path, f"is {width}x{height} pixels", limits))


def _describe_excess(path: Path, what: str, limits: Limits) -> str:
    return (
        f"{path.name}: {what}; at most {limits.pixels / 1e6:.3g} million are allowed here; scale the pictures down or "
        "use `sdps infer`"
    )


def _read_size(path: Path) -> tuple[int, int]:
    """Return (width, height) from the header. The content decides which kind of file it is, not the name."""
    try:
        with path.open("rb") as opened:
            head = opened.read(_EXR_HEADER)
        if head.startswith(_EXR):
            return _read_exr_size(head)
        # What makes a TIFF a RAW file may stand anywhere in it; all other kinds are told by their first bytes.
        kind = picture_kind(path.read_bytes() if head.startswith(_TIFF) else head, path.name)
        if kind in ("RAW", "HEIC"):
            from sdps.photos.pictures.decoding.camera_files import read_size

            return read_size(path, path.read_bytes(), kind)
        if head.startswith(_TIFF):
            import tifffile

            with tifffile.TiffFile(path) as file:
                page = file.pages[0]
                return int(page.imagewidth), int(page.imagelength)  # type: ignore[union-attr]
        with Image.open(path, formats=_list_formats()) as image:
            return image.size
    except (Image.DecompressionBombError, InputError):
        raise
    except Exception as error:  # libraries raise many kinds of errors on damaged files
        raise InputError(f"{path.name}: cannot be read as a picture; save it again") from error


@cache
def _list_formats() -> list[str]:
    """Return Pillow's names of the kinds that are read, except TIFF; TGA last, whose files have no signature."""
    Image.init()
    known = {Image.registered_extensions().get(suffix) for suffix in PICTURES} & {*Image.OPEN} - {"TIFF"}
    return sorted(filter(None, known), key=lambda name: name == "TGA")


def _read_exr_size(head: bytes) -> tuple[int, int]:
    """Return the largest (width, height) in an OpenEXR file's headers, read by hand, since the library may crash.

    A header is a magic number and a version, then attributes: name, type, length, value. Each part of a file has one,
    and the display window may be larger than the data window.
    """
    windows = [struct.unpack("<4i", found[1]) for found in _EXR_WINDOW.finditer(head)]
    sizes = [(right - left + 1, high - low + 1) for left, low, right, high in windows]
    if not sizes or min(min(size) for size in sizes) < 1:
        raise ValueError("no window")
    return max(sizes, key=lambda size: size[0] * size[1])
