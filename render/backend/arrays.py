"""Dr.Jit arrays that kernels see as data, so that other values, and other memory, compile no other kernel."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from render.backend.jit import dr, mi


def opaque(value: Any) -> Any:
    """Hide a value from the kernel's code, so that another value does not compile another kernel."""
    dr.make_opaque(value)
    return value


def upload(kind: type, values: np.ndarray) -> Any:
    """Copy a NumPy array into memory of Dr.Jit's own.

    On the CPU Dr.Jit uses NumPy's memory as it is, and compiles loads by its alignment, which is a matter of luck. The
    copy is gathered by an index the kernel cannot see through, for which alignment does not matter.
    """
    source = _data(kind, values)
    copy = dr.gather(kind, source, dr.arange(mi.UInt32, dr.width(source)) + opaque(mi.UInt32(0)))
    dr.eval(copy)
    return copy


def _data(kind: type, values: np.ndarray) -> Any:
    """Return values, flat, as data. A single one goes into Dr.Jit's own memory: to gather it is a plain load."""
    return opaque(kind(values.item()) if values.size == 1 else kind(np.ascontiguousarray(values).ravel()))


def table(values: Any) -> "mi.Float":
    """Return a flat opaque float32 array of `values`, for kernels that gather from it."""
    return _data(mi.Float, np.asarray(values, np.float32))


def integers(values: Any) -> "mi.UInt32":
    """Return a flat opaque UInt32 array of `values`, for kernels that gather from it."""
    return _data(mi.UInt32, np.asarray(values, np.uint32))


def packets(values: Any) -> "mi.Float":
    """Return a flat float32 array of `values` for `packet`."""
    return upload(mi.Float, np.asarray(values, np.float32))


def packet(source: "mi.Float", entry: "mi.UInt32", width: int, active: "mi.Bool | bool" = True) -> Any:
    """Read `width` floats, a power of two, from place `width` * `entry` on; ArrayXf (width, N).

    Several floats side by side cost about what one does. The array must lie in Dr.Jit's own memory, whose alignment is
    always the same, or other arrays would compile other kernels.
    """
    return dr.gather(mi.ArrayXf, source, entry, active, shape=(width, dr.width(entry)))


def interleave(values: Sequence, width: int) -> "mi.Float":
    """Return Float arrays (N) as one flat array (N * width) for `packet`, padded with zeros."""
    count = max(dr.width(value) for value in values)
    flat = dr.zeros(mi.Float, count * width)
    for place, value in enumerate(values):
        dr.scatter(flat, value, dr.arange(mi.UInt32, count) * width + place)
    dr.eval(flat)
    return flat


class Columns:
    """Float arrays (N), or of one value for all, and vectors and colours of them, that are read together."""

    def __init__(self, *values: Any) -> None:
        self._lengths = [len(value) if dr.depth_v(value) > 1 else 0 for value in values]
        flat = [part for value in values for part in (value if dr.depth_v(value) > 1 else (value,))]
        self._alike = {place: value for place, value in enumerate(flat) if dr.width(value) == 1}
        self._wide = [place for place in range(len(flat)) if place not in self._alike]
        self._packets = []
        left = [flat[place] for place in self._wide]
        while left:
            width = min(16, 1 << (len(left) - 1).bit_length())
            width = width // 2 if 4 * len(left) < 3 * width else width  # no more than a quarter is padding
            some, left = left[:width], left[width:]
            self._packets.append((interleave(some, width), width, len(some)))

    def at(self, entry: "mi.UInt32") -> list:
        """Return the values at entries, Floats and tuples of Floats."""
        read = [value for flat, width, count in self._packets for value in list(packet(flat, entry, width))[:count]]
        found = self._alike | dict(zip(self._wide, read, strict=True))
        parts = iter([found[place] for place in range(len(found))])
        return [tuple(next(parts) for _ in range(length)) if length else next(parts) for length in self._lengths]
