"""Rendered test scenes as photographs under lights of unknown strength: what every evaluation on them starts from."""

import hashlib
from functools import lru_cache
from pathlib import Path

import numpy as np

from pipelines.evaluate.evaluation import TestObject
from pipelines.shared.presets import TestConfig
from render.records.manifest import SceneSpec
from render.records.shards import Shard, file_hash, read_shard
from render.shared.seeds import generator


@lru_cache(maxsize=1)
def _read(path: Path, scene: SceneSpec, _size: int, _time: int) -> tuple[Shard, str]:
    """Read a shard, and hash its file, once for all draws of intensities, as long as it does not change."""
    return read_shard(path, scene), file_hash(path)


def intensities(scene: SceneSpec, config: TestConfig, repeat: int) -> np.ndarray:  # (L,) float32
    """Draw the random light intensities of a scene; each repeat has others."""
    rng = generator(config.seed, scene.id, "intensities", repeat)
    return rng.uniform(*config.intensity_range, len(scene.lights)).astype(np.float32)


def photographs(shard: Shard, gains: np.ndarray) -> np.ndarray:
    """Return (L, H, W, 3) float32: the object's radiance under lights of these intensities, black around it."""
    return shard.images.astype(np.float32) * gains[:, None, None, None] * shard.mask[..., None]


def lit_object(scene: SceneSpec, folder: Path, config: TestConfig, repeat: int = 0) -> TestObject:
    """Return a rendered scene as an object to evaluate.

    Args:
        scene: A scene of the manifest.
        folder: The data folder it was rendered into.
        config: Seed and range of the random intensities.
        repeat: Which draw of them.

    Raises:
        InputError: the shard is missing or damaged.
    """
    path = folder / scene.file
    file = path.stat() if path.is_file() else None  # reading it tells what is wrong
    shard, digest = _read(path, scene, *((file.st_size, file.st_mtime_ns) if file else (0, 0)))
    gains = intensities(scene, config, repeat)
    parts = (digest, gains.tobytes().hex())
    return TestObject(
        name=scene.id if repeat == 0 else f"{scene.id}, draw {repeat}",
        digest=hashlib.sha256(repr(parts).encode()).hexdigest()[:24],
        load=lambda: photographs(shard, gains),
        mask=shard.mask,
        normals=shard.normals,
        light_directions=scene.light_directions(),
        intensities=gains,
    )
