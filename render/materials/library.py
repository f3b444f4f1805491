"""The materials by name: 100 fitted MERL materials, Lambertian of any albedo, and YAML files of the user."""

from functools import cache, lru_cache
from importlib import resources
from pathlib import Path

import numpy as np
import yaml

from render import config
from render.errors import InputError, unknown
from render.materials.model import Material, directional_albedo, lambertian

_ALBEDO_COSINES = np.linspace(0.05, 1, 8)


def names() -> list[str]:
    """Return the names of the built-in materials, sorted."""
    return list(_names())


@cache
def _names() -> tuple[str, ...]:
    folder = resources.files("assets").joinpath("materials")
    return tuple(sorted(entry.name.removesuffix(".yaml") for entry in folder.iterdir() if entry.name.endswith(".yaml")))


def categories() -> dict[str, list[str]]:
    """Return the built-in materials by category, e.g. `fabric` (12), `plastic` (9), `phenolic` (12)."""
    groups: dict[str, list[str]] = {}
    for name in _names():
        groups.setdefault(load(name).category, []).append(name)
    return {key: groups[key] for key in sorted(groups)}


def load(name_or_path: str | Path) -> Material:
    """Return a material.

    Args:
        name_or_path: A name from `names()`; `lambertian:0.5` or `lambertian:0.8/0.3/0.1` (linear RGB albedo); or the
            path of a YAML file of the same form as the built-in ones, ending in `.yaml` or `.yml`.

    Raises:
        InputError: an unknown name (with the nearest), an albedo outside (0, 1], or a file that is not a material,
            naming the file and the field.
    """
    text = str(name_or_path)
    if text.endswith((".yaml", ".yml")):
        return _user_material(text)
    return _builtin(text)


@lru_cache(maxsize=256)
def _builtin(name: str) -> Material:
    kind, separator, value = name.partition(":")
    if kind == "lambertian":
        return _lambertian(name, value)
    if separator or name not in _names():
        raise unknown("material", name, [*_names(), "lambertian:0.5"], "or give the path of a .yaml file")
    text = resources.files("assets").joinpath("materials", f"{name}.yaml").read_text(encoding="utf-8")
    return config.build(Material, yaml.load(text, Loader=getattr(yaml, "CSafeLoader", yaml.SafeLoader)))


def _lambertian(name: str, value: str) -> Material:
    """Parse `0.5` or `0.8/0.3/0.1`."""
    try:
        albedo = tuple(float(part) for part in value.split("/"))
    except ValueError:
        albedo = ()
    if len(albedo) not in (1, 3):
        raise InputError(f"material {name!r}: expected lambertian:0.5 or lambertian:0.8/0.3/0.1")
    return lambertian(albedo[0] if len(albedo) == 1 else albedo)


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
