"""Rendering planned scenes into shards: view by view, resumable, each shard whole or absent.

`render_scenes` does it in this process and stops at the first mistake; `render.running.supervisor` has the same
pieces run by processes of their own, and goes on after failures.
"""

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import cache
from itertools import groupby
from pathlib import Path
from typing import Any

import drjit as dr

from render.backend import variant
from render.kernel import many_lights
from render.kernel.scene import Scene, build
from render.materials import surfaces as surface_names
from render.materials.kernels.packed import pack
from render.planning import provenance
from render.planning.chunks import GROUP_SIZE, view_groups
from render.records.manifest import SceneSpec
from render.records.shards import Shard, is_whole, to_half, write_shard
from render.shapes import load as load_shape
from render.shared.errors import InputError
from render.shared.progress import progress_bar

mi = variant.load()


class Unwritable(InputError):
    """The disk is full or the folder cannot be written: a mistake that every further scene would meet, too."""


class Stages:
    """Seconds per stage of the work, split among the scenes that share them.

    What several scenes share (a shape and its acceleration structure, the rays of a view) is spread over them in equal
    parts; `lap` returns what one scene took.

    Attributes:
        view_traced: Whether the rays of the view at work are done, so that a failure concerns one material only.
    """

    def __init__(self) -> None:
        self.view_traced = False
        self._seconds: dict[str, float] = {}
        self._shares: dict[str, dict[str, float]] = {}

    @contextmanager
    def time(self, stage: str) -> Iterator[None]:
        """Count the time spent inside as `stage`."""
        start = time.perf_counter()
        try:
            yield
        finally:
            self._seconds[stage] = self._seconds.get(stage, 0.0) + time.perf_counter() - start

    def each(self, stage: str, items: Iterator[Any]) -> Iterator[Any]:
        """Iterate over `items`, counting the time they take to appear as `stage`."""
        while True:
            with self.time(stage):
                item = next(items, None)
            if item is None:
                return
            yield item

    def spread(self, level: str, count: int) -> None:
        """Share what was counted since the last call or lap among `count` scenes, until `level` is spread again."""
        self._shares[level] = {stage: seconds / max(count, 1) for stage, seconds in self._seconds.items()}
        self._seconds = {}
        self.view_traced = level == "view"

    def lap(self) -> dict[str, float]:
        """Return the seconds per stage of the scene just finished, its shares included."""
        total = dict(self._seconds)
        for share in self._shares.values():
            for stage, seconds in share.items():
                total[stage] = total.get(stage, 0.0) + seconds
        self._seconds = {}
        return total


def render_scenes(
    scenes: Sequence[SceneSpec],
    folder: str | Path,
    *,
    group_size: int = GROUP_SIZE,
    on_shard: Callable[[SceneSpec], None] | None = None,
) -> int:
    """Render every scene that has no whole shard yet in `folder`, with a progress bar and ETA.

    Args:
        scenes: The manifest, whole; consecutive scenes that differ only in material share their rays.
        folder: Data folder; shards go to its `shards/`.
        group_size: Most materials that share rays (they share the bounce directions' mixture too, so the bytes of a
            shard depend on it and on the manifest alone).
        on_shard: Called after each shard is written.

    Returns:
        Number of shards rendered now.

    Raises:
        InputError: an unusable shape or material, or a full disk. Finished shards stay.
    """
    folder = Path(folder)
    missing = {scene.id for scene in scenes if not is_whole(folder / scene.file, scene)}
    with progress_bar(total=len(scenes), initial=len(scenes) - len(missing), unit="scene", desc="render") as bar:
        # Consecutive views of one shape share its mesh and acceleration structure.
        for shape, run in groupby(view_groups(scenes, group_size), key=lambda group: group[0].shape):
            groups = [group for group in run if any(scene.id in missing for scene in group)]
            if not groups:
                continue
            built, stages = build(load_shape(shape)), Stages()
            for group in groups:
                for scene in render_group(built, group, folder, missing, stages):
                    bar.update()
                    if on_shard:
                        on_shard(scene)
            dr.flush_malloc_cache()
    return len(missing)


def render_group(
    built: Scene, group: list[SceneSpec], folder: Path, missing: set[str], stages: Stages
) -> Iterator[SceneSpec]:
    """Render the missing scenes of one view and write their shards; yield each scene when its shard is written.

    Raises:
        InputError: an unusable material, an object outside the frame, or images that are not finite.
        Unwritable: a full disk or an unwritable folder.
    """
    for scene, shard in group_shards(built, group, missing, stages):
        with stages.time("write"):
            _write(folder / scene.file, shard)
        yield scene


def group_shards(
    built: Scene, group: list[SceneSpec], missing: set[str], stages: Stages
) -> Iterator[tuple[SceneSpec, Shard]]:
    """Render the missing scenes of one view, always from the whole group's rays, in the order of the group.

    Raises:
        InputError: an unusable material or an object outside the frame.
    """
    stages.view_traced = False
    first, only = group[0], [number for number, scene in enumerate(group) if scene.id in missing]
    with stages.time("render"):
        surfaces = pack([scene.material for scene in group], built.mesh)
        truth, images = many_lights.render(
            built, first.view, surfaces, first.light_directions(), size=first.resolution[0], spp=first.spp,
            bounces=first.bounces, seed=first.seed, only=only,
        )  # fmt: skip
    if not truth.mask.any():
        raise InputError(f"scene {first.id}: {first.shape} is outside the frame; check view.scale and view.offset")
    stages.spread("view", len(only))
    for number, stack in stages.each("render", images):
        scene = group[number]
        shard = Shard(
            scene_id=scene.id,
            images=to_half(stack),
            normals=truth.normals,
            depth=truth.depth,
            mask=truth.mask,
            coverage=truth.coverage,
            light_directions=scene.light_directions(),
            weights=truth.weights[number],
            materials=surface_names.split(scene.material)[1] if truth.weights[number] is not None else (),
            provenance=_describe(scene),
        )
        yield scene, shard


def _write(path: Path, shard: Shard) -> None:
    """Write a shard; tell a disk that refuses it from images that must not be written.

    Raises:
        Unwritable: the disk is full or the folder unwritable.
        InputError: non-finite values.
    """
    try:
        write_shard(path, shard)
    except InputError as error:
        if isinstance(error.__cause__, OSError):
            raise Unwritable(str(error)) from error
        raise


def _describe(scene: SceneSpec) -> dict[str, str | int | float]:
    """Describe how the scene was rendered, for the shard's header."""
    return {
        "spec": scene.digest(),
        "seed": scene.seed,
        "shape": scene.shape,
        "material": scene.material,
        "spp": scene.spp,
        "bounces": scene.bounces,
        "irradiance": "pi",
        "frame": "x right, y up, z to the camera",
        "variant": mi.variant(),
        **_software(),
    }


@cache
def _software() -> dict[str, str]:
    """Return the versions of this package and of those a shard depends on, and the commit in a checkout."""
    versions = {name: version for name, version in provenance.versions().items() if name in provenance.PACKAGES}
    commit = provenance.commit()
    return versions | ({"commit": commit} if commit else {})
