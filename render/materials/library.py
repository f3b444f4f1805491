"""The materials by name: 100 fitted MERL materials, Lambertian of any albedo, and files of the user.

A file is a fitted material (YAML), a MERL table (`.binary`) or an RGL tensor file (`.bsdf`).
"""

import os
from functools import cache, lru_cache
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING, TypeAlias

import numpy as np
import yaml

from render.materials import merl
from render.materials.merl import MerlTable
from render.materials.model import Material, directional_albedo, lambertian
from render.materials.textures import textured
from render.shared import config
from render.shared.errors import InputError, unknown

if TYPE_CHECKING:
    from render.materials.rgl import RglMaterial

AnyMaterial: TypeAlias = "Material | MerlTable | RglMaterial | textured.Textured"
FILES = ".yaml (fitted), .binary (MERL) or .bsdf (RGL)"
_ALBEDO_COSINES = np.linspace(0.05, 1, 8)


def names() -> list[str]:
    """Return the names of the built-in materials, sorted."""
    return list(_names())


def held_out() -> list[str]:
    """Return the names of the materials that training never sees, for validation: fits to RGL and Nielsen's data."""
    return list(_names("materials/held-out"))


@cache
def _names(place: str = "materials") -> tuple[str, ...]:
    folder = resources.files("assets").joinpath(*place.split("/"))
    return tuple(sorted(entry.name.removesuffix(".yaml") for entry in folder.iterdir() if entry.name.endswith(".yaml")))


def categories() -> dict[str, list[str]]:
    """Return the built-in materials by category, e.g. `fabric` (12), `plastic` (9), `phenolic` (12)."""
    groups: dict[str, list[str]] = {}
    for name in _names():
        groups.setdefault(load(name).category, []).append(name)
    return {key: groups[key] for key in sorted(groups)}


def load(name_or_path: str | Path) -> AnyMaterial:
    """Return a material.

    Args:
        name_or_path: A name from `names()`; `lambertian:0.5` or `lambertian:0.8/0.3/0.1` (linear RGB albedo); or the
            path of a file: `.yaml` or `.yml` of the same form as the built-in ones, `.binary` of the MERL database, or
            `.bsdf` of the RGL database. Measured files are taken as they are, even with an albedo above 1. A textured
            material (see `textured.load`): `procedural:wood:7`, or a folder of maps.

    Raises:
        InputError: an unknown name (with the nearest), an albedo outside (0, 1], a file of another kind, or one that
            is not a material, naming the file and the field.
    """
    text = str(name_or_path)
    suffix = Path(text).suffix.lower()
    if textured.is_textured(text):
        return textured.load(text)
    if suffix in (".yaml", ".yml"):
        return _user_material(text)
    if suffix in (merl.SUFFIX, ".bsdf"):
        return _load_measured(text, _change_time(text))
    if text not in _names() and (Path(text).is_file() or (os.sep in text and ":" not in text)):
        raise InputError(f"{text}: a material file must end in {FILES}; a folder of maps must exist")
    return _builtin(text)


def own_file(name: str) -> Path | None:
    """Return the file or folder of maps that a material's name stands for, None for one of this package."""
    if textured.is_textured(name):
        return textured.folder(name)
    return Path(name) if Path(name).suffix.lower() in (".yaml", ".yml", merl.SUFFIX, ".bsdf") else None


@lru_cache(maxsize=16)
def _load_measured(path: str, changed: int) -> "MerlTable | RglMaterial":
    """Read a measured file; `changed` is the time of its last change, so that a rewritten one is read again."""
    if path.lower().endswith(merl.SUFFIX):
        return merl.read(path)
    from render.materials import rgl

    return rgl.load(path)


def _change_time(path: str) -> int:
    try:
        return os.stat(path).st_mtime_ns
    except OSError:
        return 0  # reading it raises an error that says why


@lru_cache(maxsize=256)
def _builtin(name: str) -> Material:
    kind, separator, value = name.partition(":")
    if kind == "lambertian":
        return _lambertian(name, value)
    held = name in _names("materials/held-out")
    if separator or not (held or name in _names()):
        known = [*_names(), *held_out(), "lambertian:0.5"]
        raise unknown("material", name, known, f"or give the path of a file ending in {FILES}")
    place = ("materials", "held-out") if held else ("materials",)
    text = resources.files("assets").joinpath(*place, f"{name}.yaml").read_text(encoding="utf-8")
    return config.build(Material, yaml.load(text, Loader=getattr(yaml, "CSafeLoader", yaml.SafeLoader)))


def _lambertian(name: str, value: str) -> Material:
    """Parse `0.5` or `0.8/0.3/0.1`."""
    try:
        albedo = [float(part) for part in value.split("/")]
    except ValueError:
        albedo = []
    if len(albedo) not in (1, 3):
        raise InputError(f"material {name!r}: expected lambertian:0.5 or lambertian:0.8/0.3/0.1")
    return lambertian(albedo[0] if len(albedo) == 1 else (albedo[0], albedo[1], albedo[2]))


def _user_material(path: str) -> Material:
    values = config.read_yaml(path)
    try:
        material = config.build(Material, values)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
    albedo = directional_albedo(material, _ALBEDO_COSINES)
    if albedo.max() > 1.01:
        raise InputError(
            f"{path}: bivariate: reflects more light than it receives (albedo {albedo.max():.2f}); scale it"
        )
    return material
