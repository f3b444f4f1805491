"""A small data folder of Lambertian spheres: two materials of one view, another view, a test scene."""

from pathlib import Path

import numpy as np
from sdps_scenes import hemisphere_lights, shade, sphere_normals

from render.records.manifest import SceneSpec, View, write_manifest
from render.records.shards import Shard, to_half, write_shard

LIGHTS, SIZE = 5, 24

SCENES = (  # id, split, shape, material, scale, albedo
    ("blobby-00001-v0-m0", "train", "blobby:7", "blue-fabric", 0.85, (0.2, 0.3, 0.9)),
    ("blobby-00001-v0-m1", "train", "blobby:7", "stripes:7:chrome+blue-fabric", 0.85, (0.7, 0.7, 0.7)),
    ("blobby-00001-v1-m0", "val", "blobby:7", "lambertian:0.5", 0.6, (0.5, 0.5, 0.5)),
    ("sphere-gold", "test", "meshes/Sphere #2.obj", "fits/gold paint.yaml", 0.7, (1.6, 1.2, 0.4)),
)


def write_folder(folder: Path, *, lights: int = LIGHTS, size: int = SIZE) -> list[SceneSpec]:
    """Write the scenes; scenes of one view share their lights and normals."""
    scenes = []
    for name, split, shape, material, scale, albedo in SCENES:
        rng = np.random.default_rng([int(scale * 100)])
        directions = hemisphere_lights(lights, rng).astype(np.float64)
        scene = SceneSpec(
            id=name, seed=int(scale * 100), split=split, shape=shape, material=material, view=View(scale=scale),
            lights=tuple(tuple(round(float(value), 6) for value in row) for row in directions), size=size, spp=1,
            bounces=0,
        )  # fmt: skip
        normals, mask = sphere_normals(size, scale)
        shard = Shard(
            scene_id=scene.id,
            images=to_half(shade(normals, scene.light_directions(), np.array(albedo))),
            normals=normals / np.maximum(np.linalg.norm(normals, axis=-1, keepdims=True), 1e-6),
            depth=np.zeros((size, size), np.float32),
            mask=mask,
            coverage=mask.astype(np.float32),
            light_directions=scene.light_directions(),
            provenance={"spec": scene.digest()},
        )
        write_shard(folder / scene.file, shard)
        scenes.append(scene)
    write_manifest(folder, scenes)
    return scenes
