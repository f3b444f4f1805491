"""The picture of the README, from an inference and a data folder.

sdps infer --self-test --out out/self-test
sdps render-data --preset demo --out out/demo
python docs/images/hero.py out/self-test out/demo/data
"""

import json
import sys
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from render.records.manifest import read_manifest
from render.records.shards import read_shard
from render.shared.images import read_image
from sdps.core.integration import integrate
from sdps.photos.response import display
from sdps.surface.views import turned

WIDTH, SIDE, TOP, MARGIN = 1200, 234, 34, 14
TILES, GAP = 12, 6
TILE = (WIDTH - 2 * MARGIN + GAP) // TILES - GAP
EXPOSURE = 2.0
INK, PAPER = (40, 40, 48), (255, 255, 255)


def photographs(folder: Path, rows: int, columns: int) -> Image.Image:
    files = sorted(path for path in folder.glob("*.png") if path.stem.isdigit())
    chosen = [files[k] for k in np.linspace(0, len(files) - 1, rows * columns).astype(int)]
    mask = read_image(folder / "mask.png", channels=None) > 0
    box = [int(edge) for axis in (1, 0) for edge in np.flatnonzero(mask.any(axis=axis))[[0, -1]]]
    middle, half = ((box[0] + box[1]) // 2, (box[2] + box[3]) // 2), max(box[1] - box[0], box[3] - box[2]) * 27 // 50
    side = SIDE // rows
    sheet = Image.new("RGB", (columns * side, rows * side))
    for place, file in enumerate(chosen):
        values = read_image(file)[
            max(middle[0] - half, 0) : middle[0] + half, max(middle[1] - half, 0) : middle[1] + half
        ]
        picture = Image.fromarray(display(np.clip(values.astype(np.float32) / 65535 * EXPOSURE, 0, 1)))
        fitted = picture.resize((side, side), Image.Resampling.LANCZOS)
        sheet.paste(fitted, (place % columns * side, place // columns * side))
    return sheet


def light_disc(found: np.ndarray, true: np.ndarray) -> Image.Image:
    scale = 3
    size, radius = SIDE * scale, SIDE * scale * 0.46
    picture = Image.new("RGB", (size, size), PAPER)
    draw = ImageDraw.Draw(picture)

    def at(light: np.ndarray) -> tuple[float, float]:
        return size / 2 + radius * light[0], size / 2 - radius * light[1]

    draw.ellipse(
        [size / 2 - radius, size / 2 - radius, size / 2 + radius, size / 2 + radius], outline=(150, 150, 160), width=4
    )
    for one, other in zip(found, true, strict=True):
        draw.line([at(one), at(other)], fill=(170, 170, 180), width=4)
    for lights, colour in ((true, (150, 150, 160)), (found, (224, 138, 0))):
        for x, y in map(at, lights):
            draw.ellipse([x - 10, y - 10, x + 10, y + 10], fill=colour)
    return picture.resize((SIDE, SIDE), Image.Resampling.LANCZOS)


def normal_picture(normals: np.ndarray) -> np.ndarray:
    inside = np.linalg.norm(normals, axis=-1, keepdims=True) > 0.5
    return np.where(inside, (normals + 1) / 2 * 255, 255).astype(np.uint8)


def training_tiles(folder: Path, count: int, seed: int = 3) -> list[Image.Image]:
    scenes = read_manifest(folder)
    rng = np.random.default_rng(seed)
    tiles = []
    for place in rng.permutation(len(scenes)):
        shard = read_shard(folder / scenes[place].file, scenes[place])
        if not 0.25 < shard.mask.mean() < 0.95:
            continue
        light = int(rng.choice(np.flatnonzero(shard.light_directions[:, 2] > 0.6)))
        image = shard.images[light].astype(np.float32)
        tiles.append(Image.fromarray(display(np.clip(image / max(np.percentile(image[shard.mask], 97), 1e-6), 0, 1))))
        if len(tiles) == count:
            break
    return tiles


def main(infer: Path, data: Path) -> None:
    folder = infer / "photographs"
    truth = json.loads((folder / "truth" / "lights.json").read_text())
    found = json.loads((infer / "lights.json").read_text())["images"]
    normals = np.load(infer / "normal.npy")
    depth = integrate(normals, np.linalg.norm(normals, axis=-1) > 0.5)
    panels = [
        ("photographs under a moving lamp", photographs(folder, 3, 4)),
        ("lights found (true: grey)",
         light_disc(np.array([light["direction"] for light in found]), np.array(truth["directions"]))),
        ("normals", Image.fromarray(normal_picture(normals)).resize((SIDE, SIDE), Image.Resampling.LANCZOS)),
        ("mesh, seen from the side", Image.fromarray(turned(depth, 40.0, SIDE))),
    ]  # fmt: skip
    font = ImageFont.load_default(15)
    height = MARGIN + TOP + SIDE + TOP + 2 * (TILE + GAP) + MARGIN
    page = Image.new("RGB", (WIDTH, height), PAPER)
    draw = ImageDraw.Draw(page)
    spare = WIDTH - 2 * MARGIN - sum(panel.width for _, panel in panels)
    x = MARGIN
    for title, panel in panels:
        draw.text((x, MARGIN), title, fill=INK, font=font)
        page.paste(panel, (x, MARGIN + TOP - 6))
        x += panel.width + spare // (len(panels) - 1)
    below = MARGIN + TOP + SIDE + TOP
    draw.text((MARGIN, below - 26), "rendered scenes the networks learn from", fill=INK, font=font)
    for place, tile in enumerate(training_tiles(data, 2 * TILES)):
        row, column = divmod(place, TILES)
        fitted = tile.resize((TILE, TILE), Image.Resampling.LANCZOS)
        page.paste(fitted, (MARGIN + column * (TILE + GAP), below + row * (TILE + GAP)))
    page.save(Path(__file__).with_name("hero.jpg"), quality=86, optimize=True)


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
