"""Reading PLY files with other faces than triangles: polygons, and strips as in the Stanford Scanning Repository's.

trimesh refuses binary files whose faces differ in the number of corners, fills concave ones beyond their outline, and
reads a file of strips as points alone.
"""

import struct
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
import trimesh

from render.shapes.files.corners import Corners, of_polygons
from render.shared.errors import InputError

_TYPES = {
    "char": "b", "uchar": "B", "short": "h", "ushort": "H", "int": "i", "uint": "I", "float": "f", "double": "d",
    "int8": "b", "uint8": "B", "int16": "h", "uint16": "H", "int32": "i", "uint32": "I", "float32": "f",
    "float64": "d", "int64": "q", "uint64": "Q",
}  # fmt: skip
_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">"}
_INDICES = ("vertex_indices", "vertex_index")
_UV = (("s", "t"), ("u", "v"), ("texture_u", "texture_v"), ("texcoord_u", "texcoord_v"))
_SEPARATOR = -1  # between the strips of a list


class _Column(NamedTuple):
    """A column of an element: the type of its values, and of the length in front of a list; None for single values."""

    name: str
    kind: np.dtype
    length: np.dtype | None


class _Element(NamedTuple):
    """A table of the file."""

    name: str
    length: int
    columns: list[_Column]


_Table = dict[str, Any]  # arrays (length,), and of lists the values of all rows with the lengths (length,)


def read(data: bytes) -> Corners | None:
    """Read a PLY file with faces of four or more corners, or with strips; None for any other, which trimesh reads.

    Raises:
        InputError: the file is shorter than its header announces, or an index is out of range.
    """
    found = _header(data)
    if found is None:
        return None
    order, elements, start = found
    columns = {element.name: element.columns for element in elements if element.length}
    polygons = any(column.name in _INDICES and column.length for column in columns.get("face", ()))
    strips = "face" not in columns and any(column.length for column in columns.get("tristrips", ())[:1])
    if "vertex" not in columns or not (polygons or strips):
        return None
    try:
        if not order:
            data, start = np.fromstring(data[start:].decode("latin-1"), sep=" ").tobytes(), 0
        tables = _tables(data, start, elements)
    except (IndexError, ValueError, OverflowError, struct.error) as error:
        raise InputError("is cut short: holds less than its header announces; copy it again") from error
    vertices = _stack(tables["vertex"], "xyz")
    if strips:
        triangles = _cut_strips(*tables["tristrips"][columns["tristrips"][0].name])
        return of_polygons(vertices, triangles.ravel(), np.full(len(triangles), 3))
    index, counts = next(tables["face"][name] for name in _INDICES if name in tables["face"])
    if (counts == 3).all():
        return None
    corners = np.asarray(index, np.int64)
    inside = corners.clip(0, max(len(vertices) - 1, 0))  # what lies outside is refused below
    names = ("nx", "ny", "nz")
    normals = _stack(tables["vertex"], names)[inside] if tables["vertex"].keys() >= {*names} else None
    return of_polygons(vertices, corners, counts, _uv(tables, inside, counts), normals)


def _stack(table: _Table, names: str | tuple[str, ...]) -> np.ndarray:
    return np.stack([np.asarray(table[name], np.float64) for name in names], axis=1)


def _uv(tables: dict[str, _Table], corners: np.ndarray, counts: np.ndarray) -> np.ndarray | None:
    """Return the texture coordinates of corners (N, 2), of the faces or else of the vertices."""
    values, lengths = tables["face"].get("texcoord", (np.empty(0), np.empty(0)))
    if len(lengths) == len(counts) and (lengths == 2 * counts).all():
        return np.asarray(values, np.float64).reshape(-1, 2)
    return next((_stack(tables["vertex"], pair)[corners] for pair in _UV if tables["vertex"].keys() >= {*pair}), None)


