"""What every folder stands on: errors, files, YAML, seeds, pictures and tables; neither mitsuba nor torch."""

import importlib
import sys
from collections.abc import Callable, Mapping, Sequence
from typing import Any


def lazy_names(
    package: str, homes: Mapping[str, Sequence[str]]
) -> tuple[Callable[[str], Any], Callable[[], list[str]]]:
    """Return the `__getattr__` and `__dir__` of a package whose names are loaded when they are first used (PEP 562).

    Args:
        package: Its `__name__`.
        homes: What it offers: names by the module that defines them.
    """
    places = {name: module for module, names in homes.items() for name in names}
    root = sys.modules[package]

    def load(name: str) -> Any:
        if name not in places:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        value = getattr(importlib.import_module(places[name]), name)
        setattr(root, name, value)  # found without this function from now on
        return value

    def names() -> list[str]:
        return sorted({*vars(root), *places})

    return load, names
