"""Kinds of picture files, known by their first bytes; a file's name may say anything."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

SUFFIXES = {
    ".png": "PNG",
    ".tif": "TIFF", ".tiff": "TIFF",
    ".jpg": "JPEG", ".jpeg": "JPEG", ".jpe": "JPEG", ".jfif": "JPEG", ".mpo": "JPEG",
    ".exr": "EXR",
    ".bmp": "BMP", ".dib": "BMP",
    ".pgm": "PNM", ".ppm": "PNM", ".pnm": "PNM", ".pbm": "PNM",
    ".tga": "TGA",
    ".webp": "WebP",
    ".dng": "RAW", ".nef": "RAW", ".nrw": "RAW", ".cr2": "RAW", ".cr3": "RAW", ".arw": "RAW", ".sr2": "RAW",
    ".raf": "RAW", ".orf": "RAW", ".rw2": "RAW", ".pef": "RAW", ".srw": "RAW", ".3fr": "RAW",
    ".heic": "HEIC", ".heif": "HEIC", ".hif": "HEIC",
    ".avif": "AVIF",
}  # fmt: skip
"""Suffixes that are read, in lower case, and the kinds they stand for."""

NAMED = "PNG, TIFF, JPEG, EXR, BMP, PGM, PPM, TGA, WebP, camera RAW, HEIC or AVIF"
"""The kinds that are read, for messages."""

ORIGINALS = ("RAW", "HEIC", "AVIF")
"""Kinds that lie beside what was made from them, and are read where that is missing."""

LOSSY = ("JPEG", "WebP", "HEIC", "AVIF")
"""Kinds whose files as a rule hold approximate values, coded for a display."""

UNREAD = {
    *(".crw", ".srf", ".raw", ".iiq", ".x3f", ".jp2", ".j2k", ".jxl", ".gif", ".psd", ".xcf"),
    *(".hdr", ".pfm", ".svg", ".mp4", ".mov", ".avi"),
}
"""Suffixes of pictures and films that are not read, in lower case."""

FILMS = (".mp4", ".mov", ".m4v", ".avi", ".mkv", ".webm", ".mpg", ".mpeg", ".mts", ".m2ts", ".3gp", ".wmv")
"""Suffixes of films, whose frames are read where nothing but a film is given, in lower case."""

_STARTS = (
    (b"\x89PNG\r\n\x1a\n", "PNG"), (b"\xff\xd8\xff", "JPEG"), (b"\x76\x2f\x31\x01", "EXR"), (b"BM", "BMP"),
    (b"FUJIFILMCCD-RAW", "RAW"), (b"IIU\0", "RAW"), (b"IIRO", "RAW"), (b"IIRS", "RAW"), (b"MMOR", "RAW"),
    (b"II*\0", "TIFF"), (b"MM\0*", "TIFF"), (b"II+\0", "TIFF"), (b"MM\0+", "TIFF"),
)  # fmt: skip
_FOREIGN = (
    (b"GIF8", "a GIF"), (b"8BPS", "a Photoshop file"), (b"\0\0\0\x0cjP  ", "a JPEG 2000 file"), (b"%PDF", "a PDF"),
    (b"\xff\x0a", "a JPEG XL file"), (b"\0\0\0\x0cJXL ", "a JPEG XL file"), (b"#?RADIANCE", "a Radiance file"),
    (b"PK\x03\x04", "a ZIP archive"), (b"IIII", "camera RAW of a kind"),
    (b"FOVb", "camera RAW of a kind"), (b"version https://git-lfs", "a placeholder of Git LFS, not the picture"),
    (b"<!DOCTYPE", "a web page"), (b"<html", "a web page"), (b"<svg", "an SVG drawing"),
)  # fmt: skip
_BRANDS = {b"heic", b"heix", b"heim", b"hevc", b"mif1", b"msf1"}
_LONGEST_START = 64
_DNG_VERSION, _MAKE = 50706, 271


@dataclass(frozen=True)
class Coding:
    """What must be the same in all pictures of a folder.

    Attributes:
        kind: PNG, TIFF, JPEG, EXR, BMP, PNM (PBM, PGM, PPM), TGA, WebP, RAW, HEIC or AVIF.
        bits: Per channel.
        floating: Whether values are floating-point numbers.
        curve: Exponent of the embedded colour profile's curve, 1 for linear; None without profile.
        primaries: Name of the profile's colour space, empty for sRGB's.
        rough: The profile's curve is neither sRGB's nor a power.
    """

    kind: str
    bits: int
    floating: bool
    curve: float | None = None
    primaries: str = ""
    rough: bool = False

    def __str__(self) -> str:
        profile = "" if self.curve is None else f" with a profile of exponent {self.curve:.2f}"
        profile += f" ({self.primaries})" if self.primaries else ""
        return f"{self.bits}-bit {'float ' if self.floating else ''}{self.kind}{profile}"


def picture_kind(data: bytes, name: str) -> str | None:
    """Return a file's kind by its bytes, None where they are those of no kind that is read.

    TGA files begin with nothing of their own; they are known by their last bytes, or by their name where no other kind
    begins like that.

    Args:
        data: The whole file.
        name: Its name.
    """
    if foreign_kind(data):
        return None
    if data[4:8] == b"ftyp":
        return _container_kind(data)
    found = next((kind for start, kind in _STARTS if data.startswith(start)), None)
    if found == "TIFF" and _is_raw(data, name):
        return "RAW"
    if found is not None:
        return found
    if data[:1] == b"P" and data[1:2] in b"123456" and data[2:3].isspace():
        return "PNM"
    if data[:4] == b"RIFF" and data[8:12] == b"WEBP":
        return "WebP"
    targa = data.endswith(b"TRUEVISION-XFILE.\0") or Path(name).suffix.lower() == ".tga"
    return "TGA" if targa and len(data) > 18 and data[1] <= 1 and data[2] in (1, 2, 3, 9, 10, 11) else None


def foreign_kind(data: bytes) -> str | None:
    """Return what a file is, with its article, if it is of a known kind that is not read."""
    start = data[:_LONGEST_START]
    if start[4:8] == b"ftyp" and _container_kind(data) is None:
        return "a film"
    return next((kind for known, kind in _FOREIGN if start.startswith(known)), None)


def _container_kind(data: bytes) -> str | None:
    """Return the kind of an ISO base media file by its brands, None for films."""
    size = min(int.from_bytes(data[:4], "big"), 256)
    brand, others = data[8:12], {data[place : place + 4] for place in range(16, size - 3, 4)}
    if brand == b"crx ":
        return "RAW"
    if brand == b"avif" or (brand in _BRANDS and b"avif" in others and not others & {b"heic", b"heix"}):
        return "AVIF"
    return "HEIC" if brand in _BRANDS else None


def _is_raw(data: bytes, name: str) -> bool:
    """Tell whether a TIFF is a camera's RAW file: of Canon, DNG, or named so and with the camera's maker in it."""
    order: Literal["little", "big"] = "little" if data[:2] == b"II" else "big"
    start = int.from_bytes(data[4:8], order)
    end = min(start + 2 + 12 * int.from_bytes(data[start : start + 2], order), len(data))
    tags = {int.from_bytes(data[place : place + 2], order) for place in range(start + 2, end, 12)}
    named = SUFFIXES.get(Path(name).suffix.lower()) == "RAW"
    return data[8:10] == b"CR" or _DNG_VERSION in tags or (named and _MAKE in tags)


def name_kind(kind: str) -> str:
    """Return a kind with its article."""
    if kind == "RAW":
        return "camera RAW"
    return f"{'an' if kind in ('EXR', 'AVIF') else 'a'} {kind}"
