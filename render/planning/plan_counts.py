"""What a manifest is made of: counts of shapes, views, materials and categories, and the light directions."""

from collections import Counter
from collections.abc import Hashable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from render.materials import library, surfaces
from render.materials.textures import textured
from render.records.manifest import OWN_MESHES, SceneSpec
from render.shared.errors import InputError

IMPORTED = "imported"  # family of shapes, and prefix of materials, that came with another data set


@dataclass(frozen=True)
class PlanCounts:
    """Counts over the scenes of a manifest; every mapping is sorted, the most frequent first.

    Attributes:
        scenes: Lines of the manifest.
        images: Images they come to.
        shapes, views: Different shapes; different (shape, view, lights).
        families: {family or file name: scenes}.
        splits: {split: scenes}.
        materials: {plain material: scenes it appears in}; a spatially-varying scene counts for each of its materials,
            procedural ones of a kind count together.
        categories: {category: scenes it appears in}.
        varying: Scenes with more than one material.
        near, perspective: Scenes with near lights; with a perspective camera.
        per_family: {family: (scenes, shapes, views)}.
        sizes: {width x height: scenes}.
        light_counts, spp, bounces: {value: scenes}.
    """

    scenes: int
    images: int
    shapes: int
    views: int
    families: dict[str, int]
    splits: dict[str, int]
    materials: dict[str, int]
    categories: dict[str, int]
    varying: int
    near: int
    perspective: int
    per_family: dict[str, tuple[int, int, int]]
    light_counts: dict[int, int]
    sizes: dict[str, int]
    spp: dict[int, int]
    bounces: dict[int, int]


def family(shape: str) -> str:
    """Return the family of a shape name (`blobby:17` is `blobby`), or the file name of a mesh."""
    if shape.startswith(f"{OWN_MESHES}:"):
        return OWN_MESHES
    return Path(shape).name if "/" in shape or "\\" in shape else shape.split(":")[0]


def components(material: str) -> tuple[str, ...]:
    """Return the plain materials of a name; several for a spatially-varying one (`stripes:7:chrome+steel`)."""
    try:
        return surfaces.split_name(material)[1]
    except InputError:
        return (material,)


def category(material: str) -> str:
    """Return the category of a plain material; `other` for a file that is not on this machine."""
    if textured.is_open(material):
        return material.replace(":", "-")
    try:
        return IMPORTED if material.startswith(f"{IMPORTED}:") else library.load(material).category or "other"
    except InputError:
        return "other"


def count_plan(scenes: Sequence[SceneSpec]) -> PlanCounts:
    """Count what a manifest holds."""
    per_family: dict[str, list[Any]] = {}
    for scene in scenes:
        entry = per_family.setdefault(family(scene.shape), [0, set(), set()])
        entry[0] += 1
        entry[1].add(scene.shape)
        entry[2].add(_view_key(scene))
    parts = [tuple(map(textured.without_seed, components(scene.material))) for scene in scenes]
    names = Counter(name for names in parts for name in set(names))
    kinds = {name: category(name) for name in names}
    return PlanCounts(
        scenes=len(scenes),
        images=sum(len(scene.lights) for scene in scenes),
        shapes=sum(len(entry[1]) for entry in per_family.values()),
        views=sum(len(entry[2]) for entry in per_family.values()),
        families=_count(family(scene.shape) for scene in scenes),
        splits=_count(scene.split for scene in scenes),
        materials=dict(names.most_common()),
        categories=_count(kind for names in parts for kind in {kinds[name] for name in names}),
        near=sum(bool(scene.light_distances) for scene in scenes),
        perspective=sum(scene.view.camera_distance is not None for scene in scenes),
        varying=sum(len(names) > 1 for names in parts),
        per_family={name: (count, len(shapes), len(views)) for name, (count, shapes, views) in per_family.items()},
        light_counts=_count(len(scene.lights) for scene in scenes),
        sizes=_count("{1}x{0}".format(*scene.resolution) for scene in scenes),
        spp=_count(scene.spp for scene in scenes),
        bounces=_count(scene.bounces for scene in scenes),
    )


def light_directions(scenes: Sequence[SceneSpec]) -> np.ndarray:  # (N, 3) float32
    """Return the light directions of all views; scenes that share a view's lights count once."""
    sets = {_view_key(scene): scene for scene in scenes}
    return np.concatenate([scene.light_directions() for scene in sets.values()])


def _view_key(scene: SceneSpec) -> tuple[Hashable, ...]:
    return scene.shape, scene.view, scene.lights, scene.light_distances


def _count(items: Iterable[Any]) -> dict[Any, int]:
    return dict(Counter(items).most_common())
