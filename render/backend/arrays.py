"""Dr.Jit arrays that kernels see as data, so that other values, and other memory, compile no other kernel."""

from typing import Any

import drjit as dr
import numpy as np

from render.backend import variant

mi = variant.load()


def opaque(value: Any) -> Any:
    """Hide a value from the kernel's code, so that another value does not compile another kernel."""
    dr.make_opaque(value)
    return value


def upload(kind: type, values: np.ndarray) -> Any:
    """Copy a NumPy array into memory of Dr.Jit's own.

    On the CPU Dr.Jit uses NumPy's memory as it is, and compiles loads by its alignment, which is a matter of luck. The
    copy is gathered by an index the kernel cannot see through, for which alignment does not matter.
    """
    source = kind(np.ascontiguousarray(values))
    copy = dr.gather(kind, source, dr.arange(mi.UInt32, dr.width(source)) + opaque(mi.UInt32(0)))
    dr.eval(copy)
    return copy


def table(values: Any) -> "mi.Float":
    """Return a flat opaque float32 array of `values`, for kernels that gather from it."""
    return opaque(mi.Float(np.ascontiguousarray(values, np.float32).ravel()))


def integers(values: Any) -> "mi.UInt32":
    """Return a flat opaque UInt32 array of `values`, for kernels that gather from it."""
    return opaque(mi.UInt32(np.ascontiguousarray(values, np.uint32).ravel()))
