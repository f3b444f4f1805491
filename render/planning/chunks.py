"""Cutting a plan into units of work: views that share rays, shapes that share a mesh, shares of a manifest."""

from collections.abc import Collection, Hashable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import groupby

from render.planning.budget import disk_bytes
from render.records.manifest import SceneSpec

GROUP_SIZE = 16  # most materials that share rays, and the mixture of bounce directions: it decides the bytes of shards
VIEWS_PER_CHUNK = 16  # few enough that the end of a run keeps all workers busy, and a lost worker costs little


@dataclass(frozen=True)
class Chunk:
    """Consecutive views of one shape, rendered by one process from one mesh.

    Attributes:
        shape: Name of the shape.
        groups: Scenes per view, whole: what shares rays decides the bytes, rendered or not.
        wanted: Ids of the scenes to render.
    """

    shape: str
    groups: tuple[tuple[SceneSpec, ...], ...]
    wanted: frozenset[str]

    def scenes(self) -> list[SceneSpec]:
        """Return the scenes to render, in order."""
        return [scene for group in self.groups for scene in group if scene.id in self.wanted]

    def without(self, ids: Collection[str]) -> "Chunk | None":
        """Return what is left when `ids` are finished, or None."""
        wanted = self.wanted - set(ids)
        groups = tuple(group for group in self.groups if any(scene.id in wanted for scene in group))
        return replace(self, groups=groups, wanted=wanted) if groups else None

    def only(self, group: Collection[SceneSpec]) -> "Chunk | None":
        """Return what is wanted of one view, or None."""
        kept = {scene.id for scene in group}
        return self.without([id for id in self.wanted if id not in kept])


def view_groups(scenes: Sequence[SceneSpec]) -> Iterator[list[SceneSpec]]:
    """Split the manifest into runs of scenes that differ only in id, split and material."""
    for _, run in groupby(scenes, key=_ray_key):
        group = list(run)
        for first in range(0, len(group), GROUP_SIZE):
            yield group[first : first + GROUP_SIZE]


def _ray_key(scene: SceneSpec) -> tuple[Hashable, ...]:
    lights = (scene.lights, scene.light_distances)
    return scene.shape, scene.view, scene.seed, lights, scene.size, scene.spp, scene.bounces


def share(scenes: Sequence[SceneSpec], part: int = 1, parts: int = 1) -> list[SceneSpec]:
    """Return the scenes of every `parts`-th shape of the manifest, starting with number `part` (from 1)."""
    runs = (list(run) for _, run in groupby(scenes, key=lambda scene: scene.shape))
    return [scene for number, run in enumerate(runs) if number % parts == part - 1 for scene in run]


def cut(scenes: Sequence[SceneSpec], wanted: Collection[str], workers: int = 1, chunk_bytes: int = 0) -> list[Chunk]:
    """Cut the scenes into chunks, without those in which nothing is wanted.

    Args:
        scenes: Scenes in the order of the manifest, views whole.
        wanted: Ids of the scenes to render.
        workers: Processes that share the work; few views are cut finer, so that none is idle.
        chunk_bytes: Most bytes of shards in a chunk of several views, as estimated; 0: any.
    """
    wanted = set(wanted)
    groups = [group for group in view_groups(scenes) if any(scene.id in wanted for scene in group)]
    length = max(1, min(VIEWS_PER_CHUNK, len(groups) // (4 * workers)))
    if chunk_bytes and groups:
        length = max(1, min(length, chunk_bytes // max(map(disk_bytes, groups))))
    chunks = []
    for shape, run in groupby(groups, key=lambda group: group[0].shape):
        views = [tuple(group) for group in run]
        for first in range(0, len(views), length):
            part = tuple(views[first : first + length])
            ids = frozenset(scene.id for group in part for scene in group if scene.id in wanted)
            chunks.append(Chunk(shape, part, ids))
    return chunks
