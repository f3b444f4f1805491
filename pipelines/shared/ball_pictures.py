"""Pictures of the balls that gave the lights: their circles, and their highlights."""

from collections.abc import Sequence

import numpy as np
from PIL import Image, ImageDraw

from sdps.photos.analysis.balls.ball_scene import FoundBall
from sdps.photos.response import display

_SIDE = 360  # least side of a ball's picture
_LINE = (0, 200, 120)
_MARK = (255, 60, 60)


def draw_ball(ball: FoundBall) -> tuple[str, np.ndarray]:
    """Return a caption, and the picture (h, w, 3) uint8 of a ball under all lights with its circle and highlights."""
    left, top, step = ball.window
    lamps = int(np.isfinite(ball.highlights[:, 0]).sum())
    by = f"{lamps} highlights" if lamps else "its shading"
    level = float(np.percentile(ball.seen, 50 if lamps else 99))
    shown = Image.fromarray(display(ball.seen * (0.05 if lamps else 0.8) / max(level, 0.01)))
    zoom = max(1.0, _SIDE / max(shown.size))
    shown = shown.resize((round(shown.width * zoom), round(shown.height * zoom)), Image.Resampling.BICUBIC)
    pen, factor = ImageDraw.Draw(shown), zoom / step
    x, y = (
        (side - start) * factor + (zoom - 1.0) / 2 for side, start in zip(ball.circle[:2], (left, top), strict=True)
    )
    _circle(pen, x, y, ball.circle.radius * factor, 2)
    for place in ball.highlights[np.isfinite(ball.highlights[:, 0])]:
        column, row = (place - [left, top]) * factor + (zoom - 1.0) / 2
        pen.line([column - 4, row, column + 4, row], _MARK)
        pen.line([column, row - 4, column, row + 4], _MARK)
    return f"{ball.text}: {by}", np.asarray(shown)


def draw_circles(picture: np.ndarray, balls: Sequence[FoundBall], factor: float) -> np.ndarray:  # (h, w, 3) uint8
    """Draw the balls that lie in a photograph.

    Args:
        picture: (h, w, 3) uint8.
        balls: Those in the pictures and others.
        factor: Its pixels per pixel of the files.
    """
    shown = Image.fromarray(picture)
    pen = ImageDraw.Draw(shown)
    for ball in (ball for ball in balls if ball.folder is None):
        x, y = ((side + 0.5) * factor - 0.5 for side in ball.circle[:2])
        _circle(pen, x, y, ball.circle.radius * factor, max(1, max(shown.size) // 400))
    return np.asarray(shown)


def _circle(pen: ImageDraw.ImageDraw, x: float, y: float, radius: float, width: int) -> None:
    pen.ellipse([x - radius, y - radius, x + radius, y + radius], outline=_LINE, width=width)
