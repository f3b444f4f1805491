"""The picture of docs/guides/infer.md: what near lamps cost where they are taken for distant, and once they are found.

python docs/images/near_far.py
"""

from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw, ImageFont

import sdps
from pipelines.shared import pictures
from render.api import render_views
from render.planning.light_sets import draw
from sdps.core.geometry import Rig
from sdps.core.metrics import angle_degrees
from sdps.refinement.refine import refine

SIDE, TOP, GAP, YELLOW = 200, 36, 6, 20.0
SCENES = (("bunny", "white-paint", 5.0), ("blobby:990013", "gold-paint", 3.0))


def main() -> None:
    lights = draw("hand-held", 40, np.random.default_rng(5))
    heads = ["a photograph", "lamps taken\nfor distant", "lamps found"]
    sheet = Image.new("RGB", (3 * (SIDE + GAP) - GAP, len(SCENES) * (SIDE + TOP)), (255, 255, 255))
    ink, font = ImageDraw.Draw(sheet), ImageFont.load_default(13)
    for row, (shape, material, distance) in enumerate(SCENES):
        options = {"size": 128, "spp": 64, "scale": 0.9, "light_distance": distance}
        (view,) = render_views(shape, [material], lights, **options)
        mask, images = np.asarray(view.mask), np.asarray(view.images, np.float32)
        begun = sdps.estimate(images, mask, "sdps-frames")
        lit = images[int(np.argmax(lights @ [-0.4, 0.4, 0.8]))]
        tiles, texts = [pictures.tone_map(lit, pictures.auto_exposure(images, mask))], [heads[0]]
        for head, rig in zip(heads[1:], (Rig(nearness=np.zeros(40)), Rig()), strict=True):
            found = refine(images, mask, begun.normals, begun.light_directions, begun.intensities, rig=rig)
            off = np.where(mask, angle_degrees(found.normals, np.asarray(view.normals)), np.nan)
            tiles.append(pictures.error_map(off, YELLOW))
            texts.append(f"{head}: {np.nanmean(off):.1f} degrees")
        for column, (tile, text) in enumerate(zip(tiles, texts, strict=True)):
            corner = column * (SIDE + GAP), row * (SIDE + TOP) + TOP
            sheet.paste(Image.fromarray(pictures.scale_to_height(tile, SIDE)), corner)
            middle = (corner[0] + SIDE / 2, corner[1] - TOP / 2)
            ink.text(middle, text, fill=(40, 40, 48), font=font, anchor="mm", align="center")
    sheet.save(Path(__file__).with_suffix(".jpg"), quality=88)


if __name__ == "__main__":
    main()
