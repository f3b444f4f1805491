"""Surfaces by name: one material everywhere, or several in a seeded pattern.

A spatially-varying surface is named `<pattern>:<seed>:<material>+<material>[+...]`, for instance
`stripes:7:chrome+blue-fabric`. Its BRDF is sum_k w_k(x) f_k with weights w_k >= 0 that sum to 1 at every point x of the
object, so the pattern turns with the object and takes part in interreflections.

A textured surface is named `procedural:<kind>:<seed>[:<material>+...]` or is a folder of maps
(`render.materials.textures.textured`); it has a relief as well.
"""

from dataclasses import dataclass
from typing import Any

from render.materials import library
from render.materials.textures import textured
from render.materials.textures.textured import Textured
from render.shared.errors import InputError, unknown

PATTERNS = {
    "patches": "cells around random points, sharp edges",
    "stripes": "warped bands, sharp edges",
    "noise": "smooth random regions that blend into each other",
    "gradient": "a slow change from one material to the next along a direction",
    "parts": "the objects of a composition, the separate pieces of a mesh, or large regions of one in one piece",
}
MOST_COMPONENTS = 8


@dataclass(frozen=True)
class Pattern:
    """Where which material lies: kind, seed and number of materials; the kind of a procedural one has a prefix."""

    kind: str
    seed: int
    count: int

    @property
    def texture(self) -> str | None:
        """The kind of procedural material whose regions the materials fill, or None."""
        kind = self.kind.removeprefix(f"{textured.PROCEDURAL}-")
        return None if kind == self.kind else kind


@dataclass(frozen=True, eq=False)
class Surface:
    """What covers an object.

    Attributes:
        name: As given to `load`.
        components: Materials of the pattern, or the only one.
        pattern: None for a single material.
    """

    name: str
    components: tuple[Any, ...]
    pattern: Pattern | None = None

    @property
    def textured(self) -> bool:
        """Whether it has a relief and is evaluated by `render.materials.kernels.textures`."""
        return isinstance(self.components[0], Textured) or (
            self.pattern is not None and self.pattern.texture is not None
        )


def split_name(name: str) -> tuple[Pattern | None, tuple[str, ...]]:
    """Split a name into its pattern, if it has one, and the names of its materials; nothing is loaded.

    Raises:
        InputError: a malformed pattern, naming the part.
    """
    kind, _, rest = name.partition(":")
    if kind == textured.PROCEDURAL:
        return _split_procedural(name)
    if kind not in PATTERNS:
        head, separator, _ = rest.partition(":")
        if separator and "+" in rest and head.isdecimal():
            raise unknown("pattern", kind, PATTERNS)
        return None, (name,)
    seed, separator, materials = rest.partition(":")
    if not separator or not seed.isdecimal():
        raise InputError(f"surface {name!r}: expected {kind}:<seed>:<material>+<material>, e.g. {kind}:7:chrome+nylon")
    names = tuple(part.strip() for part in materials.split("+"))
    if not 2 <= len(names) <= MOST_COMPONENTS or not all(names):
        raise InputError(f"surface {name!r}: name 2 to {MOST_COMPONENTS} materials joined by +, got {materials!r}")
    mixed = next((part for part in names if textured.is_textured(part)), None)
    if mixed:
        raise InputError(f"surface {name!r}: {mixed!r} is textured and covers an object alone; leave it out")
    return Pattern(kind, int(seed), len(names)), names


def _split_procedural(name: str) -> tuple[Pattern | None, tuple[str, ...]]:
    kind, seed, names = textured.procedural(name)
    inner = next((part for part in names if textured.is_textured(part)), None)
    if inner:
        raise InputError(f"surface {name!r}: {inner!r} is textured itself; lay plain materials into the regions")
    return (Pattern(f"{textured.PROCEDURAL}-{kind}", seed, len(names)), names) if names else (None, (name,))


def load(name: str) -> Surface:
    """Load a surface.

    Args:
        name: Anything `library.load` takes, or `<pattern>:<seed>:<material>+<material>[+...]`.

    Raises:
        InputError: an unknown pattern or material (with the nearest), or a file that cannot be read.
    """
    pattern, names = split_name(str(name))
    return Surface(str(name), tuple(library.load(part) for part in names), pattern)
