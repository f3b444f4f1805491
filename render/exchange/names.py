"""Where each scene goes in a foreign tree, under names its loaders accept.

Names consist of ASCII letters, digits and hyphens, so they have no separator, comment or blank, sort alike in every
natural order, and stay apart on file systems that ignore case. They are given to the whole manifest at once, so that
exporting some scenes first and the others later ends in the same tree.
"""

import re
from collections import Counter
from collections.abc import Hashable, Sequence
from typing import NamedTuple

from render.records.manifest import SceneSpec

_LONGEST = 80
_MATERIAL_FILES = r"\.(ya?ml|binary|bsdf)(?=\+|$)"


class Place(NamedTuple):
    """Place of a scene in a tree.

    `name` is its folder; in PS-FCN trees `shape` is the folder above, shared by the materials of one view, else it is
    empty.
    """

    shape: str
    name: str


def legal_name(name: str) -> str:
    """Turn a scene id, shape or material name into a file name; of paths only the stem of the file is kept."""
    stem = re.sub(_MATERIAL_FILES, "", re.sub(r"[^:+]*[/\\]", "", name))
    return re.sub(r"[^A-Za-z0-9]+", "-", stem).strip("-")[:_LONGEST].strip("-") or "unnamed"


def unique_names(names: Sequence[str]) -> list[str]:
    """Number those names that are equal but for case: `a`, `b`, `A` becomes `a-1`, `b`, `A-2`."""
    counts = Counter(name.casefold() for name in names)
    taken = {name for name, count in counts.items() if count == 1}
    result = []
    for name in names:
        chosen, number = name, 0
        while counts[name.casefold()] > 1 and (number == 0 or chosen.casefold() in taken):
            number += 1
            chosen = f"{name}-{number}"
        taken.add(chosen.casefold())
        result.append(chosen)
    return result


def object_places(scenes: Sequence[SceneSpec]) -> dict[str, Place]:
    """Give every scene a folder of its own, named after its id."""
    chosen = unique_names([legal_name(scene.id) for scene in scenes])
    return {scene.id: Place("", name) for scene, name in zip(scenes, chosen, strict=True)}


def view_places(scenes: Sequence[SceneSpec]) -> dict[str, Place]:
    """Give the scenes that show one object in one view a common folder, and in it one folder per material.

    Such scenes have one normal map; the view's name is what their ids have in common before `-m<number>`, else the
    name of the shape.
    """
    views: dict[tuple[Hashable, ...], list[SceneSpec]] = {}
    for scene in scenes:
        # The seed and the samples decide the rounding of the normals, so they are part of what is common.
        key: tuple[Hashable, ...] = (scene.shape, scene.view, scene.size, scene.seed, scene.spp)
        if scene.shape.startswith("imported:"):
            key += (scene.id,)  # nothing says that two imported scenes of one name are one view
        views.setdefault(key, []).append(scene)
    shapes = unique_names([_view_name(group) for group in views.values()])
    places: dict[str, Place] = {}
    for shape, group in zip(shapes, views.values(), strict=True):
        materials = unique_names([legal_name(scene.material) for scene in group])
        places |= {scene.id: Place(shape, name) for scene, name in zip(group, materials, strict=True)}
    return places


def _view_name(group: Sequence[SceneSpec]) -> str:
    """Return the stem of the ids, or the shape."""
    stems = {re.sub(r"-m[0-9]+$", "", scene.id) for scene in group}
    numbered = all(re.search(r"-m[0-9]+$", scene.id) for scene in group)
    return legal_name(stems.pop() if numbered and len(stems) == 1 else group[0].shape)
