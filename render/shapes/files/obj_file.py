"""Reading Wavefront OBJ: positions, polygons, texture coordinates and normals.

trimesh counts relative indices from the end of the file, mistakes faces of different forms for one another, and fills
concave polygons beyond their outline. What concerns the surface is read here; materials, lines and curves are not.
"""

import re
from dataclasses import dataclass, field

import numpy as np

from render.shapes.files.corners import Corners, of_polygons
from render.shared.errors import InputError

_CONTINUED = re.compile(r"^([ \t]*(?:v|vn|vt|f|fo)[ \t][^\n]*?)\\[ \t]*\n", re.M)


@dataclass
class _Statements:
    """The statements of a file by keyword, without it; faces with absolute indices."""

    v: list[str] = field(default_factory=list)
    vt: list[str] = field(default_factory=list)
    vn: list[str] = field(default_factory=list)
    f: list[str] = field(default_factory=list)


def read(data: bytes) -> Corners:
    """Read an OBJ file; objects, groups and materials are joined.

    Raises:
        InputError: a statement without numbers where they belong, or an index out of range.
    """
    found = _statements(data)
    vertices = _numbers("v", found.v, 3)
    if not found.f:
        return Corners(vertices, np.empty((0, 3), np.int64))
    table, counts = _corners(found.f)
    bad = (table[:, 0] < 1) | (table[:, 0] > len(vertices))
    if bad.any():
        raise InputError(
            f"a face names vertex {table[bad, 0][0]}, but the file holds 1 to {len(vertices)}; repair the file"
        )
    uv = _look_up(_numbers("vt", found.vt, 1), table[:, 1])
    normals = _look_up(_numbers("vn", found.vn, 3), table[:, 2])
    return of_polygons(vertices, table[:, 0] - 1, counts, None if uv is None or np.isnan(uv).any() else uv, normals)


def _statements(data: bytes) -> _Statements:
    """Sort the lines of a file by their keyword."""
    text = data.decode("utf-8-sig", errors="replace").replace("\r\n", "\n").replace("\r", "\n")
    while "\\" in text:
        text, replaced = _CONTINUED.subn(r"\1 ", text)
        if not replaced:
            break
    found = _Statements()
    rows = {"v": found.v, "vt": found.vt, "vn": found.vn}
    for line in text.split("\n"):
        keyword, _, rest = line.strip().replace("\t", " ").partition(" ")
        if keyword in rows:
            rows[keyword].append(rest)
        elif keyword in ("f", "fo"):
            rest = rest.partition("#")[0]
            found.f.append(_absolute(rest, found) if "-" in rest else rest)
    return found


def _absolute(face: str, found: _Statements) -> str:
    """Replace relative indices, -1 for the last one before the face, by absolute ones."""
    counts = (len(found.v), len(found.vt), len(found.vn))
    corners = []
    for corner in face.split():
        parts = corner.split("/")
        for place, part in enumerate(parts[:3]):
            if part.startswith("-") and part[1:].isdecimal():
                absolute = counts[place] + 1 - int(part[1:])
                if absolute < 1:
                    raise InputError(f"face 'f {face.strip()}' counts back beyond the first vertex; repair the file")
                parts[place] = str(absolute)
        corners.append("/".join(parts))
    return " ".join(corners)


def _numbers(keyword: str, rows: list[str], least: int) -> np.ndarray:
    """Return the first three numbers of each row (N, 3), of `vt` two (N, 2); what a row lacks is 0."""
    columns = 2 if keyword == "vt" else 3
    table = []
    for row in rows:
        try:
            numbers = [float(word) for word in row.partition("#")[0].split()[:columns]]
        except ValueError:
            numbers = []
        if len(numbers) < least:
            raise InputError(f"'{keyword} {row[:60]}': expected {columns} numbers; export it again")
        table.append(numbers + [0.0] * (columns - len(numbers)))
    return np.array(table, np.float64).reshape(-1, columns)


def _corners(rows: list[str]) -> tuple[np.ndarray, np.ndarray]:
    """Return the indices of all corners (N, 3): vertex, texture coordinate, normal, 0 for none; and (P,) corners."""
    text = " ".join(word for row in rows for word in row.split())
    text = re.sub(r"/(?=[/ ]|$)", "/0", text)  # every corner becomes v/vt/vn
    text = re.sub(r"(?<!\S)([0-9]+)(?!\S)", r"\1/0", text)
    text = re.sub(r"(?<!\S)([0-9]+/[0-9]+)(?!\S)", r"\1/0", text)
    if re.search(r"(?<!\S)(?![0-9]+/[0-9]+/[0-9]+(?!\S))\S", text):
        form = re.compile(r"[0-9]+(/[0-9]*(/[0-9]*)?)?")
        bad = next(row for row in rows if not all(form.fullmatch(corner) for corner in row.split()))
        raise InputError(
            f"'f {bad.strip()[:60]}': expected whole numbers, as in f 1 2 3 or f 1/1/1 2/2/1 3/3/1; export it again"
        )
    table = np.fromstring(text.replace("/", " "), np.int64, sep=" ").reshape(-1, 3)
    return table, np.array([len(row.split()) for row in rows])


def _look_up(values: np.ndarray, index: np.ndarray) -> np.ndarray | None:
    """Return values by their number (N,), NaN where it is 0 or out of range; None where all are."""
    there = (index >= 1) & (index <= len(values))
    return np.where(there[:, None], values[np.where(there, index - 1, 0)], np.nan) if there.any() else None
