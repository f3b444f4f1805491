"""What a preview is made of: pictures and measures of some shards, read one at a time."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from pipelines.shared import pictures
from render.checks.statistics import SceneStatistics, measure, slants
from render.planning.plan_counts import components
from render.records.manifest import SceneSpec
from render.records.mirror import shard_path
from render.records.shards import Shard, read_shard
from render.shared.errors import InputError
from render.shared.progress import progress_bar
from render.shared.seeds import spread_evenly

MEASURED = 120  # shards read for the histograms, besides those shown
SIDE = 128  # pixels of a picture's side
SLANTS = 400  # normals per shard in the slant histogram
STAGES = 6  # scenes that the page shows under each light
STAGE_LIGHTS, STAGE_SIDE, STAGE_COLUMNS = 128, 96, 12  # most lights and pixels of them


@dataclass(frozen=True)
class Stage:
    """A scene under each of its lights, on one sheet.

    Attributes:
        scene: The manifest line.
        sheet: (rows * h, 12 * w, 3) uint8, cells in rows of 12: the normals, then an image per light.
        size: (h, w) of a cell.
        lights: (L, 3), up to 128 of the scene's.
    """

    scene: SceneSpec
    sheet: np.ndarray
    size: tuple[int, int]
    lights: np.ndarray


@dataclass
class Sample:
    """What is kept of the shards that were read: pictures, captions and measures, never a shard.

    Attributes:
        tiles: (scene, strip) of the scenes that are shown.
        stages: Some of them under each light.
        statistics: Measures of every shard read.
        slants: (N,) angles of normals to the viewing axis, degrees.
        damaged: Ids of shards that could not be read.
    """

    tiles: list[tuple[SceneSpec, np.ndarray]] = field(default_factory=list)
    stages: list[Stage] = field(default_factory=list)
    statistics: list[SceneStatistics] = field(default_factory=list)
    slants: list[np.ndarray] = field(default_factory=list)
    damaged: list[str] = field(default_factory=list)


def read_sample(folder: Path, there: Sequence[SceneSpec], count: int) -> Sample:
    """Read the scenes to be shown, and some more for the histograms, one shard at a time."""
    some, more = (spread_evenly(range(len(there)), most) for most in (count, MEASURED))
    shown, places = {there[place].id for place in some}, sorted({*some, *more})
    staged = set(spread_evenly(sorted(shown), STAGES))
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
        if scene.id in staged:
            sample.stages.append(stage(scene, shard))
    return sample


def _some(values: np.ndarray) -> np.ndarray:
    return values[:: max(1, len(values) // SLANTS)]


def strip(shard: Shard) -> np.ndarray:  # (128, 512, 3) uint8
    """Show the normals and three images (or the material weights and two) under one exposure, at most 128 high."""
    picture = pictures.preview_strip(shard, lights=3)
    return pictures.scale_to_height(picture, SIDE)


def stage(scene: SceneSpec, shard: Shard) -> Stage:
    """Lay out the normals of a shard and its images, at most 96 high, under one exposure."""
    chosen = spread_evenly(range(len(shard.images)), STAGE_LIGHTS)
    exposure = pictures.auto_exposure(shard.images[chosen], shard.mask)
    shown = [pictures.normal_map(shard.normals, shard.mask)]
    shown += [pictures.tone_map(shard.images[number], exposure) for number in chosen]
    side = min(STAGE_SIDE, shard.mask.shape[0])
    cells = [pictures.scale_to_height(picture, side) for picture in shown]
    height, width = cells[0].shape[:2]
    sheet = np.full((-(-len(cells) // STAGE_COLUMNS) * height, STAGE_COLUMNS * width, 3), 255, np.uint8)
    for number, cell in enumerate(cells):
        row, column = divmod(number, STAGE_COLUMNS)
        sheet[row * height : (row + 1) * height, column * width : (column + 1) * width] = cell
    return Stage(scene, sheet, (height, width), shard.light_directions[chosen])


def caption(scene: SceneSpec) -> str:
    """Name a scene shortly: its shape's family, and its material or materials."""
    shape = scene.shape if len(scene.shape) < 20 else scene.shape.split(":")[0]
    return f"{shape}, {' + '.join(components(scene.material))}"
