"""Test scenes: every chosen shape with every chosen material under one fixed set of lights."""

import re
from pathlib import Path

from pipelines.shared.presets import TestConfig
from render.materials import surfaces
from render.materials.textures import textured
from render.planning import light_sets
from render.planning.plan import material_pool
from render.records.manifest import SceneSpec, View
from render.shapes import load as load_shape
from render.shared.errors import InputError
from render.shared.seeds import derive_seed, generator

_MEASURED = (".binary", ".bsdf")


def test_scenes(config: TestConfig) -> list[SceneSpec]:
    """List one scene per shape and material, upright and centred, in an order that lets materials share rays.

    Raises:
        InputError: an unknown shape, material or light set, or two scenes of one name.
    """
    open_names = material_pool(config.materials)
    pool = [textured.complete(name, generator(config.seed, "test", "texture", name)) for name in open_names]
    for name in pool:
        surfaces.load(name)
    for shape in config.shapes:
        load_shape(shape)
    loaded = light_sets.load(config.lights).tolist()
    directions = tuple((round(x, 6), round(y, 6), round(z, 6)) for x, y, z in loaded)
    distances = () if config.light_distance is None else (config.light_distance,) * len(directions)
    scenes = [
        SceneSpec(
            id=f"{slug(shape)}-{slug(material)}",
            seed=derive_seed(config.seed, "test", shape),
            split="test",
            shape=shape,
            material=material,
            view=View(scale=config.scale, camera_distance=config.camera_distance),
            lights=directions,
            size=config.size,
            spp=config.spp,
            bounces=config.bounces,
            light_distances=distances,
        )
        for shape in config.shapes
        for material in pool
    ]  # fmt: skip
    names = [scene.id for scene in scenes]
    twice = next((name for name in names if names.count(name) > 1), None)
    if twice:
        raise InputError(f"two scenes would both be called {twice!r}; rename one of the files")
    return scenes


def slug(name: str) -> str:
    """Turn a shape or material name, or a path, into part of a file name: letters, digits, dots and hyphens.

    Folders are dropped; of a measured material the suffix stays, so that `chrome.binary` is not taken for `chrome`. The
    materials of a spatially varying name are joined by two hyphens: `stripes-7-chrome--blue-fabric`.
    """
    pattern, materials = surfaces.split_name(name)
    if pattern:
        return f"{pattern.kind}-{pattern.seed}-" + "--".join(slug(part) for part in materials)
    if name.startswith((f"{textured.MAPS}:", f"{textured.UV}:")):
        head, repeats, folder = name.split(":", 2)
        name = f"{head}-{repeats}-{Path(folder).name}"
    path = Path(name)
    if path.suffix.lower() in _MEASURED:
        name = path.name
    elif path.suffix.lower() in (".yaml", ".yml") or "/" in name.split(":")[0]:
        name = path.stem
    return re.sub(r"[^A-Za-z0-9.]+", "-", name).strip("-")
