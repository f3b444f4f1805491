"""Arrays into pictures: tone mapping, normal maps, error maps, light plots, contact sheets."""

import base64
import io
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib import colormaps
from matplotlib.figure import Figure
from PIL import Image, ImageDraw

from pipelines.shared.charts import light_disc
from render.records.manifest import SceneSpec
from render.records.mirror import shard_path
from render.records.shards import Shard, read_shard
from render.shared.seeds import spread_evenly
from sdps.core.intensities import grey
from sdps.photos.response import display

_PAPER = (255, 255, 255)


def tone_map(image: np.ndarray, exposure: float = 1.0) -> np.ndarray:  # (H, W, 3) uint8
    """Turn linear radiance into display values: exposure, clip, sRGB's curve."""
    return display(np.asarray(image, np.float32) * exposure)


def auto_exposure(images: np.ndarray, mask: np.ndarray) -> float:
    """Return the factor that brings the 95th percentile of the object to 0.8."""
    level = float(np.percentile(np.asarray(images, np.float32)[:, mask], 95)) if mask.any() else 0.0
    return 0.8 / max(level, 1e-6)


def normal_map(normals: np.ndarray, mask: np.ndarray) -> np.ndarray:  # (H, W, 3) uint8
    """Colour normals as (n + 1) / 2, white outside the mask."""
    scaled = np.clip(normals, -1, 1)
    scaled += 1  # in place: large maps need not be held three times
    scaled *= 127.5
    scaled += 0.5
    picture = scaled.astype(np.uint8)
    picture[~mask] = 255
    return picture


def error_map(errors: np.ndarray, limit: float = 45.0) -> np.ndarray:  # (H, W, 3) uint8
    """Colour angular errors in degrees from 0 (dark) to `limit` (yellow); NaN is white."""
    picture = (colormaps["inferno"](np.clip(np.nan_to_num(errors) / limit, 0, 1))[..., :3] * 255).astype(np.uint8)
    picture[np.isnan(errors)] = 255
    return picture


def preview_strip(shard: Shard, lights: int = 4) -> np.ndarray:  # (H, W * (1 + lights), 3) uint8
    """Lay out the normal map of a shard and some of its images side by side, under one exposure.

    Spatially-varying scenes show their material weights in the place of one image.
    """
    tiles = [normal_map(shard.normals, shard.mask)]
    if shard.weights is not None:
        tiles.append(weight_map(shard.weights, shard.mask))
    exposure = auto_exposure(shard.images, shard.mask)
    chosen = spread_evenly(range(len(shard.images)), max(1, lights + 1 - len(tiles)))
    tiles += [tone_map(shard.images[number], exposure) for number in chosen]
    return np.concatenate(tiles, axis=1)


def weight_map(weights: np.ndarray, mask: np.ndarray) -> np.ndarray:  # (H, W, 3) uint8
    """Mix one colour per material by its weight (M, H, W), white outside the mask."""
    colours = np.array([colormaps["tab10"](number % 10)[:3] for number in range(len(weights))])
    picture = (255 * np.clip(np.tensordot(np.moveaxis(weights, 0, -1), colours, 1), 0, 1) + 0.5).astype(np.uint8)
    picture[~mask] = 255
    return picture


def scale_to_height(picture: np.ndarray, side: int) -> np.ndarray:  # (h, w, 3) uint8
    """Bring a picture to a height of `side`: averaged down, or up by whole pixels where it is smaller."""
    height, width = picture.shape[:2]
    if height == side:
        return picture
    scaled = (max(1, round(width * side / height)), side)
    resample = Image.Resampling.BOX if height > side else Image.Resampling.NEAREST
    return np.asarray(Image.fromarray(picture).resize(scaled, resample))


def contact_sheet(tiles: Sequence[tuple[str, np.ndarray]], columns: int = 2, pad: int = 6) -> Image.Image:
    """Arrange captioned pictures of one size in a grid."""
    height, width = tiles[0][1].shape[:2]
    rows, caption = -(-len(tiles) // columns), 14
    cell = (width + pad, height + caption + pad)
    sheet = Image.new("RGB", (columns * cell[0] + pad, rows * cell[1] + pad), _PAPER)
    draw = ImageDraw.Draw(sheet)
    for number, (text, picture) in enumerate(tiles):
        x, y = pad + number % columns * cell[0], pad + number // columns * cell[1]
        draw.text((x, y), text, fill=(40, 40, 40))
        sheet.paste(Image.fromarray(picture), (x, y + caption))
    return sheet


def scene_sheet(scenes: Sequence[SceneSpec], folder: Path, count: int = 24) -> Image.Image:
    """Show up to `count` rendered scenes, spread evenly over the list: normals and three images each.

    Raises:
        InputError: a shard is missing or damaged.
    """
    tiles = []
    for scene in spread_evenly(scenes, count):
        shape = scene.shape if len(scene.shape) < 20 else scene.shape.split(":")[0]
        strip = preview_strip(read_shard(shard_path(folder, scene), scene), lights=3)
        tiles.append((f"{shape}, {scene.material}"[:60], strip))
    return contact_sheet(tiles, columns=min(3, len(tiles)))


def light_plot(directions: np.ndarray, intensities: np.ndarray, truth: np.ndarray | None = None) -> Figure:
    """Plot light directions (L, 3) on the unit disc, coloured by intensity over the strongest, joined to true ones.

    Args:
        directions: (L, 3).
        intensities: (L,) or (L, 3).
        truth: (L, 3) true directions, or None.
    """
    figure = Figure(figsize=(3.4, 2.8), dpi=130, layout="tight")
    axes = figure.add_subplot()
    points = light_disc(axes, directions, grey(intensities), truth)
    figure.colorbar(points, ax=axes, shrink=0.7, label="intensity / strongest")
    return figure


def data_uri(picture: np.ndarray | Image.Image | Figure, quality: int | None = None) -> str:
    """Encode a picture as a data URI, so that a page needs no other file: PNG, or JPEG when given its quality."""
    buffer = io.BytesIO()
    if quality is not None:
        Image.fromarray(np.asarray(picture)).save(buffer, format="jpeg", quality=quality, subsampling=0)
        return "data:image/jpeg;base64," + base64.b64encode(buffer.getvalue()).decode()
    if isinstance(picture, Figure):
        picture.savefig(buffer, format="png")
    else:
        image = picture if isinstance(picture, Image.Image) else Image.fromarray(picture)
        image.save(buffer, format="png", optimize=True)
    return "data:image/png;base64," + base64.b64encode(buffer.getvalue()).decode()
