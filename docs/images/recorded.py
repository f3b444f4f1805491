r"""Draws docs/images/mixed_light.jpg and cameras.jpg from two scenes under a light stage.

sdps regenerate --shapes bunny --materials white-paint,gold-metallic-paint --light-set stage:256 \
    --set test.size=160 --set test.spp=64 --out out/stage
python docs/images/recorded.py out/stage
"""

import sys
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from render.records.manifest import read_manifest
from render.records.shards import read_shard
from render.shared.imaging import environments
from render.shared.imaging.mixing import LightStage, mix
from render.shared.imaging.sensor import Sensor, to_srgb
from render.shared.seeds import generator

MAPS = ("sky-sun:4", "studio:1", "room:0", "gradient:2", "constant")
CAMERAS = {
    "as rendered": None,
    "DSLR, ISO 100, 12 bits": Sensor(full_well=67700, read_noise=15, bits=12, black_level=128),
    "DSLR, ISO 6400, -1 stop": Sensor(stops=-1, full_well=1090, read_noise=2.5, bits=12, black_level=128),
    "8 bits, +2 stops": Sensor(stops=2, full_well=7000, read_noise=8, bits=8),
    "24 degrees, blur 1.5, ambient 5 %": Sensor(field_angle=24, blur=1.5, ambient=0.05, bits=16),
    "JPEG, quality 30": Sensor(full_well=30000, read_noise=3, bits=12, jpeg_quality=30),
}
GAP, TOP, INK, PAPER = 8, 22, (40, 40, 48), (255, 255, 255)


def tile(linear: np.ndarray, width: int, height: int) -> Image.Image:
    pixels = np.rint(255 * to_srgb(linear)).astype(np.uint8)
    return Image.fromarray(pixels).resize((width, height), Image.Resampling.BICUBIC)


def sheet(columns: list[tuple[str, list[Image.Image]]], out: Path) -> None:
    """Lay named columns of tiles out side by side."""
    width = max(part.width for _, parts in columns for part in parts)
    height = TOP + max(sum(part.height + GAP for part in parts) for _, parts in columns)
    page = Image.new("RGB", (len(columns) * (width + GAP) + GAP, height), PAPER)
    draw, font = ImageDraw.Draw(page), ImageFont.load_default(13)
    for number, (name, parts) in enumerate(columns):
        left, top = GAP + number * (width + GAP), TOP
        draw.text((left, 4), name, fill=INK, font=font)
        for part in parts:
            page.paste(part, (left, top))
            top += part.height + GAP
    page.save(out, quality=85)


def main(folder: Path, out: Path) -> None:
    scenes = read_manifest(folder)[:2]
    shards = [read_shard(folder / scene.file, scene) for scene in scenes]
    stage = LightStage(scenes[0].light_directions(), str(folder))
    columns = []
    for name in MAPS:
        radiance = environments.load(name)
        parts = [tile(radiance * 0.6, 230, 115)]
        for shard in shards:
            images = shard.images.reshape(len(shard.images), -1, 3)
            found = mix(images, stage.under(radiance)[None])[0].reshape(*shard.mask.shape, 3)
            parts.append(tile(found * 0.55 / np.quantile(found[shard.mask], 0.9), 230, 230))
        columns.append((name, parts))
    sheet(columns, out / "mixed_light.jpg")
    shard, columns = shards[1], []
    number = int((stage.directions @ [-0.5, 0.5, 0.7]).argmax())
    image = shard.images[number : number + 1].astype(np.float32)
    image *= 0.3 / image[:, shard.mask].mean()
    for name, camera in CAMERAS.items():
        found = image if camera is None else camera.record(image, generator(0, "picture"))
        rows, columns_ = np.nonzero(shard.mask)
        centre = int(rows.mean()), int(columns_.mean())
        window = found[0, centre[0] - 24 : centre[0] + 24, centre[1] - 24 : centre[1] + 24]
        columns.append((name, [tile(found[0], 216, 216), tile(window, 216, 216)]))
    sheet(columns, out / "cameras.jpg")


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(__file__).parent)
