"""A data folder of white Lambertian spheres under a light stage, written without a renderer."""

from pathlib import Path

import numpy as np
from sdps_scenes import shade, sphere_normals

from render.planning import light_sets
from render.records.manifest import SceneSpec, View, write_manifest
from render.records.shards import Shard, to_half, write_shard

SIZE = 24


def write_stage(folder: Path, *, lights: int = 128, scenes: int = 2, albedo: float = 1.0) -> list[SceneSpec]:
    """Write spheres of different radius, of split train."""
    directions = tuple(tuple(row) for row in light_sets.load(f"stage:{lights}").round(6).tolist())
    planned = []
    for number in range(scenes):
        scene = SceneSpec(
            id=f"sphere-{number}", seed=number, split="train", shape="sphere", material=f"lambertian:{albedo}",
            view=View(), lights=directions, size=SIZE, spp=1, bounces=0,
        )  # fmt: skip
        normals, mask = sphere_normals(SIZE, 0.95 - 0.1 * number)
        shard = Shard(
            scene_id=scene.id, images=to_half(shade(normals, scene.light_directions(), albedo)), normals=normals,
            depth=np.zeros((SIZE, SIZE), np.float32), mask=mask, coverage=mask.astype(np.float32),
            light_directions=scene.light_directions(), provenance={"spec": scene.digest()},
        )  # fmt: skip
        write_shard(folder / scene.file, shard)
        planned.append(scene)
    write_manifest(folder, planned)
    return planned
