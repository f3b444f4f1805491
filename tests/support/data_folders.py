"""Small data folders made with numpy: spheres under directional lights, as `render-data` would leave them."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from render.records.manifest import SceneSpec, View, write_manifest
from render.records.shards import Shard, to_half, write_shard

SIZE, COUNT, RADIUS = 32, 12, 0.8
MATERIALS = ("lambertian:0.8", "pink-plastic", "chrome", "black-obsidian")
_REFLECTANCE = {  # diffuse albedo, highlight, its exponent
    "lambertian:0.8": (0.8, 0.0, 1),
    "pink-plastic": (0.3, 2.0, 80),
    "chrome": (0.0, 30.0, 300),
    "black-obsidian": (0.002, 1.0, 500),
}


def light_directions(count: int = COUNT, seed: int = 0) -> np.ndarray:  # (count, 3) float32
    rng = np.random.default_rng(seed)
    vectors = np.concatenate([rng.uniform(-1, 1, (count, 2)), rng.uniform(0.15, 1, (count, 1))], axis=1)
    return (vectors / np.linalg.norm(vectors, axis=1, keepdims=True)).round(6).astype(np.float32)


def sphere_shard(material: str = MATERIALS[0], *, name: str = "a", seed: int = 0, count: int = COUNT) -> Shard:
    """Return a sphere off centre, shaded by a Lambertian term and a Blinn-Phong highlight."""
    step = 2 / SIZE
    x, y = np.meshgrid(np.arange(SIZE) * step - 1 + step / 2, 1 - step / 2 - np.arange(SIZE) * step)
    x, y = (x - 0.1) / RADIUS, (y + 0.05) / RADIUS
    mask = x**2 + y**2 < 0.98
    z = np.sqrt(np.maximum(1 - x**2 - y**2, 0))
    normals = np.stack([x, y, z], axis=-1) * mask[..., None]
    lights = light_directions(count, seed)
    cosine = np.maximum(np.einsum("hwc,lc->lhw", normals, lights), 0)
    half = lights + np.array([0, 0, 1])
    half /= np.linalg.norm(half, axis=1, keepdims=True)
    diffuse, highlight, exponent = _REFLECTANCE[material]
    lobe = np.maximum(np.einsum("hwc,lc->lhw", normals, half), 0) ** exponent
    grey = (diffuse + highlight * lobe) * cosine * mask
    return Shard(
        scene_id=name,
        images=to_half((grey[..., None] * np.array([1.0, 0.8, 0.6])).astype(np.float32)),
        normals=normals.astype(np.float32),
        depth=(RADIUS * z * mask).astype(np.float32),
        mask=mask,
        coverage=mask.astype(np.float32),
        light_directions=lights,
        provenance={"material": material, "mitsuba": "3.9.1", "drjit": "1.5.0", "variant": "numpy", "irradiance": "pi"},
    )


def scene_of(shard: Shard, **changes) -> SceneSpec:
    values = {
        "id": shard.scene_id, "seed": 1, "split": "train", "shape": "sphere", "view": View(),
        "material": str(shard.provenance["material"]), "size": SIZE, "spp": 4, "bounces": 0,
        "lights": tuple(tuple(round(float(c), 6) for c in row) for row in shard.light_directions),
    }  # fmt: skip
    return SceneSpec(**(values | changes))


def write_folder(folder: Path, shards: Sequence[Shard], scenes: Sequence[SceneSpec] | None = None) -> list[SceneSpec]:
    """Write shards and their manifest; the shards carry the digest of their line."""
    scenes = list(scenes or [scene_of(shard) for shard in shards])
    write_manifest(folder, scenes)
    for shard, scene in zip(shards, scenes, strict=False):
        write_shard(folder / scene.file, replace(shard, provenance=shard.provenance | {"spec": scene.digest()}))
    return scenes


def good_folder(folder: Path) -> list[SceneSpec]:
    """Write one sphere per material, each under lights of its own."""
    shards = [
        sphere_shard(material, name=f"sphere-{number:05d}", seed=number) for number, material in enumerate(MATERIALS)
    ]
    return write_folder(folder, shards)
