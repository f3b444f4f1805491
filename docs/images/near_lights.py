"""The picture of docs/guides/render-data.md: the same object under distant and near lights, seen by both cameras.

python docs/images/near_lights.py
"""

from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw, ImageFont

import render
from sdps.photos.response import display

SIDE, TOP, GAP = 256, 40, 8
LIGHT = np.array([[-0.5, 0.4, 0.75]])
CAMERAS = {"orthographic": None, "perspective, 2.2 away": 2.2}
LIGHTS = {"distant light": None, "near light, 1.5 away": 1.5}


def main() -> None:
    columns = [(camera, light) for light in LIGHTS for camera in CAMERAS]
    sheet = Image.new("RGB", (len(columns) * (SIDE + GAP) - GAP, SIDE + TOP), (255, 255, 255))
    draw, font = ImageDraw.Draw(sheet), ImageFont.load_default(13)
    for number, (camera, light) in enumerate(columns):
        view = render.render_view(
            "bunny", "white-acrylic", LIGHT, size=SIDE, spp=64, scale=0.9, camera_distance=CAMERAS[camera],
            light_distance=LIGHTS[light],
        )  # fmt: skip
        x = number * (SIDE + GAP)
        sheet.paste(Image.fromarray(display(1.2 * view.images[0])), (x, TOP))
        draw.text(
            (x + SIDE / 2, TOP / 2), f"{light},\n{camera}", fill=(40, 40, 48), font=font, anchor="mm", align="center"
        )
    sheet.save(Path(__file__).with_suffix(".jpg"), quality=88)


if __name__ == "__main__":
    main()
