"""Environment maps: radiance from every direction, built in or from `.hdr` and `.exr` files.

A map is a latitude-longitude picture (H, 2H, 3) float32 of linear radiance, as OpenEXR defines it (`ImfEnvmap.h`), in
the camera's frame (x right, y up, z to the camera): the top row is up (+y), the bottom row down; the middle column is
+z, from the object to the camera; a quarter of the width from the left is +x, three quarters is -x, both edges are -z,
behind the object. So it is what somebody sees who stands at the object and looks at the camera. Mitsuba's `envmap`
places maps alike.
"""

import re
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np

from render.shared.decoding import check_unpacked, decoding, silence
from render.shared.errors import InputError, unknown
from render.shared.files import read_bytes
from render.shared.imaging.exr_colours import read_exr_colours
from render.shared.seeds import generator

HEIGHT = 64  # rows of built-in maps
LARGEST = 256  # rows that maps of files are shrunk to
SUFFIXES = (".hdr", ".exr")
_SKY, _GROUND = np.array([0.45, 0.65, 1.0]), np.array([0.30, 0.26, 0.20])


def directions(height: int) -> np.ndarray:  # (H, 2H, 3) float64
    """Return the unit vector to the centre of each pixel."""
    polar = np.pi * (np.arange(height) + 0.5) / height  # from +y
    longitude = np.pi * (1.0 - (np.arange(2 * height) + 0.5) / height)  # from +z to +x
    sine, column = np.sin(polar)[:, None], np.ones((height, 2 * height))
    return np.stack([sine * np.sin(longitude), np.cos(polar)[:, None] * column, sine * np.cos(longitude)], axis=-1)


def solid_angles(height: int) -> np.ndarray:  # (H, 1) float64
    """Return the steradians of a pixel of each row; all pixels together have 4 pi."""
    edges = np.cos(np.pi * np.arange(height + 1) / height)
    return (np.pi / height * (edges[:-1] - edges[1:]))[:, None]


def turn(radiance: np.ndarray, degrees: float) -> np.ndarray:
    """Return the map turned about the vertical y axis, counter-clockwise as seen from above (+z moves to +x).

    The angle is rounded to a whole number of columns.
    """
    return np.roll(radiance, -round(degrees / 360 * radiance.shape[1]), axis=1)


def load(name: str) -> np.ndarray:  # (H, 2H, 3) float32
    """Return a built-in map by name, `sky-sun` or with a seed `sky-sun:7`, or read a file.

    Built-in maps are scaled so that white Lambertian facing the camera has radiance 1; those of files are as they are.

    Raises:
        InputError: an unknown name, or a file that is not a map: not twice as wide as high, negative, infinite or NaN.
    """
    require_name(name)
    if is_file(name):
        return _check(_read(Path(name)), name)
    kind, _, seed = name.partition(":")
    vectors = directions(HEIGHT)
    radiance = BUILT_IN[kind](vectors, generator(int(seed or 0), "environment", kind))
    facing = np.maximum(vectors[..., 2], 0.0) * solid_angles(HEIGHT) / np.pi
    return (radiance / (radiance.mean(-1) * facing).sum()).astype(np.float32)


def is_file(name: str) -> bool:
    """Return whether a name is that of an .hdr or .exr file."""
    return Path(name).suffix.lower() in SUFFIXES


def require_name(name: str) -> None:
    """Refuse what is neither a built-in map's name nor a file's; the file is not looked at.

    Raises:
        InputError: with the nearest name.
    """
    kind, colon, seed = name.partition(":")
    if not is_file(name) and (kind not in BUILT_IN or (colon and not (seed.isascii() and seed.isdecimal()))):
        raise unknown("environment", name, BUILT_IN, "or give an .hdr or .exr file; a seed follows a colon: sky-sun:7")


def constant(vectors: np.ndarray, _: np.random.Generator) -> np.ndarray:
    """Return the same radiance from everywhere."""
    return np.ones_like(vectors)


