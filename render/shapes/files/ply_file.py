"""Reading PLY files with other faces than triangles.

trimesh refuses binary files whose faces differ in the number of corners, and fills concave ones beyond their outline.
"""

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from render.shapes.files.corners import Corners, of_polygons
from render.shared.errors import InputError

_TYPES = {
    "char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4", "float": "f4",
    "double": "f8", "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4",
    "float32": "f4", "float64": "f8", "int64": "i8", "uint64": "u8",
}  # fmt: skip
_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">"}
_INDICES = ("vertex_indices", "vertex_index")
_UV = (("s", "t"), ("u", "v"), ("texture_u", "texture_v"), ("texcoord_u", "texcoord_v"))


@dataclass(frozen=True)
class _Property:
    """A column of an element; `count` is the type of the length of a list, None of a single value."""

    name: str
    kind: str
    count: str | None = None


@dataclass(frozen=True)
class _Element:
    """A table of the file."""

    name: str
    length: int
    columns: tuple[_Property, ...]


_Table = dict[str, Any]  # arrays (length,), and of lists the values of all rows with the lengths (length,)


def read(data: bytes) -> Corners | None:
    """Read a PLY file with faces of four or more corners; None for any other, which trimesh reads.

    Raises:
        InputError: the file is shorter than its header announces, or an index is out of range.
    """
    found = _header(data)
    if found is None:
        return None
    form, elements, start = found
    faces = next((element for element in elements if element.name == "face"), None)
    if faces is None or not faces.length or not any(element.name == "vertex" for element in elements):
        return None
    if not any(column.name in _INDICES and column.count for column in faces.columns):
        return None
    try:
        tables = _binary(data, start, elements, _ORDERS[form]) if form in _ORDERS else _ascii(data[start:], elements)
    except (IndexError, ValueError) as error:
        raise InputError("is cut short: holds less than its header announces; copy it again") from error
    index, counts = next(tables["face"][name] for name in _INDICES if name in tables["face"])
    if (counts == 3).all():
        return None
    vertex = tables["vertex"]
    vertices = np.stack([np.asarray(vertex[axis], np.float64) for axis in "xyz"], axis=1)
    corners = np.asarray(index, np.int64)
    inside = corners.clip(0, max(len(vertices) - 1, 0))  # what lies outside is refused below
    normals = None
    if all(axis in vertex for axis in ("nx", "ny", "nz")):
        normals = np.stack([np.asarray(vertex[axis], np.float64) for axis in ("nx", "ny", "nz")], axis=1)[inside]
    return of_polygons(vertices, corners, counts, _uv(tables, inside, counts), normals)


def _uv(tables: dict[str, _Table], corners: np.ndarray, counts: np.ndarray) -> np.ndarray | None:
    """Return the texture coordinates of corners (N, 2), of the faces or else of the vertices."""
    values, lengths = tables["face"].get("texcoord", (np.empty(0), np.empty(0)))
    if len(lengths) == len(counts) and (lengths == 2 * counts).all():
        return np.asarray(values, np.float64).reshape(-1, 2)
    for u, v in _UV:
        if u in tables["vertex"] and v in tables["vertex"]:
            return np.stack([np.asarray(tables["vertex"][each], np.float64) for each in (u, v)], axis=1)[corners]
    return None


def _header(data: bytes) -> tuple[str, list[_Element], int] | None:
    """Return the format, the elements and where they begin; None for a header that is none."""
    end = data.find(b"end_header")
    if not data.startswith(b"ply") or end < 0:
        return None
    start = data.find(b"\n", end) + 1 or data.find(b"\r", end) + 1
    form, elements = "", list[_Element]()
    try:
        for line in data[:end].decode("latin-1").splitlines():
            words = line.split()
            if words[:1] == ["format"]:
                form = words[1]
            elif words[:1] == ["element"]:
                elements.append(_Element(words[1], int(words[2]), ()))
            elif words[:1] == ["property"]:
                kinds = [_TYPES[word] for word in words[1:-1] if word != "list"]
                column = _Property(words[-1], kinds[-1], kinds[0] if words[1] == "list" else None)
                last = elements[-1]
                elements[-1] = _Element(last.name, last.length, (*last.columns, column))
    except (KeyError, IndexError, ValueError):
        return None
    return (form, elements, start) if start > 0 and form in (*_ORDERS, "ascii") else None


