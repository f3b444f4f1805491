"""Traced pictures of a matte object with chrome and white balls beside it, under lamps that are known."""

from collections.abc import Sequence

import cv2
import numpy as np

SHAPE, FOCAL = (180, 260), 520.0
OBJECT = (-45.0, 0.0, 45.0)
TURNS = np.linspace(0.0, 2.0 * np.pi, 10, endpoint=False)
SLOPES = np.radians(np.tile([28.0, 45.0], 5))
LIGHTS = np.stack([np.sin(SLOPES) * np.cos(TURNS), np.sin(SLOPES) * np.sin(TURNS), np.cos(SLOPES)], axis=1)
GAINS = 0.6 + 0.04 * np.arange(10)


def hit(ball: Sequence[float], focal: float = np.inf):
    """Return points, normals and sights of every pixel that shows a ball (x, y, radius), and which do; z is 0, or a
    fourth number.
    """
    middle = np.array([ball[0], ball[1], *(ball[3:] or (0.0,))])
    rows, columns = np.mgrid[: SHAPE[0], : SHAPE[1]].astype(float)
    at = np.stack([columns - (SHAPE[1] - 1) / 2, (SHAPE[0] - 1) / 2 - rows, np.zeros(SHAPE)], -1)
    eye = np.array([0.0, 0.0, focal])
    sight = (eye - at) if np.isfinite(focal) else np.broadcast_to([0.0, 0.0, 1.0], at.shape)
    sight = sight / np.linalg.norm(sight, axis=-1, keepdims=True)
    off = at - middle
    along = -(off * sight).sum(-1)
    inside = ball[2] ** 2 - (off**2).sum(-1) + along**2
    points = at + (along + np.sqrt(np.maximum(inside, 0.0)))[..., None] * sight
    return points, (points - middle) / ball[2], sight, inside > 0


def to_lamp(points, lamp):
    """Return unit directions to a lamp: a position, or a direction if it is unit."""
    to = np.broadcast_to(lamp, points.shape) if abs(np.linalg.norm(lamp) - 1.0) < 1e-6 else lamp - points
    return to / np.linalg.norm(to, axis=-1, keepdims=True)


def paint(lamp, gain, focal=np.inf, chrome=(), white=()):
    """Return a picture (H, W) of a matte object, with balls beside it."""
    image = np.full(SHAPE, 0.004)
    for ball in (OBJECT, *white):
        points, normals, _, shown = hit(ball, focal)
        lit = np.maximum((normals * to_lamp(points, lamp)).sum(-1), 0.0)
        if np.linalg.norm(lamp) > 1.001:  # its light falls off with the square of the distance
            lit *= ((np.array(lamp) - [OBJECT[0], OBJECT[1], 0.0]) ** 2).sum() / ((lamp - points) ** 2).sum(-1)
        image[shown] = 0.7 * gain * lit[shown]
    for ball in chrome:
        points, normals, sight, shown = hit(ball, focal)
        mirrored = 2.0 * (normals * sight).sum(-1, keepdims=True) * normals - sight
        lobe = (mirrored * to_lamp(points, lamp)).sum(-1)
        room = 0.03 + 0.25 * ((mirrored * [-0.6, 0.6, 0.52]).sum(-1) > 0.985)  # a window that stays
        image[shown] = (room + 1.5 * np.exp(600.0 * (lobe - 1.0)))[shown]
    return cv2.GaussianBlur(image, (0, 0), 0.7)


def write(folder, images, mask=None):
    folder.mkdir(exist_ok=True)
    for number, image in enumerate(images):
        grey = (np.clip(image, 0.0, 1.0) * 65535).astype(np.uint16)
        cv2.imwrite(str(folder / f"p{number:02d}.png"), np.repeat(grey[..., None], 3, -1))
    if mask is not None:
        cv2.imwrite(str(folder / "mask.png"), mask.astype(np.uint8) * 255)
    return folder


def flag(ball, focal=np.inf):
    """Return the circle that one draws around a ball: the bounding box of what shows it."""
    shown = hit(ball, focal)[3]
    rows, columns = np.nonzero(shown)
    radius = (np.ptp(rows) + np.ptp(columns) + 2) / 4
    return f"{(columns.min() + columns.max()) / 2},{(rows.min() + rows.max()) / 2},{radius}"
