"""What is found of flat things that fill the frame: reliefs with truth, nothing given and lights given.

    python -m lab.studies.flat_study --side 128 --images 12        # minutes; the table of docs/guides/infer.md
    python -m lab.studies.flat_study --depth 0.25                  # shallow ones
    python -m lab.studies.flat_study --side 96 --images 10 --sides 2   # which side is up: how often it is told, by what

A coin, a weave and brush strokes are made as heights, shaded with gloss and cast shadows, and lit from afar or by lamps
two object sizes away, which bend what is found into a bowl.
"""

import argparse
import itertools
import sys
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy import ndimage

from render.shared.imaging.vectors import unit
from render.shared.seeds import generator
from sdps.api import make_runner
from sdps.core.geometry import UNKNOWN, Capture, reach
from sdps.core.integration import integrate
from sdps.core.metrics import normal_mae
from sdps.methods.flat_things import Flatness, Wish
from sdps.refinement.trust import RefinedEstimate
from sdps.surface.relight import trace_light

_ROOM, _NOISE = 32, 0.003
_PORTRAIT = ((0.05, 0.1, 0.35, 0.05), (0.12, 0.2, 0.12, 0.03), (-0.1, -0.35, 0.2, 0.03), (0.3, 0.05, 0.08, 0.03))
KINDS = ("coin", "weave", "paint")
LAMPS: dict[str, dict[str, float]] = {
    "far": {"depth": 1.0},
    "far, raking": {"depth": 1.0, "slant": 78.0},
    "far, deep": {"depth": 2.0, "slant": 78.0},
    "at 3 sizes": {"depth": 1.0, "distance": 3.0},
    "at 1.5 sizes": {"depth": 1.0, "distance": 1.5},
}


def main(argv: Sequence[str] | None = None) -> int:
    """Print how many degrees normals are off, as found and with the mean plane facing the camera."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--side", type=int, default=128)
    parser.add_argument("--images", type=int, default=12)
    parser.add_argument("--distance", type=float, default=np.inf, help="of the lamps, in object sizes")
    parser.add_argument("--depth", type=float, default=1.0, help="what heights are multiplied with")
    parser.add_argument("--sides", type=int, default=0, help="things of each kind whose side is told, unrefined")
    args = parser.parse_args(argv)
    if args.sides:
        _count_sides(args.side, args.images, args.sides)
        return 0
    sys.stdout.write("kind   given    --flat  network  refined  answer  turned  tilt\n")
    for kind in KINDS:
        scene = photograph(kind, args.side, args.images, distance=args.distance, depth=args.depth)
        for given, wish in itertools.product(("none", "strength", "all"), ("no", "yes")):
            sys.stdout.write(f"{kind:6s} {given:8s} {wish:5s} {_judge(scene, given, wish)}\n")
            sys.stdout.flush()
    return 0


def _count_sides(side: int, images: int, each: int) -> None:
    """Print how often the network has the right side, and how often evidence tells it, for raised and hollow things."""
    mask, turn = np.ones((side, side), bool), np.array([-1, -1, 1], np.float32)
    runner = make_runner("auto", (False, False), None, None, False, images, Flatness("yes"))
    sys.stdout.write("lamps          kind   network  told right  wrong  not told\n")
    for name, settings in LAMPS.items():
        for kind in KINDS:
            counts = dict.fromkeys(("network", "right", "wrong", "not"), 0)
            for seed, depth in itertools.product(range(each), (1.0, -1.0)):
                scene = photograph(kind, side, images, seed=seed + (100 if depth < 0 else 0),
                                   **(settings | {"depth": depth * settings["depth"]}))  # fmt: skip
                found = runner.estimate(scene.images, mask, None, None, rig=UNKNOWN)
                off = [normal_mae(normals, scene.normals, mask) for normals in (found.normals, found.normals * turn)]
                told = "not" if not found.side_by else "right" if off[0] < off[1] else "wrong"
                counts[told] += 1
                counts["network"] += (off[0] < off[1]) != found.turned
            row = "  ".join(f"{counts[key]:8d}" for key in counts)
            sys.stdout.write(f"{name:14s} {kind:6s} {row}\n")
            sys.stdout.flush()


def _judge(scene: "Flat", given: str, wish: Wish) -> str:
    """Return degrees of the network's, refined and joined normals, and of these turned inside out; and the tilt."""
    mask, known = np.ones(scene.heights.shape, bool), (given == "all", given != "none")
    runner = make_runner("auto", known, None, None, None, len(scene.images), Flatness(wish))
    lights, gains = (value if there else None for value, there in zip((scene.lights, scene.gains), known, strict=True))
    found = runner.estimate(scene.images, mask, lights, gains, rig=UNKNOWN)
    assert isinstance(found, RefinedEstimate)
    turned = found.normals * np.array([-1, -1, 1], np.float32)
    answers = found.start.normals, found.refined.normals, found.normals, turned
    errors = "  ".join(f"{normal_mae(normals, scene.normals, mask):6.2f}" for normals in answers)
    return f"{errors}  {'left' if found.tilt is None else f'{found.tilt:.1f}'}"


class Flat(NamedTuple):
    """A flat thing that fills the frame, and its pictures.

    Attributes:
        images: (L, S, S, 3) float32, linear.
        normals: (S, S, 3) float32, unit, x right, y up, z to the camera; their slopes have a mean of 0.
        heights: (S, S) float32, pixels.
        lights: (L, 3) float32, directions at the middle.
        gains: (L,) float32.
    """

    images: np.ndarray
    normals: np.ndarray
    heights: np.ndarray
    lights: np.ndarray
    gains: np.ndarray


