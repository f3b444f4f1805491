"""A stand-in for what a node file takes from Meshroom: `meshroom.core.desc` and `meshroom.core.utils`.

Names, arguments and checks of default values are those of Meshroom's published description format
(alicevision/Meshroom, meshroom/core/desc/attribute.py and node.py, 2025.1; NODE_DEVELOPMENT.md). Arguments that later
versions renamed (`group`, now `commandLineGroup`) are left out, so that a node file that uses them fails here.
"""

import enum
import logging
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import pytest


class Attribute:
    """What all attributes have; `kind` is the type of the default value."""

    kind: type = str

    def __init__(self, name, label, description, value, advanced=False, invalidate=True, semantic="", enabled=True,
                 visible=True, exposed=False):  # fmt: skip
        self.name, self.label, self.description, self.value = name, label, description, value
        self.semantic = semantic

    def checkValueTypes(self) -> str:
        """Return the attribute's name if its default value is of another type, else an empty text."""
        return "" if isinstance(self.value, self.kind) else self.name


class File(Attribute):
    def checkValueTypes(self) -> str:
        return "" if isinstance(self.value, str) or callable(self.value) else self.name


class StringParam(Attribute):
    pass


class BoolParam(Attribute):
    kind = bool


class ChoiceParam(Attribute):
    def __init__(self, name, label, description, value, values, exclusive=True, **more):
        assert values
        super().__init__(name, label, description, value, **more)
        self.values, self.exclusive = values, exclusive

    def checkValueTypes(self) -> str:
        wrong = not isinstance(self.values, list) or (self.exclusive == isinstance(self.value, list))
        return self.name if wrong else ""


class Level(enum.Enum):
    NONE, NORMAL, INTENSIVE = range(3)


class StaticNodeSize:
    def __init__(self, size: int) -> None:
        self.size = size


class Node:
    """A node that runs Python; Meshroom calls its `processChunk(chunk)`."""

    cpu, gpu, ram = Level.NORMAL, Level.NONE, Level.NORMAL
    inputs: list[Any] = []  # noqa: RUF012
    outputs: list[Any] = []  # noqa: RUF012
    size, parallelization, documentation, category = StaticNodeSize(1), None, "", "Other"


def install(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let `from meshroom.core import desc` find this module."""
    utils = ModuleType("meshroom.core.utils")
    utils.VERBOSE_LEVEL = ["fatal", "error", "warning", "info", "debug", "trace"]
    core = ModuleType("meshroom.core")
    core.desc, core.utils = __import__(__name__), utils
    for name, module in {"meshroom": ModuleType("meshroom"), "meshroom.core": core, "meshroom.core.utils": utils,
                         "meshroom.core.desc": core.desc}.items():  # fmt: skip
        monkeypatch.setitem(__import__("sys").modules, name, module)


def make_chunk(description: type[Node], cache: Path, **values: Any) -> SimpleNamespace:
    """Return a chunk of a node with its attributes' values; outputs are expressions of the node's folder."""
    node = SimpleNamespace(name="node", internalFolder=str(cache))
    for attribute in description.inputs:
        setattr(node, attribute.name, SimpleNamespace(value=values.pop(attribute.name, attribute.value)))
    for attribute in description.outputs:
        setattr(node, attribute.name, SimpleNamespace(value=attribute.value.format(nodeCacheFolder=cache)))
    assert not values, f"no such inputs: {sorted(values)}"
    cache.mkdir(parents=True, exist_ok=True)
    log = SimpleNamespace(start=lambda level: None, end=lambda: None)
    return SimpleNamespace(node=node, logger=logging.getLogger("meshroom"), logManager=log, subprocess=None)