def gradient(vectors: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return two colours that change into each other along a random direction."""
    axis = _somewhere(rng, -0.2)
    share = (vectors @ axis)[..., None] / 2 + 0.5
    first, second = (_tint(rng, 0.3) * strength for strength in (1.0, rng.uniform(0.05, 0.3)))
    return share * first + (1 - share) * second


def sky_sun(vectors: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return a blue sky that is brighter at the horizon, a sun in front of the object, and brown ground.

    The sun gives 3 to 8 times the sky's light. Haze spreads it over about 2 degrees, since a map of 64 rows has no room
    for the true half degree.
    """
    up = vectors[..., 1:2]
    sky = _SKY * (1.0 - 0.6 * np.clip(up, 0, 1)) + 0.25 * np.exp(-6 * np.clip(up, 0, 1))
    ground = _GROUND * rng.uniform(0.3, 0.8) * np.ones_like(vectors)
    height, side = np.radians(rng.uniform(15, 65)), np.radians(rng.uniform(-75, 75))
    sun = np.array([np.cos(height) * np.sin(side), np.sin(height), np.cos(height) * np.cos(side)])
    colour = np.array([1.0, 0.75 + 0.2 * np.sin(height), 0.5 + 0.4 * np.sin(height)])
    strength = rng.uniform(3.0, 8.0) * np.pi  # the sky's irradiance is about pi
    return np.where(up > 0, sky, ground) + _lamp(vectors, sun, 2.0)[..., None] * colour * strength


def studio(vectors: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return two to four soft boxes in a dark room: evenly bright rectangles, 15 to 50 degrees wide and high."""
    radiance = np.full_like(vectors, 0.02)
    for _ in range(int(rng.integers(2, 5))):
        centre = _somewhere(rng, 0.1)
        right = np.cross([0.0, 1.0, 0.0], centre)
        right /= max(float(np.linalg.norm(right)), 1e-6)
        across, along = vectors @ right, vectors @ np.cross(centre, right)
        width, height = np.sin(np.radians(rng.uniform(15, 50, 2) / 2))
        inside = (np.abs(across) < width) & (np.abs(along) < height) & (vectors @ centre > 0)
        radiance[inside] += _tint(rng, 0.15) * rng.uniform(2.0, 10.0)
    return radiance


def room(vectors: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return a box-shaped room around the object: coloured walls, bright ceiling lamps, a window in one wall."""
    half = rng.uniform([1.5, 1.1, 1.5], [4.0, 1.6, 4.0])
    steps = half / np.maximum(np.abs(vectors), 1e-9)
    wall = steps.argmin(-1)  # the axis of the wall that is met first
    place = vectors * steps.min(-1, keepdims=True)
    colours = np.stack([_tint(rng, 0.4) * rng.uniform(0.15, 0.5) for _ in range(6)])
    side = np.take_along_axis(vectors, wall[..., None], -1)[..., 0] > 0
    radiance = colours[2 * wall + side] * 0.3
    lamp = (
        (wall == 1) & side & (np.abs(np.mod(place[..., 0], 1.2) - 0.6) < 0.25) & (np.abs(place[..., 2]) < half[2] / 2)
    )
    radiance[lamp] = np.array([1.0, 0.93, 0.82]) * rng.uniform(6.0, 15.0)
    across = int(rng.choice([0, 2]))
    opening = rng.uniform(-0.5, 0.5)
    window = (wall == across) & (side if across == 2 else side == (rng.random() < 0.5))
    window &= (np.abs(place[..., 2 - across] - opening) < 0.7) & (np.abs(place[..., 1]) < 0.7)
    radiance[window] = _SKY * rng.uniform(4.0, 12.0)
    return radiance


BUILT_IN: dict[str, Callable[[np.ndarray, np.random.Generator], np.ndarray]] = {
    "constant": constant,
    "gradient": gradient,
    "sky-sun": sky_sun,
    "studio": studio,
    "room": room,
}


def _somewhere(rng: np.random.Generator, lowest: float) -> np.ndarray:  # (3,)
    """Draw a direction with z above `lowest`, uniform in solid angle."""
    z, turn = rng.uniform(lowest, 1.0), rng.uniform(0.0, 2.0 * np.pi)
    flat = np.sqrt(1.0 - z * z)
    return np.array([flat * np.cos(turn), flat * np.sin(turn), z])


def _tint(rng: np.random.Generator, most: float) -> np.ndarray:  # (3,)
    return 1.0 - rng.uniform(0.0, most, 3)


def _lamp(vectors: np.ndarray, centre: np.ndarray, degrees: float) -> np.ndarray:  # (...)
    """Return a Gaussian spot of `degrees` standard deviation whose integral over the sphere is 1 steradian-radiance."""
    sigma = np.radians(degrees)
    return np.exp((vectors @ centre - 1.0) / sigma**2) / (2.0 * np.pi * sigma**2)


def _read(path: Path) -> np.ndarray:
    """Read an .hdr (Radiance) or .exr picture as (H, W, 3)."""
    data = read_bytes(path, "no such environment map; give an .hdr or .exr file, or a built-in name")
    if path.suffix.lower() == ".hdr":
        size = re.search(rb"-Y ([0-9]{1,9}) \+X ([0-9]{1,9})", data[:4096]) if data[:2] == b"#?" else None
        pixels = None
        with decoding(path, "a Radiance picture", "save it as .hdr or .exr again"):
            if size:
                check_unpacked(path, 12 * int(size[1]) * int(size[2]), "its pixels")
                with silence():
                    pixels = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
        if pixels is None or pixels.ndim != 3:
            raise InputError(f"{path}: damaged or not a Radiance picture; save it as .hdr or .exr again")
        return pixels[..., ::-1]
    pixels = read_exr_colours(path, "save it as .hdr or .exr again").pixels
    if pixels.shape[2] != 3:
        raise InputError(f"{path}: is grey; an environment map needs R, G and B")
    return pixels


def _check(pixels: np.ndarray, name: str) -> np.ndarray:
    """Refuse what is not a map; shrink a large one, keeping its light."""
    height, width = pixels.shape[:2]
    if width != 2 * height:
        raise InputError(f"{name}: is {width}x{height}; a latitude-longitude map is twice as wide as high")
    if not np.isfinite(pixels).all() or pixels.min() < 0:
        row, column = np.argwhere(~(np.isfinite(pixels) & (pixels >= 0)).all(-1))[0]
        raise InputError(f"{name}: NaN, infinite or negative at column {column}, row {row}; repair the picture")
    if not pixels.max() > 0:
        raise InputError(f"{name}: is black; give a map with light in it")
    if height > LARGEST:
        pixels = cv2.resize(pixels.astype(np.float32), (2 * LARGEST, LARGEST), interpolation=cv2.INTER_AREA)
    return np.ascontiguousarray(pixels, np.float32)