def _ascii(data: bytes, elements: list[_Element]) -> dict[str, _Table]:
    rows = [row.split() for row in data.split(b"\n") if row.strip()]
    tables, start = {}, 0
    for element in elements:
        chosen = rows[start : start + element.length]
        if len(chosen) < element.length:
            raise IndexError
        start += element.length
        tables[element.name] = _ascii_table(chosen, element)
    return tables


def _ascii_table(rows: list[list[bytes]], element: _Element) -> _Table:
    if not any(column.count for column in element.columns):
        values = np.array([row[: len(element.columns)] for row in rows]).astype(np.float64)
        return {column.name: values[:, k] for k, column in enumerate(element.columns)}
    found: dict[str, list[float]] = {column.name: [] for column in element.columns}
    lengths: dict[str, list[int]] = {column.name: [] for column in element.columns}
    for row in rows:
        place = 0
        for column in element.columns:
            size = 1
            if column.count:
                size = max(int(row[place]), 0)
                place += 1
            numbers = [float(value) for value in row[place : place + size]]
            if len(numbers) < size:
                raise IndexError
            found[column.name] += numbers
            lengths[column.name].append(size)
            place += size
    return {
        column.name: (np.array(found[column.name]), np.array(lengths[column.name]))
        if column.count
        else np.array(found[column.name])
        for column in element.columns
    }


def _binary(data: bytes, start: int, elements: list[_Element], order: str) -> dict[str, _Table]:
    tables = {}
    for element in elements:
        tables[element.name], start = _regular(data, start, element, order) or _irregular(data, start, element, order)
    return tables


def _regular(data: bytes, start: int, element: _Element, order: str) -> tuple[_Table, int] | None:
    """Read a table whose lists are all as long as those of its first row, None for another."""
    if not element.length or not element.columns:
        return {}, start
    fields, place, sizes = list[tuple[Any, ...]](), start, {}
    for number, column in enumerate(element.columns):
        if column.count:
            kind = np.dtype(order + column.count)
            sizes[column.name] = int(np.frombuffer(data, kind, 1, place)[0])
            fields.append((f"count{number}", kind))
            place += kind.itemsize
        kind = np.dtype(order + column.kind)
        size = sizes.get(column.name, 1)
        fields.append((column.name, kind, (size,)) if column.count else (column.name, kind))
        place += kind.itemsize * size
    row = np.dtype(fields)
    if start + row.itemsize * element.length > len(data):
        return None
    rows = np.frombuffer(data, row, element.length, start)
    table: _Table = {}
    for number, column in enumerate(element.columns):
        if column.count:
            lengths = rows[f"count{number}"]
            if (lengths != sizes[column.name]).any():
                return None
            table[column.name] = (rows[column.name].ravel(), lengths.astype(np.int64))
        else:
            table[column.name] = rows[column.name]
    return table, start + row.itemsize * element.length


def _irregular(data: bytes, start: int, element: _Element, order: str) -> tuple[_Table, int]:
    """Read a table with lists of different lengths."""
    if element.length > len(data):  # a row has a byte at least
        raise IndexError
    columns = [
        (None if c.count is None else np.dtype(order + c.count), np.dtype(order + c.kind)) for c in element.columns
    ]
    endian: Literal["little", "big"] = "little" if order == "<" else "big"
    starts = np.empty((element.length, len(columns)), np.int64)
    lengths = np.ones((element.length, len(columns)), np.int64)
    place = start
    for row in range(element.length):
        for k, (count, kind) in enumerate(columns):
            size = 1
            if count is not None:
                size = int.from_bytes(data[place : place + count.itemsize], endian)
                place += count.itemsize
            starts[row, k], lengths[row, k] = place, size
            place += size * kind.itemsize
            if place > len(data):
                raise IndexError
    content = np.frombuffer(data, np.uint8)
    table: _Table = {}
    for k, (column, (count, kind)) in enumerate(zip(element.columns, columns, strict=True)):
        sizes = lengths[:, k] * kind.itemsize
        first = np.repeat(starts[:, k] - (np.cumsum(sizes) - sizes), sizes)
        values = content[first + np.arange(len(first))].view(kind)
        table[column.name] = values if count is None else (values, lengths[:, k])
    return table, place
