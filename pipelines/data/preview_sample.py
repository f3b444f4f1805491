"""What a preview is made of: pictures and measures of some shards, read one at a time."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from pipelines.shared import pictures
from render.checks.statistics import SceneStatistics, measure, slants
from render.planning.composition import components
from render.records.manifest import SceneSpec
from render.records.mirror import shard_path
from render.records.shards import Shard, read_shard
from render.shared.errors import InputError
from render.shared.progress import progress_bar

MEASURED = 120  # shards read for the histograms, besides those shown
SIDE = 128  # pixels of a picture's side
SLANTS = 400  # normals per shard in the slant histogram


@dataclass
class Sample:
    """What is kept of the shards that were read: pictures, captions and measures, never a shard.

    Attributes:
        tiles: (scene, strip) of the scenes that are shown.
        statistics: Measures of every shard read.
        slants: (N,) angles of normals to the viewing axis, degrees.
        damaged: Ids of shards that could not be read.
    """

    tiles: list[tuple[SceneSpec, np.ndarray]] = field(default_factory=list)
    statistics: list[SceneStatistics] = field(default_factory=list)
    slants: list[np.ndarray] = field(default_factory=list)
    damaged: list[str] = field(default_factory=list)


def read_sample(folder: Path, there: Sequence[SceneSpec], count: int) -> Sample:
    """Read the scenes to be shown, and some more for the histograms, one shard at a time."""
    shown = {there[place].id for place in _spread(len(there), count)}
    places = np.union1d(_spread(len(there), count), _spread(len(there), MEASURED))
    sample = Sample()
    for place in progress_bar(places, unit="shard", desc="preview"):
        scene = there[place]
        try:
            path = shard_path(folder, scene)
            shard = read_shard(path, scene)
        except InputError:
            sample.damaged.append(scene.id)
            continue
        sample.statistics.append(measure(shard, path.stat().st_size))
        sample.slants.append(_some(slants(shard)))
        if scene.id in shown:
            sample.tiles.append((scene, strip(shard)))
    return sample


def _spread(length: int, count: int) -> np.ndarray:
    """Return up to `count` places spread evenly over `range(length)`."""
    return np.unique(np.linspace(0, length - 1, min(count, length)).round().astype(int))


def _some(values: np.ndarray) -> np.ndarray:
    return values[:: max(1, len(values) // SLANTS)]


def strip(shard: Shard) -> np.ndarray:  # (128, 512, 3) uint8
    """Show the normals and three images (or the material weights and two) under one exposure, at most 128 high."""
    picture = pictures.preview_strip(shard, lights=3)
    return pictures.fitted(picture, SIDE)


def caption(scene: SceneSpec) -> str:
    """Name a scene shortly: its shape's family, and its material or materials."""
    shape = scene.shape if len(scene.shape) < 20 else scene.shape.split(":")[0]
    return f"{shape}, {' + '.join(components(scene.material))}"
