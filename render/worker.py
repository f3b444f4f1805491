"""Rendering planned scenes into shards: view by view, resumable, each shard whole or absent."""

from collections.abc import Callable, Iterator, Sequence
from itertools import groupby
from pathlib import Path

import drjit as dr

from render import many_lights, variant
from render.errors import InputError
from render.manifest import SceneSpec
from render.materials import library
from render.materials.bsdf import PackedMaterials
from render.progress import progress_bar
from render.scene import build
from render.shapes import load as load_shape
from render.shards import Shard, is_whole, to_half, write_shard

mi = variant.load()


def render_scenes(
    scenes: Sequence[SceneSpec],
    folder: str | Path,
    *,
    group_size: int = 16,
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
            built = build(load_shape(shape))
            for group in groups:
                for scene in _render_group(built, group, folder, missing):
                    bar.update()
                    if on_shard:
                        on_shard(scene)
            dr.flush_malloc_cache()
    return len(missing)


def view_groups(scenes: Sequence[SceneSpec], group_size: int) -> Iterator[list[SceneSpec]]:
    """Split the manifest into runs of scenes that differ only in id, split and material."""
    for _, run in groupby(scenes, key=_ray_key):
        group = list(run)
        for first in range(0, len(group), group_size):
            yield group[first : first + group_size]


def _ray_key(scene: SceneSpec) -> tuple:
    return scene.shape, scene.view, scene.seed, scene.lights, scene.size, scene.spp, scene.bounces


def _render_group(built: "mi.Scene", group: list[SceneSpec], folder: Path, missing: set[str]) -> Iterator[SceneSpec]:
    """Render the missing scenes of one view, always from the whole group's rays, and write their shards."""
    first = group[0]
    packed = PackedMaterials([library.load(scene.material) for scene in group])
    truth, images = many_lights.render(
        built, first.view, packed, first.light_directions(), size=first.size, spp=first.spp,
        bounces=first.bounces, seed=first.seed,
        only=[number for number, scene in enumerate(group) if scene.id in missing],
    )  # fmt: skip
    if not truth.mask.any():
        raise InputError(f"scene {first.id}: {first.shape} is outside the frame; check view.scale and view.offset")
    for number, stack in images:
        scene = group[number]
        shard = Shard(
            scene_id=scene.id,
            images=to_half(stack),
            normals=truth.normals,
            depth=truth.depth,
            mask=truth.mask,
            coverage=truth.coverage,
            light_directions=scene.light_directions(),
            provenance=_provenance(scene),
        )
        write_shard(folder / scene.file, shard)
        yield scene


def _provenance(scene: SceneSpec) -> dict[str, str | int | float]:
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
        "mitsuba": mi.__version__,
        "drjit": dr.__version__,
        "variant": mi.variant(),
    }
