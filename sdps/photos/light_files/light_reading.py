"""The kind of a light file, known by its content, and its rows."""

import zipfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from render.shared.decoding import decoding
from render.shared.errors import InputError
from render.shared.files import parse_json, read_bytes
from sdps.photos.light_files.light_arrays import read_mat, read_npy, read_npz, read_tuples
from sdps.photos.light_files.light_json import YAML, read_json_table
from sdps.photos.light_files.light_positions import take_header
from sdps.photos.light_files.light_table import Table, Want
from sdps.photos.light_files.light_text import read_text_table

_LARGEST = 2 << 20  # bytes of a text; 10,000 lights have half a MiB
_HDF = b"\x89HDF\r\n\x1a\n"
_SHEET = "is a spreadsheet; save the sheet as CSV"


def read_table(path: Path, files: Sequence[str], want: Want) -> tuple[Table, bool]:
    """Read the rows of a light file of any kind.

    Args:
        path: The file.
        files: Names of the pictures, (L,).
        want: Directions, or intensities alone.

    Returns:
        The rows as they are in the file; and whether it is a lights.json, which states our frame.

    Raises:
        InputError: missing, damaged, or of no kind that is read.
    """
    head = _head(path)
    count = len(files)
    if head.startswith(b"\x93NUMPY"):
        return read_npy(path, count, want), False
    if head.startswith(b"PK\x03\x04"):
        with decoding(path, "a NumPy archive"), zipfile.ZipFile(path) as archive:
            sheet = any(name.startswith(("xl/", "content.xml")) for name in archive.namelist())
        if sheet:
            raise InputError(f"{path}: {_SHEET}")
        return read_npz(path, count, want), False
    if head.startswith(b"\xd0\xcf\x11\xe0"):
        raise InputError(f"{path}: {_SHEET}")
    if head.startswith(_HDF) or head[512:].startswith(_HDF) or head.startswith(b"MATLAB 7.3"):
        raise InputError(
            f"{path}: is HDF5, which MATLAB writes as version 7.3 and which is not read; save it in MATLAB with "
            f"save('{path.stem}.mat', 'L', '-v7')"
        )
    if head.startswith(b"MATLAB 5.0") or path.suffix.lower() == ".mat":
        return read_mat(path, count, want), False
    text = _text(path)
    if path.suffix.lower() == ".tup":
        return read_tuples(path, text, want, _text), False
    if want.lights and (path.suffix.lower() in (".json", ".relight", ".dome", *YAML) or _is_json(text)):
        return read_json_table(path, text, files)
    text, near = take_header(path, text) if want.lights else (text, None)
    return replace(read_text_table(path, text, count, want), near=near), False


def _is_json(text: str) -> bool:
    """Tell JSON from text in brackets, such as a list of Python, by the content alone."""
    try:
        return text.lstrip().startswith("{") and isinstance(parse_json(text), dict)
    except ValueError:
        return False


def _head(path: Path) -> bytes:
    """Return the first kilobyte of a file."""
    try:
        with open(path, "rb") as handle:
            return handle.read(1024)
    except FileNotFoundError as error:
        raise InputError(f"{path}: no such file") from error
    except (OSError, ValueError) as error:  # a path may hold a zero
        raise InputError(f"{path}: cannot be read ({getattr(error, 'strerror', '') or error})") from error


def _text(path: Path) -> str:
    """Read a text as Windows, macOS and Linux write them: UTF-8 or UTF-16 with a mark, else Western European."""
    data = read_bytes(path)
    if len(data) > _LARGEST:
        raise InputError(f"{path}: has {len(data) / 2**20:.1f} MiB, too much for a file of lights; name another")
    try:
        wide = data.startswith((b"\xff\xfe", b"\xfe\xff"))
        text = data.decode("utf-16" if wide else "utf-8-sig")
    except UnicodeDecodeError:
        text = data.decode("cp1252", "replace")
    if "\0" in text:
        raise InputError(f"{path}: is not a text, .npy, .npz, .mat or JSON file of lights; name another")
    return text