def _cut_strips(values: np.ndarray, lengths: np.ndarray) -> np.ndarray:  # (F, 3)
    """Return the triangles (v0, v1, v2), (v2, v1, v3), ... of strips v0 v1 v2 v3 ..."""
    index = np.insert(np.asarray(values, np.int64), np.cumsum(lengths), _SEPARATOR)
    ends = [-1, *np.flatnonzero(index == _SEPARATOR)]
    strips = [index[start + 1 : end] for start, end in pairwise(ends) if end - start > 3]  # a triangle at least
    return trimesh.util.triangle_strips_to_faces(strips) if strips else np.empty((0, 3), np.int64)


def _header(data: bytes) -> tuple[str, list[_Element], int] | None:
    """Return the order of bytes, empty for text, the elements and where they begin; None for an unreadable header."""
    end = data.find(b"end_header")
    start = data.find(b"\n", end) + 1 or data.find(b"\r", end) + 1
    if not data.startswith(b"ply") or end < 0 or start == 0:
        return None
    order, elements = "", list[_Element]()
    try:
        for line in data[:end].decode("latin-1").splitlines():
            words = line.split()
            if words[:1] == ["format"]:
                order = "" if words[1] == "ascii" else _ORDERS[words[1]]
            elif words[:1] == ["element"]:
                elements.append(_Element(words[1], int(words[2]), []))
            elif words[:1] == ["property"]:
                kinds = [np.dtype(order + _TYPES[word]) for word in words[1:-1] if word != "list"]
                kinds = kinds if order else [np.dtype("d")] * len(kinds)  # a text becomes an array of doubles
                count = kinds[0] if words[1] == "list" else None
                elements[-1].columns.append(_Column(words[-1], kinds[-1], count))
    except (KeyError, IndexError, ValueError):
        return None
    return order, elements, start


def _tables(data: bytes, start: int, elements: list[_Element]) -> dict[str, _Table]:
    tables = {}
    for element in elements:
        tables[element.name], start = _regular(data, start, element) or _irregular(data, start, element)
    return tables


def _regular(data: bytes, start: int, element: _Element) -> tuple[_Table, int] | None:
    """Read a table whose lists are all as long as those of its first row, None for another."""
    if not element.length or not element.columns:
        return {}, start
    fields, place, sizes = list[tuple[Any, ...]](), start, {}
    for name, kind, count in element.columns:
        if count:
            sizes[name] = int(np.frombuffer(data, count, 1, place)[0])
            fields.append((f"count of {name}", count))
            place += count.itemsize
        fields.append((name, kind, (sizes[name],)) if count else (name, kind))
        place += kind.itemsize * sizes.get(name, 1)
    row = np.dtype(fields)
    end = start + row.itemsize * element.length
    if end > len(data):
        return None
    rows = np.frombuffer(data, row, element.length, start)
    if any((rows[f"count of {name}"] != size).any() for name, size in sizes.items()):
        return None
    table: _Table = {name: rows[name] for name, _, _ in element.columns}
    return table | {name: (rows[name].ravel(), np.full(len(rows), size)) for name, size in sizes.items()}, end


def _irregular(data: bytes, start: int, element: _Element) -> tuple[_Table, int]:
    """Read a table with lists of different lengths."""
    if element.length > len(data):  # a row has a byte at least
        raise IndexError
    starts = np.empty((element.length, len(element.columns)), np.int64)
    lengths = np.ones(starts.shape, np.int64)
    forms = [
        (kind.itemsize, struct.Struct(count.str[0].replace("|", "<") + count.char) if count else None)
        for _, kind, count in element.columns
    ]
    place = start
    for row in range(element.length):
        for k, (width, count) in enumerate(forms):
            if count is not None:
                lengths[row, k] = size = int(count.unpack_from(data, place)[0])
                place += count.size
            else:
                size = 1
            starts[row, k] = place
            place += size * width
            if not start <= place <= len(data):
                raise IndexError
    content = np.frombuffer(data, np.uint8)
    table: _Table = {}
    for k, (name, kind, listed) in enumerate(element.columns):
        sizes = lengths[:, k] * kind.itemsize
        first = np.repeat(starts[:, k] - (np.cumsum(sizes) - sizes), sizes)
        values = content[first + np.arange(len(first))].view(kind)
        table[name] = (values, lengths[:, k]) if listed else values
    return table, place
