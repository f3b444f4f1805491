"""Textured materials by name: `procedural:<kind>:<seed>` and folders of PBR maps.

Of a procedural material every number follows from its kind and seed, so there is no end of them and nothing to
download. A kind divides the surface into `REGIONS` regions with a base colour, roughness and metallic each, and has a
relief; `procedural:<kind>:<seed>:<material>[+<material>...]` lays other materials into the regions instead.
"""

import colorsys
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from render.materials.textures.map_folder import MapFolder, read
from render.shared.errors import InputError, unknown
from render.shared.imaging.srgb import from_srgb
from render.shared.seeds import generator

KINDS = {
    "noise": "mottled stone or fired clay, rough",
    "tiles": "glazed tiles or bricks with bevelled edges, and the joints between them",
    "weave": "cloth of two sets of threads, plain or checked",
    "wood": "annual rings and pores along the grain",
    "marble": "polished stone with veins",
    "rust": "painted metal that peels and rusts",
    "print": "a printed or inlaid motif in rows",
    "scratches": "brushed metal with scratches",
}
PROCEDURAL, MAPS, UV = "procedural", "maps", "uv"
REGIONS = 3
_FILES = (".yaml", ".yml", ".binary", ".bsdf")
_REPEATS = 2.0  # of a folder of maps, over the radius of the object


@dataclass(frozen=True, eq=False)
class Textured:
    """A material that changes over the object.

    Attributes:
        name: Its full name.
        kind: One of `KINDS`, or `maps`, or `uv`.
        seed: Of a procedural material.
        maps: Of a folder of maps.
        repeats: How often the maps repeat over the object's radius, or over the mesh's unit of UV.
        category: `procedural-<kind>` or `texture-maps`.
        source: Where it comes from.
        terms: Terms of use.
    """

    name: str
    kind: str
    seed: int = 0
    maps: MapFolder | None = None
    repeats: float = 1.0
    category: str = MAPS
    source: str = "a folder of maps"
    terms: str = ""


def is_textured(name: str) -> bool:
    """Return whether a name is one of this module's."""
    head = name.partition(":")[0]
    if head in (PROCEDURAL, MAPS, UV):
        return True
    # A folder of a material's name in the current one must not hide the material, nor one named like a material file.
    return os.sep in name and Path(name).suffix.lower() not in _FILES and Path(name).is_dir()


def is_open(name: str) -> bool:
    """Return whether a name leaves the seed, or kind and seed, to be drawn: `procedural`, `procedural:wood`."""
    kind = name.removeprefix(f"{PROCEDURAL}:")
    return name == PROCEDURAL or (name != kind and kind in KINDS)


def complete(name: str, rng: np.random.Generator) -> str:
    """Complete an open name by a seed; any other stays as it is."""
    return f"{name}:{int(rng.integers(2**31))}" if is_open(name) else name


def without_seed(name: str) -> str:
    """Leave out the seed of a procedural material without others in it, to count those of a kind together."""
    if not name.startswith(f"{PROCEDURAL}:") or is_open(name):
        return name
    try:
        kind, _, names = procedural(name)
    except InputError:
        return name
    return name if names else f"{PROCEDURAL}:{kind}"


def procedural(name: str) -> tuple[str, int, tuple[str, ...]]:
    """Split `procedural:...` into kind, seed and the names of the materials laid into its regions, often none.

    Raises:
        InputError: an unknown kind, no seed, or too many materials.
    """
    if is_open(name):
        raise InputError(f"material {name!r}: add a seed, e.g. {name}:7; without one it is for a preset's `materials`")
    parts = name.split(":", 2)
    if len(parts) > 1 and parts[1].isdecimal():
        seed, rest = int(parts[1]), parts[2] if len(parts) > 2 else None
        kind = sorted(KINDS)[int(generator(seed, "procedural").integers(len(KINDS)))]
    else:
        kind = parts[1] if len(parts) > 1 else ""
        if kind not in KINDS:
            raise unknown("kind of procedural material", kind, KINDS)
        number, separator, rest_text = (parts[2] if len(parts) > 2 else "").partition(":")
        if not number.isdecimal():
            raise InputError(f"material {name!r}: expected {PROCEDURAL}:{kind}:<seed>, e.g. {PROCEDURAL}:{kind}:7")
        seed, rest = int(number), rest_text if separator else None
    if rest is None:
        return kind, seed, ()
    names = tuple(part.strip() for part in rest.split("+"))
    if not 1 <= len(names) <= REGIONS or not all(names):
        raise InputError(f"material {name!r}: name 1 to {REGIONS} materials joined by +, got {rest!r}")
    return kind, seed, names


