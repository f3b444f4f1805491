"""Run methods on rendered test scenes, which they see as photographs under lights of unknown intensity."""

import hashlib
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from functools import cache, cached_property, lru_cache
from pathlib import Path

import numpy as np

from pipelines.evaluate.evaluation import Evaluation, TestObject
from pipelines.rendering.render_data import render_planned
from pipelines.shared import scenes
from pipelines.shared.cluster.cluster_config import ClusterChoice
from pipelines.shared.presets import Preset, TestConfig
from render.records.manifest import SceneSpec
from render.records.shards import Shard, file_hash, read_shard
from render.shared.errors import InputError
from render.shared.images import quantise, write_png
from render.shared.seeds import generator
from sdps.methods.runner import Runner


@lru_cache(maxsize=1)
def _read(path: Path, scene: SceneSpec, _size: int, _time: int) -> tuple[Shard, str]:
    """Read a shard, and hash its file, once for all draws of intensities, as long as it does not change."""
    return read_shard(path, scene), file_hash(path)


def draw_intensities(scene: SceneSpec, config: TestConfig, repeat: int) -> np.ndarray:  # (L,) float32
    """Draw the random light intensities of a scene; each repeat has others."""
    rng = generator(config.seed, scene.id, "intensities", repeat)
    return rng.uniform(*config.intensity_range, len(scene.lights)).astype(np.float32)


def photograph(shard: Shard, gains: np.ndarray) -> np.ndarray:
    """Return (L, H, W, 3) float32: the object's radiance under lights of these intensities, black around it."""
    return shard.images.astype(np.float32) * gains[:, None, None, None] * shard.mask[..., None]


def write_photographs(folder: Path, images: Iterable[np.ndarray], mask: np.ndarray) -> Path:
    """Save pictures (H, W, 3), full scale 1, and a mask (H, W) as a user would: `000.png` and so on, `mask.png`.

    Raises:
        InputError: the folder cannot be written.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        write_png(folder / "mask.png", mask.astype(np.uint8) * 255)
        for number, image in enumerate(images):
            write_png(folder / f"{number:03d}.png", quantise(image, 16))
    except OSError as error:
        raise InputError(f"{folder}: cannot be written ({error.strerror or error}); choose another --out") from error
    return folder


def build_test_object(scene: SceneSpec, folder: Path, config: TestConfig, repeat: int = 0) -> TestObject:
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
    file = path.stat() if path.is_file() else None  # a missing file is reported when it is read
    shard, digest = _read(path, scene, *((file.st_size, file.st_mtime_ns) if file else (0, 0)))
    gains = draw_intensities(scene, config, repeat)
    parts = (digest, gains.tobytes().hex())
    return TestObject(
        name=scene.id if repeat == 0 else f"{scene.id}, draw {repeat}",
        digest=hashlib.sha256(repr(parts).encode()).hexdigest()[:24], load=lambda: photograph(shard, gains),
        mask=shard.mask, normals=shard.normals, light_directions=scene.light_directions(), intensities=gains,
        pictured=repeat == 0,
    )  # fmt: skip


@dataclass(frozen=True, eq=False)
class Workbench:
    """Methods and scenes of a run; results are kept in its folder `eval`.

    Attributes:
        preset: Its `test` section names shapes, materials, lights and how they are rendered.
        out: The run's folder; MERL-Test scenes are shared with `sdps evaluate merltest`.
        runners: The methods.
        draws: Random choices per point, where a figure makes any.
        cluster: Where scenes are rendered; this process when omitted.
    """

    preset: Preset
    out: Path
    runners: tuple[Runner, ...]
    draws: int = 3
    cluster: ClusterChoice | None = None

    @property
    def config(self) -> TestConfig:
        """The `test` section."""
        return self.preset.test

    def merltest(self) -> tuple[list[SceneSpec], Path]:
        """Return the MERL-Test scenes and their folder, rendered where they are not yet.

        Raises:
            InputError: the folder holds other scenes, or one cannot be rendered.
        """
        return self.render(self.config, self.out / "merltest")

    def render(self, config: TestConfig, folder: Path) -> tuple[list[SceneSpec], Path]:
        """Return the scenes of a test configuration and their folder, rendered where they are not yet."""
        wanted = scenes.test_scenes(config)
        render_planned(wanted, folder, replace(self.preset, test=config), self.cluster)
        return wanted, folder

    @cached_property
    def evaluation(self) -> Evaluation:
        """Runs methods and keeps their results."""
        return Evaluation(self.out / "eval")

    def objects(
        self, wanted: Iterable[SceneSpec], folder: Path, config: TestConfig
    ) -> Iterator[tuple[SceneSpec, TestObject]]:
        """Yield each scene under random intensities (the first draw), its images made once however often asked for."""
        for scene in wanted:
            item = build_test_object(scene, folder, config)
            yield scene, replace(item, load=cache(item.load))