def photograph(
    kind: str, side: int = 160, count: int = 16, *, distance: float = np.inf, depth: float = 1.0, seed: int = 0,
    slant: float = 60.0,
) -> Flat:  # fmt: skip
    """Return a flat thing with its pictures.

    Args:
        kind: One of `KINDS`.
        side: S, pixels.
        count: L.
        distance: Of the lamps, in object sizes.
        depth: What heights are multiplied with; below 0 they are hollow.
        seed: Of the thing, the lights and the noise.
        slant: Largest angle between a light and the line of sight, in degrees; raking ones cast shadows.
    """
    rng, whole, inside = generator(seed, f"flat {kind}"), side + 2 * _ROOM, slice(_ROOM, _ROOM + side)
    heights, albedo, gloss, shine = _make(kind, whole, rng)
    heights = depth * heights
    row, column = np.asarray(np.gradient(heights))
    column, row = column - column[inside, inside].mean(), row - row[inside, inside].mean()
    normals = unit(np.stack([-column, row, np.ones_like(row)], axis=-1))
    azimuth = 2 * np.pi * ((np.arange(count) * 0.618 + rng.random()) % 1.0)
    across = np.sin(np.radians(rng.uniform(20.0, slant, count)))
    lights = np.stack([across * np.cos(azimuth), across * np.sin(azimuth), np.sqrt(1.0 - across**2)], axis=1)
    gains = rng.uniform(0.7, 1.3, count)
    mask = np.ones((whole, whole), bool)
    surface, every = integrate(normals.astype(np.float32), mask), np.arange(-_ROOM, side + _ROOM)
    places = Capture.of(mask[inside, inside]).place(every[:, None], every[None], heights)
    images = np.empty((count, side, side, 3), np.float32)
    for image, light, gain in zip(images, lights, gains, strict=True):
        towards, falloff = np.broadcast_to(light, normals.shape), np.ones((whole, whole))
        if np.isfinite(distance):
            flat = places.reshape(-1, 3)
            found, near = reach(flat, light[None], np.array([0.5 / distance]))
            towards, falloff = found[:, 0].reshape(normals.shape), near[:, 0].reshape(whole, whole)
        cosine = np.maximum((normals * towards).sum(-1), 0.0) * trace_light(surface, light) * falloff
        half = unit(towards + np.array([0.0, 0.0, 1.0]))
        shown = albedo + gloss * np.maximum((normals * half).sum(-1), 0.0)[..., None] ** shine
        image[:] = (gain * shown * cosine[..., None])[inside, inside] + rng.normal(0.0, _NOISE, (side, side, 3))
    part = (inside, inside)
    return Flat(np.maximum(images, 0.0), normals[part].astype(np.float32), heights[part].astype(np.float32),
                lights.astype(np.float32), gains.astype(np.float32))  # fmt: skip


def _make(kind: str, side: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, float, float]:
    """Return heights (H, H) in pixels, albedo (H, H, 3), and strength and exponent of highlights."""
    rows, columns = np.mgrid[:side, :side].astype(np.float64)
    x, y = columns / side * 2 - 1, 1 - rows / side * 2

    def blur(wide: float, tall: float | None = None) -> np.ndarray:
        noise = ndimage.gaussian_filter(rng.normal(size=(side, side)), (wide if tall is None else tall, wide))
        return noise / noise.std()

    if kind == "coin":
        radius = np.hypot(x, y)
        height = 0.04 * np.exp(-(((radius - 0.85) / 0.05) ** 2))
        for a, b, wide, high in (
            (0.05, 0.1, 0.35, 0.05),
            (0.12, 0.2, 0.12, 0.03),
            (-0.1, -0.35, 0.2, 0.03),
            (0.3, 0.05, 0.08, 0.03),
        ):
            height += high * np.exp(-((x - a) ** 2 + 0.6 * (y - b) ** 2) / wide**2)
        letters = ndimage.gaussian_filter(
            (blur(0.012 * side) > 0.6) & (abs(radius - 0.65) < 0.08), 0.006 * side, output=float
        )
        height = (height + 0.03 * letters) * side / 2 + 0.05 * blur(1.2)
        patina = 0.45 + 0.08 * blur(0.05 * side)[..., None] * np.ones(3)
        return height, np.clip(patina * (1.0, 0.85, 0.6), 0.05, 1.0), 0.35, 25.0
    if kind == "weave":
        period = side / 14
        warp, weft = columns / period, rows / period
        over = np.where((np.floor(warp) + np.floor(weft)) % 2 == 0, 1.0, -1.0)
        across, down = np.abs(np.sin(np.pi * warp)), np.abs(np.sin(np.pi * weft))
        threads = np.maximum(across**0.5 * (1 + over * down), down**0.5 * (1 - over * across))
        height = (
            ndimage.gaussian_filter(0.09 * period * threads, 0.1 * period)
            + 0.15 * blur(1.0)
            + 0.004 * side * blur(side / 12)
        )
        colour = np.where((over > 0)[..., None], (0.55, 0.2, 0.15), (0.3, 0.35, 0.5)) * (
            1 + 0.06 * blur(1.0)[..., None]
        )
        return height, np.clip(colour, 0.02, 1.0), 0.05, 8.0
    turn = ndimage.rotate(blur(0.06 * side, 1.3), 25, reshape=False, mode="wrap")
    patch = blur(0.08 * side) > 0
    height = 0.9 * np.where(patch, turn, blur(1.3, 0.06 * side)) + 0.012 * side * np.abs(blur(0.05 * side))
    height = ndimage.gaussian_filter(height, 0.8)
    colours = rng.uniform(0.08, 0.8, (4, 3))
    which = (blur(0.07 * side) > 0).astype(int) + 2 * patch
    return height, colours[which] * (1 + 0.08 * blur(2.0)[..., None]), 0.12, 40.0


if __name__ == "__main__":
    sys.exit(main())