def load(name: str) -> Textured:
    """Return a textured material: `procedural:...` without materials, or a folder of maps.

    A folder is named by its path, or `maps:<repeats>:<folder>` (laid on from three sides, the default), or
    `uv:<repeats>:<folder>` (by the mesh's texture coordinates).

    Raises:
        InputError: an unknown kind, a malformed name, or a folder without usable maps.
    """
    head, _, rest = name.partition(":")
    if head == PROCEDURAL:
        kind, seed, names = procedural(name)
        if names:
            raise InputError(f"material {name!r}: a mixture; it cannot be one of several materials")
        source = "made by the seeded generators of this package (`render.materials.textures`); no third-party data"
        return Textured(name, kind, seed, category=f"{PROCEDURAL}-{kind}", source=source, terms="none needed")
    if head in (MAPS, UV) and not Path(name).is_dir():
        number, separator, folder = rest.partition(":")
        try:
            repeats = float(number)
        except ValueError:
            repeats = 0.0
        if not separator or not 0 < repeats <= 100:
            raise InputError(f"material {name!r}: expected {head}:<repeats>:<folder>, e.g. {head}:2:textures/Bricks012")
        return Textured(name, head, maps=read(folder), repeats=repeats, category="texture-maps")
    return Textured(name, MAPS, maps=read(name), repeats=_REPEATS, category="texture-maps")


def folder(name: str) -> Path | None:
    """Return the folder of maps of a textured material's name, None for a procedural one."""
    head, _, rest = name.partition(":")
    if head == PROCEDURAL:
        return None
    return Path(rest.partition(":")[2] if head in (MAPS, UV) and not Path(name).is_dir() else name)


def palette(kind: str, seed: int) -> np.ndarray:
    """Return (3, 5) of the regions of a procedural material: linear base colour, roughness, metallic."""
    return _PALETTES[kind](generator(seed, "procedural", kind, "palette"))


def _colour(hue: float, saturation: float, value: float) -> list[float]:
    """Return linear RGB of an sRGB colour given by hue, saturation and value."""
    encoded = np.array(colorsys.hsv_to_rgb(hue % 1, np.clip(saturation, 0, 1), np.clip(value, 0, 1)))
    return list(from_srgb(encoded))


def _noise(rng: np.random.Generator) -> np.ndarray:
    hue, strength, rough = rng.uniform(), rng.uniform(0.05, 0.6), rng.uniform(0.45, 0.9)
    first = [*_colour(hue, strength, rng.uniform(0.5, 0.9)), rough, 0]
    second = [*_colour(hue + rng.normal() * 0.06, strength * 0.8, rng.uniform(0.3, 0.7)), rough, 0]
    third = [*_colour(hue + rng.normal() * 0.15, strength * 0.6, rng.uniform(0.7, 0.95)), rough * 0.7, 0]
    return np.array([first, second, third])


def _tiles(rng: np.random.Generator) -> np.ndarray:
    hue, glaze = rng.uniform(), rng.uniform(0.12, 0.5)
    first = [*_colour(hue, rng.uniform(0.1, 0.5), rng.uniform(0.4, 0.9)), glaze, 0]
    second = [*_colour(hue + rng.choice([0.05, 0.33, 0.5]), rng.uniform(0, 0.5), rng.uniform(0.3, 0.95)), glaze, 0]
    joint = [*_colour(0.1, 0.1, rng.uniform(0.3, 0.85)), 0.95, 0]
    return np.array([first, second, joint])


