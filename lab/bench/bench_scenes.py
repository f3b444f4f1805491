"""Objects to time things on where no rendered ones are at hand: ellipsoids, shaded by a formula.

Each has a Lambertian and a specular lobe and attached shadows. What loading, training and inference cost does not
depend on what images show, so these stand in for rendered ones; nothing is to be learned from them.
"""

import argparse
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pipelines.shared.flags import add_fields, from_flags
from render.planning import light_sets
from render.records.manifest import SceneSpec, View, write_manifest
from render.records.shards import Shard, to_half, write_shard
from render.shared.errors import InputError
from render.shared.imaging.vectors import half_vectors
from render.shared.seeds import generator

LIGHTS = 64
_SHININESS = 40.0


@dataclass(frozen=True, kw_only=True)
class BenchClassicalConfig:
    """The large object that methods are timed on.

    Attributes:
        height: Rows of the images.
        width: Columns.
        lights: Number of images.
        seed: Seed of lights, colours and intensities.
    """

    height: int = 512
    width: int = 612
    lights: int = 96
    seed: int = 0

    def __post_init__(self) -> None:
        if min(self.height, self.width) < 32 or self.lights < 12:
            raise InputError("height and width must be at least 32, lights at least 12")


def add_size(parser: argparse.ArgumentParser) -> None:
    """Declare the size of the large object for commands to which lights mean something else."""
    add_fields(parser, BenchClassicalConfig, ("height", "width"))
    parser.add_argument("--images", type=int, default=BenchClassicalConfig.lights,
                        help="number of images (default: %(default)s)")  # fmt: skip


def size_from(args: argparse.Namespace) -> BenchClassicalConfig:
    """Return the configuration that the flags of `add_size` describe."""
    return from_flags(BenchClassicalConfig, args, lights=args.images)


def large_object(config: BenchClassicalConfig) -> tuple[np.ndarray, ...]:
    """Return images (L, H, W, 3) float32, mask (H, W), normals (H, W, 3), lights (L, 3), intensities (L,)."""
    rng = generator(config.seed, "bench classical")
    aspect = config.width / config.height
    normals, mask = ellipsoid((config.height, config.width), 0.96 * np.array([aspect, 1.0, 1.0]), edge=0.98)
    row, column = (((np.arange(side) + 0.5) / side * 2 - 1) / 0.96 for side in (config.height, config.width))
    cell = (np.floor((column + 1) * 6).astype(int) * 5 + np.floor((1 - row[:, None]) * 6).astype(int) * 3) % 9
    albedo = rng.uniform(0.2, 0.9, (9, 3))[cell]  # (H, W, 3)
    lights = light_sets.draw("near-uniform", config.lights, rng)
    gains = rng.uniform(0.2, 2.0, config.lights)
    images = np.empty((config.lights, config.height, config.width, 3), np.float32)
    for number, (light, half) in enumerate(zip(lights, half_vectors(lights), strict=True)):
        shading = np.maximum(normals @ light, 0.0)[..., None]
        gloss = 0.3 * np.maximum(normals @ half, 0.0)[..., None] ** 60 * (shading > 0)
        images[number] = gains[number] * (albedo * shading + gloss)
    return images, mask, normals, lights.astype(np.float32), gains.astype(np.float32)


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
        normals, mask = ellipsoid((size, size), rng.uniform(0.5, 0.95, 3))
        shard = Shard(
            scene_id=scene.id, images=to_half(shade(normals, scene.light_directions(), rng.uniform(0.2, 0.9, 3))),
            normals=normals, depth=np.zeros((size, size), np.float32), mask=mask, coverage=mask.astype(np.float32),
            light_directions=scene.light_directions(), provenance={"spec": scene.digest()},
        )  # fmt: skip
        write_shard(folder / scene.file, shard)
        scenes.append(scene)
    write_manifest(folder, scenes)
    return scenes


def ellipsoid(shape: tuple[int, int], axes: np.ndarray, edge: float = 0.99) -> tuple[np.ndarray, np.ndarray]:
    """Return normals (H, W, 3) float32, zero outside, and mask (H, W) bool of an ellipsoid.

    Args:
        shape: Height and width of the images.
        axes: Semi-axes (3,) in half image heights.
        edge: Share of the squared radius that is kept; the rim is left out.
    """
    row, column = ((np.arange(side) + 0.5) / side * 2.0 - 1.0 for side in shape)
    x, y = np.meshgrid(column * shape[1] / shape[0], -row)
    squared = (x / axes[0]) ** 2 + (y / axes[1]) ** 2
    mask = squared < edge
    z = axes[2] * np.sqrt(np.maximum(1.0 - squared, 0.0))
    gradient = np.stack([x, y, z], axis=-1) / axes**2
    normals = gradient / np.linalg.norm(gradient, axis=-1, keepdims=True)
    return np.where(mask[..., None], normals, 0.0).astype(np.float32), mask


def shade(normals: np.ndarray, lights: np.ndarray, albedo: np.ndarray) -> np.ndarray:
    """Return radiance (L, H, W, 3) float32 under lights (L, 3) of irradiance pi: Lambertian and Blinn-Phong lobes."""
    cosine = np.maximum(np.einsum("hwc,lc->lhw", normals, lights), 0.0)
    lobe = np.maximum(np.einsum("hwc,lc->lhw", normals, half_vectors(lights)), 0.0) ** _SHININESS
    return (cosine[..., None] * (albedo + lobe[..., None])).astype(np.float32)
