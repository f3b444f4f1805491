"""The door through which files from outside are decoded.

Any error that a library raises on damaged bytes becomes one line, and a file whose header announces more than such a
file can sensibly hold is refused before anything is unpacked: a picture of 1 KB may claim 100,000 x 100,000 pixels.
"""

import os
import sys
import threading
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import OpenEXR
from PIL import Image

from render.shared.errors import InputError

ALWAYS = 128 << 20
"""Bytes that any file may unpack to."""

TIMES = 128
"""How many times its own size a larger file may unpack to; photographs and meshes stay below 30."""


@contextmanager
def decoding(path: str | Path, what: str, remedy: str = "copy it again") -> Iterator[None]:
    """Turn any error while a library decodes a file into one line.

    Every library fails in its own ways on damaged bytes, and hands on damaged arrays that fail later; so this catches
    every exception. Only decoding belongs inside.

    Args:
        path: The file.
        what: What it should be, with its article: `a picture`.
        remedy: What to do about it.

    Raises:
        InputError: in place of any other exception; one that is raised inside passes.
    """
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # libraries' remarks on odd tags and sizes
            yield
    except InputError:
        raise
    except Exception as error:
        reason = (str(error).strip().splitlines() or [type(error).__name__])[0].partition(" <_io.")[
            0
        ]  # and its address
        raise InputError(f"{path}: damaged or not {what} ({reason[:200]}); {remedy}") from error


def largest_unpacked(path: str | Path) -> int:
    """Return how many bytes a file may unpack to: 128 MiB, or 128 times its size if that is more."""
    return max(ALWAYS, TIMES * os.path.getsize(path))


def check_unpacked(path: str | Path, size: int, what: str = "what it holds") -> None:
    """Refuse a file that unpacks to much more than its own size.

    Args:
        path: The file.
        size: Bytes that its header says it unpacks to.
        what: What these are, for the message.

    Raises:
        InputError: more than `largest_unpacked`.
    """
    if size > largest_unpacked(path):
        raise InputError(
            f"{path}: its header announces {size >> 20:,} MiB for {what}, more than a file of this size can hold; "
            "copy it again"
        )


def check_picture(path: str | Path, picture: Image.Image, data: bytes) -> None:
    """Refuse a picture whose header announces more pixels than its file can hold; none of them is decoded.

    Args:
        path: The file.
        picture: What Pillow opened.
        data: The whole file; a PNG states its bits per channel at byte 24, which Pillow keeps to itself.
    """
    wide = picture.format == "PNG" and data[24:25] == b"\x10"
    bands = 3 if picture.mode == "P" else len(picture.getbands())
    check_unpacked(path, picture.width * picture.height * bands * (2 if wide else 1), "its pixels")


def exr_parts(path: str | Path, remedy: str = "copy it again", *, grouped: bool = True) -> list[OpenEXR.Part]:
    """Decode all parts of an OpenEXR file, after a look at their headers.

    Args:
        path: The file.
        remedy: What to do about a damaged one.
        grouped: Join R, G and B of a layer `image` to one array (H, W, 3) `image`, those without a layer to `RGB`;
            a layer of mixed types is then refused. Otherwise channels keep their names, as `image.R`.

    Raises:
        InputError: missing, damaged, without a part, or of a size that such a file cannot hold.
    """
    with decoding(path, "an EXR picture", remedy):
        count = check_exr(path)
        parts = OpenEXR.File(os.fspath(path), separate_channels=not grouped).parts
        if len(parts) < max(count, 1):  # it leaves out those it cannot decode
            which = "no part of it" if not parts else f"only {len(parts)} of its {count} parts"
            raise InputError(f"{path}: damaged or not an EXR picture ({which} can be read); {remedy}")
        return parts


def check_exr(path: str | Path) -> int:
    """Refuse an OpenEXR file whose headers announce more pixels than it can hold; none of them is decoded.

    Returns:
        The number of its parts.

    Raises:
        InputError: too large a data or display window; OpenEXR's own errors pass.
    """
    stored = shown = 0
    with OpenEXR.File(os.fspath(path), header_only=True) as file:
        for part in file.parts:
            stored += _area(part.header["dataWindow"]) * 4 * len(part.header["channels"])
            shown = max(shown, _area(part.header["displayWindow"]))
        count = len(file.parts)
    check_unpacked(path, stored, "its pixels")
    check_unpacked(path, 4 * shown, "one channel of its display window")  # rightly large and nearly empty
    return count


def _area(window: tuple[np.ndarray, np.ndarray]) -> int:
    low, high = (corner.astype(int) for corner in window)
    width, height = (max(int(side), 0) for side in high - low + 1)
    return width * height


_SILENT = threading.Lock()
_silencers = 0
_kept = -1


@contextmanager
def silence() -> Iterator[None]:
    """Keep what C libraries print about damaged files off standard error, in all threads of the process.

    Python's own stream writes there as well, so nothing but decoding belongs inside.
    """
    global _silencers
    with _SILENT:
        if not _silencers:
            _mute()
        _silencers += 1
    try:
        yield
    finally:
        with _SILENT:
            _silencers -= 1
            if not _silencers:
                _unmute()


def _mute() -> None:
    global _kept
    if sys.stderr is not None:
        sys.stderr.flush()
    try:
        _kept = os.dup(2)
    except OSError:  # closed, as of a program without a console
        return
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 2)
    os.close(nowhere)


def _unmute() -> None:
    global _kept
    if _kept >= 0:
        os.dup2(_kept, 2)
        os.close(_kept)
        _kept = -1