def _weave(rng: np.random.Generator) -> np.ndarray:
    hue, rough = rng.uniform(), rng.uniform(0.6, 0.95)
    first = [*_colour(hue, rng.uniform(0.3, 0.9), rng.uniform(0.3, 0.8)), rough, 0]
    second = [*_colour(hue + rng.uniform(0.2, 0.8), rng.uniform(0, 0.8), rng.uniform(0.4, 0.95)), rough, 0]
    return np.array([first, second, [*_colour(hue, 0.4, 0.12), 0.95, 0]])


def _wood(rng: np.random.Generator) -> np.ndarray:
    hue, value, rough = rng.uniform(0.05, 0.11), rng.uniform(0.45, 0.9), rng.uniform(0.25, 0.6)
    strength = rng.uniform(0.35, 0.7)
    early = [*_colour(hue, strength, value), rough, 0]
    late = [*_colour(hue - 0.015, strength + 0.15, value * rng.uniform(0.5, 0.75)), rough * 0.85, 0]
    return np.array([early, late, [*_colour(hue - 0.02, strength + 0.1, value * 0.35), 0.8, 0]])


def _marble(rng: np.random.Generator) -> np.ndarray:
    dark, hue, polish = rng.random() < 0.4, rng.uniform(), rng.uniform(0.1, 0.3)
    ground = _colour(hue, rng.uniform(0, 0.5 if dark else 0.12), rng.uniform(0.1, 0.35) if dark else 0.93)
    vein = _colour(hue, 0.1, 0.85) if dark else _colour(hue, rng.uniform(0, 0.3), rng.uniform(0.25, 0.55))
    gold = rng.random() < 0.5
    third = [*_colour(0.115, 0.6, 0.85), 0.3, 1.0] if gold else [*_colour(hue + 0.4, 0.3, 0.55), polish, 0]
    return np.array([[*ground, polish, 0], [*vein, polish * 1.3, 0], third])


def _rust(rng: np.random.Generator) -> np.ndarray:
    painted = rng.random() < 0.65
    paint = [*_colour(rng.uniform(0.1, 0.95), rng.uniform(0.2, 0.7), rng.uniform(0.4, 0.9)), rng.uniform(0.2, 0.5), 0]
    steel = [*_colour(0.6, 0.05, rng.uniform(0.6, 0.8)), rng.uniform(0.25, 0.45), 1]
    rust = [*_colour(rng.uniform(0.045, 0.07), rng.uniform(0.7, 0.85), rng.uniform(0.32, 0.48)), 0.95, 0]
    return np.array([paint if painted else steel, rust, [*_colour(0.08, 0.3, 0.55), 0.5, 0.8]])


def _print(rng: np.random.Generator) -> np.ndarray:
    hue, rough, inlaid = rng.uniform(), rng.uniform(0.2, 0.85), rng.random() < 0.3
    ground = [*_colour(hue, rng.uniform(0, 0.4), rng.uniform(0.6, 0.95)), rough, 0]
    motif = [*_colour(hue + rng.choice([0.5, 0.33, 0.08]), rng.uniform(0.4, 0.75), rng.uniform(0.25, 0.75)), rough, 0]
    if inlaid:
        motif = [*_colour(rng.uniform(0.08, 0.13), 0.5, 0.9), 0.25, 1]
    return np.array([ground, motif, [*_colour(hue + 0.6, rng.uniform(0, 0.9), rng.uniform(0.15, 0.9)), rough, 0]])


def _scratches(rng: np.random.Generator) -> np.ndarray:
    metal = [(0.6, 0.04, 0.8), (0.1, 0.35, 0.85), (0.055, 0.45, 0.85), (0.13, 0.55, 0.9), (0.6, 0.1, 0.5)]
    hue, strength, value = metal[int(rng.integers(len(metal)))]
    rough = rng.uniform(0.2, 0.45)
    bright = [*_colour(hue, strength * 0.5, min(value + 0.1, 0.95)), rough + 0.1, 1]
    return np.array([[*_colour(hue, strength, value), rough, 1], bright, [*_colour(0.08, 0.2, 0.25), 0.7, 0.3]])


_PALETTES: dict[str, Any] = {
    "noise": _noise, "tiles": _tiles, "weave": _weave, "wood": _wood, "marble": _marble, "rust": _rust,
    "print": _print, "scratches": _scratches,
}  # fmt: skip
