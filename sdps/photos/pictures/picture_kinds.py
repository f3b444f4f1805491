"""Kinds of picture files, known by their first bytes; a file's name may say anything."""

from dataclasses import dataclass
from pathlib import Path

SUFFIXES = {
    ".png": "PNG",
    ".tif": "TIFF", ".tiff": "TIFF",
    ".jpg": "JPEG", ".jpeg": "JPEG", ".jpe": "JPEG", ".jfif": "JPEG", ".mpo": "JPEG",
    ".exr": "EXR",
    ".bmp": "BMP", ".dib": "BMP",
    ".pgm": "PNM", ".ppm": "PNM", ".pnm": "PNM", ".pbm": "PNM",
    ".tga": "TGA",
    ".webp": "WebP",
}  # fmt: skip
"""Suffixes that are read, in lower case, and the kinds they stand for."""

NAMED = "PNG, TIFF, JPEG, EXR, BMP, PGM, PPM, TGA or WebP"
"""The kinds that are read, for messages."""

LOSSY = ("JPEG", "WebP")
"""Kinds whose files as a rule hold approximate values, coded for a display."""

UNREAD = {
    *(".cr2", ".cr3", ".crw", ".nef", ".nrw", ".arw", ".srf", ".sr2", ".dng", ".orf", ".raf", ".rw2", ".pef", ".srw"),
    *(".raw", ".3fr", ".iiq", ".x3f", ".heic", ".heif", ".avif", ".jp2", ".j2k", ".jxl", ".gif", ".psd", ".xcf"),
    *(".hdr", ".pfm", ".svg", ".mp4", ".mov", ".avi"),
}
"""Suffixes of pictures and films that are not read, in lower case."""

FILMS = (".mp4", ".mov", ".m4v", ".avi", ".mkv", ".webm", ".mpg", ".mpeg", ".mts", ".m2ts", ".3gp", ".wmv")
"""Suffixes of films, whose frames are read where nothing but a film is given, in lower case."""

_STARTS = (
    (b"\x89PNG\r\n\x1a\n", "PNG"), (b"\xff\xd8\xff", "JPEG"), (b"\x76\x2f\x31\x01", "EXR"), (b"BM", "BMP"),
    (b"II*\0", "TIFF"), (b"MM\0*", "TIFF"), (b"II+\0", "TIFF"), (b"MM\0+", "TIFF"),
)  # fmt: skip
_FOREIGN = (
    (b"GIF8", "a GIF"), (b"8BPS", "a Photoshop file"), (b"\0\0\0\x0cjP  ", "a JPEG 2000 file"), (b"%PDF", "a PDF"),
    (b"\xff\x0a", "a JPEG XL file"), (b"\0\0\0\x0cJXL ", "a JPEG XL file"), (b"#?RADIANCE", "a Radiance file"),
    (b"PK\x03\x04", "a ZIP archive"), (b"FUJIFILMCCD-RAW", "camera RAW"), (b"IIU\0", "camera RAW"),
    (b"IIRO", "camera RAW"), (b"version https://git-lfs", "a placeholder of Git LFS, not the picture"),
    (b"<!DOCTYPE", "a web page"), (b"<html", "a web page"), (b"<svg", "an SVG drawing"),
)  # fmt: skip
_BRANDS = {b"heic", b"heix", b"heim", b"hevc", b"mif1", b"msf1"}
_LONGEST_START = 64


@dataclass(frozen=True)
class Coding:
    """What must be the same in all pictures of a folder.

    Attributes:
        kind: PNG, TIFF, JPEG, EXR, BMP, PNM (PBM, PGM, PPM), TGA or WebP.
        bits: Per channel.
        floating: Whether values are floating-point numbers.
        curve: Exponent of the embedded colour profile's curve, 1 for linear; None without profile.
    """

    kind: str
    bits: int
    floating: bool
    curve: float | None = None

    def __str__(self) -> str:
        profile = "" if self.curve is None else f" with a profile of exponent {self.curve:.2f}"
        return f"{self.bits}-bit {'float ' if self.floating else ''}{self.kind}{profile}"


def picture_kind(data: bytes, name: str) -> str | None:
    """Return a file's kind by its bytes, None where they are those of no kind that is read.

    TGA files begin with nothing of their own; they are known by their last bytes, or by their name where no other kind
    begins like that.

    Args:
        data: The whole file.
        name: Its name.
    """
    if (data[8:10] == b"CR" and data[:4] == b"II*\0") or foreign_kind(data):
        return None
    found = next((kind for start, kind in _STARTS if data.startswith(start)), None)
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
    if data[:4] == b"II*\0" and data[8:10] == b"CR":
        return "camera RAW"
    if start[4:8] == b"ftyp":
        brand = start[8:12]
        named = "a HEIC picture" if brand in _BRANDS else "an AVIF picture" if brand == b"avif" else "a film"
        return "camera RAW" if brand == b"crx " else named
    return next((kind for known, kind in _FOREIGN if start.startswith(known)), None)


def name_kind(kind: str) -> str:
    """Return a kind with its article."""
    return f"{'an' if kind == 'EXR' else 'a'} {kind}"
