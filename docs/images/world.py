r"""Draws docs/images/world.jpg from scenes of the preset `world`, each under one light, with its normals beside it.

sdps render-data --preset world --out out/world --set data.views=1 --set data.materials_per_view=1 \
    --set data.families='{composition: 15, sculpture: 2, blobby: 1}' --set data.light_count=8 --set data.spp=64
python docs/images/world.py out/world/data
"""

import sys
from pathlib import Path

import numpy as np
from PIL import Image

from render.records.manifest import read_manifest
from render.records.shards import Shard, read_shard
from render.shared.imaging.sensor import to_srgb

COLUMNS, SIDE, GAP = 6, 176, 4


def lit(shard: Shard) -> np.ndarray:  # (H, W, 3) uint8
    """Return the image of the light that models the object best: from the side, with few pixels in its shadow."""
    radiance = shard.images.astype(np.float32)
    level = np.median(radiance[:, shard.mask].mean(-1), axis=1)
    slant = np.abs(np.degrees(np.arccos(np.clip(shard.light_directions[:, 2], -1, 1))) - 40)
    image = radiance[np.argmin(slant - 30 * level / max(level.max(), 1e-6))]
    exposure = 0.9 / max(float(np.percentile(image[shard.mask], 97)), 1e-6)
    picture = to_srgb(np.clip(image * exposure, 0, 1)) * 255 + 0.5
    return np.where(shard.coverage[..., None] > 0, picture, 0).astype(np.uint8)


def main(folder: Path) -> None:
    scenes = read_manifest(folder)
    shards = [read_shard(folder / scene.file, scene) for scene in scenes if (folder / scene.file).exists()]
    rows = -(-len(shards) // COLUMNS)
    page = Image.new("RGB", (COLUMNS * (SIDE + GAP) - GAP, rows * (SIDE + SIDE // 2 + GAP) - GAP), (255, 255, 255))
    for place, shard in enumerate(shards):
        x, y = place % COLUMNS * (SIDE + GAP), place // COLUMNS * (SIDE + SIDE // 2 + GAP)
        page.paste(Image.fromarray(lit(shard)).resize((SIDE, SIDE), Image.Resampling.LANCZOS), (x, y))
        normals = np.where(shard.mask[..., None], (shard.normals + 1) * 127.5, 0).astype(np.uint8)
        number = np.zeros(shard.mask.shape) if shard.objects is None else shard.objects
        grey = (np.where(shard.mask, 60 + (number * 67) % 180, 0)).astype(np.uint8)
        for column, picture in enumerate((normals, np.repeat(grey[..., None], 3, axis=2))):
            small = Image.fromarray(picture).resize((SIDE // 2, SIDE // 2), Image.Resampling.LANCZOS)
            page.paste(small, (x + column * SIDE // 2, y + SIDE))
    page.save(Path(__file__).with_suffix(".jpg"), quality=85, optimize=True)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
