"""Mitsuba and Dr.Jit under the chosen variant, as `mi` and `dr`: the one place that imports them.

Importing Dr.Jit starts a thread that reads the environment and loads libLLVM. A change of the environment in that
moment can crash the process, and a libLLVM named later is not seen. So the library is named first, then Dr.Jit is
imported, and nothing goes on until its thread has ended.
"""

import importlib
from typing import Any

from render.backend import variant

mi: Any = variant.load()
dr: Any = importlib.import_module("drjit")

__all__ = ["dr", "mi"]
