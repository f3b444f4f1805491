"""Lambertian spheres written as real shards, so that the learning side is tested without a renderer."""

from pathlib import Path

import numpy as np
import torch

from render.records.manifest import SceneSpec, View, write_manifest
from render.records.shards import Shard, to_half, write_shard
from sdps.data.dataset import SampleKey, SceneDataset, collate
from sdps.training.stages import Stage


def sphere_normals(size: int, radius: float = 0.85) -> tuple[np.ndarray, np.ndarray]:
    """Return normals (S, S, 3) float32 and mask (S, S) of a sphere seen orthographically; y up."""
    axis = (np.arange(size) + 0.5) / size * 2.0 - 1.0
    x, y = np.meshgrid(axis, -axis)
    squared = (x**2 + y**2) / radius**2
    mask = squared < 0.98
    normals = np.stack([x / radius, y / radius, np.sqrt(np.maximum(1.0 - squared, 0.0))], axis=-1)
    return (normals * mask[..., None]).astype(np.float32), mask


def hemisphere_lights(count: int, rng: np.random.Generator, lowest: float = 0.3) -> np.ndarray:
    """Return unit directions (L, 3) float32 uniform over the part of the sphere with z > `lowest`."""
    z = rng.uniform(lowest, 1.0, count)
    angle = rng.uniform(0.0, 2.0 * np.pi, count)
    flat = np.sqrt(1.0 - z * z)
    return np.stack([flat * np.cos(angle), flat * np.sin(angle), z], axis=-1).astype(np.float32)


def shade(normals: np.ndarray, lights: np.ndarray, albedo: np.ndarray | float = 0.8) -> np.ndarray:
    """Return Lambertian radiance (L, S, S, 3) float32 with attached shadows."""
    shading = np.maximum(np.einsum("hwc,lc->lhw", normals, lights), 0.0)
    return (shading[..., None] * np.broadcast_to(albedo, (3,))).astype(np.float32)


def write_data(
    folder: Path, splits: tuple[str, ...], *, lights: int = 8, size: int = 128, seed: int = 0
) -> list[SceneSpec]:
    """Write a data folder with one sphere per entry of `splits`, of random radius, colour and lights."""
    scenes = []
    for index, split in enumerate(splits):
        rng = np.random.default_rng([seed, index])
        directions = hemisphere_lights(lights, rng)
        scene = SceneSpec(
            id=f"sphere_{index:03d}",
            seed=index,
            split=split,
            shape="sphere",
            material="lambert",
            view=View(),
            lights=tuple(tuple(float(value) for value in row) for row in directions),
            size=size,
            spp=1,
            bounces=0,
        )
        normals, mask = sphere_normals(size, rng.uniform(0.6, 0.95))
        shard = Shard(
            scene_id=scene.id,
            images=to_half(shade(normals, directions, rng.uniform(0.3, 1.0, 3))),
            normals=normals,
            depth=np.zeros((size, size), np.float32),
            mask=mask,
            coverage=mask.astype(np.float32),
            light_directions=scene.light_directions(),
            provenance={"seed": index},
        )
        write_shard(folder / scene.file, shard)
        scenes.append(scene)
    write_manifest(folder, scenes)
    return scenes


def errors(stage: Stage, folder: Path) -> dict[str, float]:
    """Return the stage's metrics on its own training scenes, under augmentation it has not seen."""
    dataset = SceneDataset(folder, "train", stage.validation_options())
    stage.network.eval()
    with torch.no_grad():
        return stage.metrics(collate([dataset.sample(SampleKey(index, 999, index)) for index in range(len(dataset))]))
