"""Shapes by name: `sphere`, `bunny`, `blobby:17`, `sculpture:42`, or the path of a mesh file."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import trimesh
from threadpoolctl import threadpool_limits

from render.records.manifest import COMPOSITION, OWN_MESHES
from render.shapes import blobby, compositions, own_meshes, primitives
from render.shapes.files.mesh_file import load_mesh
from render.shapes.geometry.mesh import TriangleMesh
from render.shapes.sculpture import family as sculpture
from render.shared.errors import InputError, unknown


@dataclass(frozen=True)
class Family:
    """A way to make shapes: `build()` for a single shape, `build(seed)` for a seeded family."""

    build: Callable[..., TriangleMesh]
    seeded: bool
    about: str


FAMILIES = {
    "sphere": Family(primitives.sphere, False, "unit sphere with exact normals"),
    "bunny": Family(primitives.bunny, False, "Stanford bunny, fetched once"),
    "blobby": Family(blobby.blobby, True, "smooth lumpy blobs, one per seed"),
    "sculpture": Family(sculpture.sculpture, True, "figures, drapery, busts, animals, vessels, rocks and knots"),
    COMPOSITION: Family(compositions.composition, True, "objects in heaps, bowls, niches, before walls; hollow ones"),
}


def families() -> dict[str, str]:
    """Return the known families with one line about each; seeded ones are spelled `name:<seed>`."""
    return {f"{name}:<seed>" if family.seeded else name: family.about for name, family in FAMILIES.items()}


def load(name: str) -> TriangleMesh:
    """Build or read the shape `name`, centred and scaled so that its farthest vertex is at radius 1.

    Matrix products run on one thread here: their last bits depend on how many there are, and a shape's must not.

    Args:
        name: `sphere`, `bunny`, `blobby:<seed>`, `sculpture:<seed>`, the path of a mesh file, or one with its hash
            as plans have it (`render.shapes.own_meshes`).

    Raises:
        InputError: unknown name (with the nearest), bad seed, or a file that cannot be used.
    """
    with threadpool_limits(1, "blas"):
        return _load(name)


def own_file(name: str) -> Path | None:
    """Return the mesh file that a name stands for, None for a shape of this package."""
    base, colon, _ = name.partition(":")
    if base == OWN_MESHES and colon:
        return own_meshes.path_of(name)
    return None if base in FAMILIES else Path(name)


def _load(name: str) -> TriangleMesh:
    base, colon, text = name.partition(":")
    if base == OWN_MESHES and colon:
        return own_meshes.load_named(name)
    family = FAMILIES.get(base)
    if family is None:
        if Path(name).suffix[1:].lower() in trimesh.available_formats() or Path(name).is_file():
            return load_mesh(name).normalise()
        raise unknown("shape", name, FAMILIES, "or give the path of a mesh file")
    if not family.seeded:
        if colon:
            raise InputError(f"shape {name!r}: {base!r} takes no seed; write {base!r}")
        return family.build()
    # isdecimal alone also accepts the digits of other scripts, which would give one shape two names.
    if not (text.isascii() and text.isdecimal()):
        raise InputError(f"shape {name!r}: the seed must be a whole number from 0 up, as in '{base}:17'")
    return family.build(int(text))
