"""Scenes to time a trainer on where no rendered ones are at hand: real shards, shaded by a formula.

Each scene is an ellipsoid with a Lambertian and a specular (Blinn-Phong) lobe and attached shadows. What loading and
training cost does not depend on what the images show, so these stand in for rendered ones; nothing is to be learned
from them.
"""

from pathlib import Path

import numpy as np

from render.planning import light_sets
from render.records.manifest import SceneSpec, View, write_manifest
from render.records.shards import Shard, to_half, write_shard
from render.shared.seeds import generator

LIGHTS = 64
_SHININESS = 40.0
_VIEW = np.array([0.0, 0.0, 1.0])


def write_scenes(folder: Path, count: int, *, size: int = 128, seed: int = 0) -> list[SceneSpec]:
    """Write a data folder with `count` scenes of split `train`, each with 64 lights, and return its manifest.

    Raises:
        InputError: an unwritable disk.
    """
    scenes = []
    for index in range(count):
        rng = generator(seed, "bench", "scene", index)
        directions = light_sets.draw("azimuth-elevation", LIGHTS, rng)
        scene = SceneSpec(
            id=f"ellipsoid-{index:03d}", seed=index, split="train", shape="ellipsoid", material="blinn-phong",
            view=View(), lights=tuple(map(tuple, directions.astype(np.float32).tolist())), size=size, spp=1, bounces=0,
        )  # fmt: skip
        normals, mask = ellipsoid(size, rng.uniform(0.5, 0.95, 3))
        shard = Shard(
            scene_id=scene.id,
            images=to_half(shade(normals, scene.light_directions(), rng.uniform(0.2, 0.9, 3))),
            normals=normals,
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


def ellipsoid(size: int, axes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return normals (S, S, 3) float32, zero outside, and mask (S, S) bool of an ellipsoid with semi-axes (3,)."""
    places = (np.arange(size) + 0.5) / size * 2.0 - 1.0
    x, y = np.meshgrid(places, -places)
    squared = (x / axes[0]) ** 2 + (y / axes[1]) ** 2
    mask = squared < 0.99
    z = axes[2] * np.sqrt(np.maximum(1.0 - squared, 0.0))
    gradient = np.stack([x, y, z], axis=-1) / axes**2
    normals = gradient / np.linalg.norm(gradient, axis=-1, keepdims=True)
    return np.where(mask[..., None], normals, 0.0).astype(np.float32), mask


def shade(normals: np.ndarray, lights: np.ndarray, albedo: np.ndarray) -> np.ndarray:
    """Return radiance (L, S, S, 3) float32 under lights (L, 3) of irradiance pi: Lambertian and Blinn-Phong lobes."""
    cosine = np.maximum(np.einsum("hwc,lc->lhw", normals, lights), 0.0)
    halfway = lights + _VIEW
    halfway /= np.linalg.norm(halfway, axis=-1, keepdims=True)
    lobe = np.maximum(np.einsum("hwc,lc->lhw", normals, halfway), 0.0) ** _SHININESS
    return (cosine[..., None] * (albedo + lobe[..., None])).astype(np.float32)
