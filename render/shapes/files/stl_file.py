"""Binary STL files whose length does not match their header, which trimesh would take for text."""

import struct

from render.shared.errors import InputError

_HEADER, _TRIANGLE = 84, 50  # bytes


def check(data: bytes) -> bytes:
    """Return an STL file, a binary one without the bytes after its triangles.

    Raises:
        InputError: a binary file that ends before its last triangle.
    """
    if data.lstrip()[:5].lower() == b"solid" and b"facet" in data[:4096].lower():
        return data
    if len(data) < _HEADER:
        raise InputError("damaged or not a mesh: too short for an STL file; copy it again")
    (count,) = struct.unpack("<I", data[80:_HEADER])
    there = (len(data) - _HEADER) // _TRIANGLE
    if there < count:
        raise InputError(f"is cut short: {there:,} of {count:,} triangles are there; copy it again")
    return data[: _HEADER + count * _TRIANGLE]
