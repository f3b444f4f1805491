"""How well lights that are given are checked and completed: lights made wrong on purpose, and intensities left out.

    python -m lab.studies.given_lights out/given --every 8 --diligent DiLiGenT/pmsData --uw psmImages

The first folder is one of `sdps regenerate`. Of the University of Washington's set it takes folders with *.mask.tga and
the lights.txt above them. What it prints stands in docs/studies/checks-trust.md.
"""

import argparse
import sys
from collections import defaultdict
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from PIL import Image
from scipy.ndimage import gaussian_filter

import sdps
from render.records.shards import read_shard
from render.shared.imaging.vectors import half_vectors
from render.shared.seeds import generator
from sdps.methods.given_lights import AXES, LightFit, compare_lights, find_intensities, reduce_images
from sdps.methods.light_witness import see_lights
from sdps.methods.pretrained import require


class Scene(NamedTuple):
    """Images (L, H, W, 3), mask, true directions (L, 3) and intensities (L,) or None."""

    kind: str
    images: np.ndarray
    mask: np.ndarray
    lights: np.ndarray
    intensities: np.ndarray | None


def main(argv: Sequence[str] | None = None) -> int:
    """Print what became of right and of wrong lights, and the errors of intensities."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--every", type=int, default=1, help="take every so many shards")
    parser.add_argument("--diligent", type=Path, default=None)
    parser.add_argument("--uw", type=Path, default=None)
    args = parser.parse_args(argv)
    counts: dict[tuple[str, str], list[float]] = defaultdict(list)
    for number, scene in enumerate(_scenes(args)):
        _judge(scene, number, counts)
    for (kind, what), values in sorted(counts.items()):
        sys.stdout.write(f"{kind:12s} {what:28s} {np.mean(values):.3f} of {len(values)}\n")
    return 0


def _judge(scene: Scene, number: int, counts: dict[tuple[str, str], list[float]]) -> None:
    seen = see_lights(scene.images, scene.mask, require)
    assert seen is not None
    reduced = reduce_images(scene.images, scene.mask)
    lights, count = scene.lights.astype(np.float64), len(scene.lights)
    files = [f"p{place}.png" for place in range(1, count + 1)]
    found = find_intensities(reduced, lights, seen.intensities)
    if scene.intensities is not None:
        true = scene.intensities / scene.intensities.mean()
        for what, values in (("network", seen.intensities), ("corrected", found), ("equal", np.ones(count))):
            counts[scene.kind, f"intensities, {what}"].append(float(np.abs(values / np.mean(values) - true).mean()))

    def fit(in_file: np.ndarray, rows: Sequence[int]) -> LightFit:
        return compare_lights(reduced, files, in_file[rows], found[rows], seen.light_directions)

    plain = list(range(count))
    counts[scene.kind, "right, left alone"].append(fit(lights, plain).better is None)
    for place in range(1, 8):
        result = fit(lights @ AXES[place], plain)
        right = result.better is not None and any((result.better.axes == axes).all() for axes in _twins(place, result))
        what = "half turn" if place == 3 else "axes"
        counts[scene.kind, f"{what}, found"].append(right)
    if count >= 12:
        orders = {"sorted": sorted(files), "other": list(generator(number, "rows").permutation(files))}
        for sorting, names in orders.items():
            better = fit(lights, [files.index(name) for name in names]).better
            counts[scene.kind, f"rows {sorting}, found"].append(better is not None and better.sorting == sorting)


def _twins(place: int, result: LightFit) -> list[np.ndarray]:
    """Return the readings that count as found: where a half turn is open, both are named."""
    return [AXES[place]] if result.sure else [AXES[place], AXES[3] @ AXES[place]]


def _scenes(args: argparse.Namespace) -> Iterator[Scene]:
    draw = generator(0, "given lights study")
    for path in sorted((args.folder / "shards").glob("*.exr"))[:: args.every]:
        shard = read_shard(path)
        count = min(int(draw.choice([4, 6, 8, 12, 24])), len(shard.images))
        some = np.sort(draw.permutation(len(shard.images))[:count])
        gains = draw.uniform(0.7, 1.4, count).astype(np.float32)
        lit = shard.images[some] * gains[:, None, None, None]
        yield Scene("rendered", lit, shard.mask, shard.light_directions[some], gains)
    for folder in sorted(args.diligent.glob("*PNG")) if args.diligent else ():
        photos = sdps.load(folder, lights="folder", gamma="linear")
        assert photos.light_directions is not None and photos.intensities is not None
        for count in (96, 20, 8):
            some = np.sort(draw.permutation(len(photos))[:count])
            lit = np.concatenate([photos[int(number) : int(number) + 1] for number in some])
            yield Scene("DiLiGenT", lit, photos.mask, photos.light_directions[some], photos.intensities[some].mean(1))
    if args.uw:
        lights = np.loadtxt(args.uw / "lights.txt", skiprows=1).astype(np.float32)
        for path in sorted(args.uw.glob("*/*.mask.*")):
            name = path.name.split(".")[0]
            files = [path.with_name(f"{name}.{number}{path.suffix}") for number in range(len(lights))]
            if name != "chrome" and all(file.is_file() for file in files):
                lit = np.stack([np.asarray(Image.open(file).convert("RGB"), np.float32) / 255 for file in files])
                yield Scene("Washington", lit, np.asarray(Image.open(path).convert("L")) > 127, lights, None)
    for seed in range(12):
        for kind in ("bumps", "dents", "noise"):
            yield _relief(kind, generator(seed, kind))


def _relief(kind: str, draw: np.random.Generator, size: int = 128) -> Scene:
    """Return a relief that fills the frame, matte or with highlights, without cast shadows."""
    row, column = np.mgrid[:size, :size]
    if kind == "noise":
        height = sum(a * gaussian_filter(draw.normal(size=(size, size)), s) for s, a in ((3, 4), (8, 20), (20, 60)))
    else:
        height = np.zeros((size, size))
        for x, y, radius in draw.uniform((0, 0, 6), (size, size, 20), (12, 3)):
            height = np.maximum(height, 0.6 * np.sqrt(np.maximum(radius**2 - (column - x) ** 2 - (row - y) ** 2, 0)))
        height = gaussian_filter(height, 1.5) * (1 if kind == "bumps" else -1)
    down, right = np.gradient(height)
    normals = np.stack([-right, down, np.ones_like(height)], axis=-1)
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    lights = draw.normal(size=(int(draw.integers(6, 24)), 3))
    lights[:, 2] = np.abs(lights[:, 2]) + 0.6
    lights /= np.linalg.norm(lights, axis=1, keepdims=True)
    half = half_vectors(lights)
    albedo = 0.6 * np.exp(gaussian_filter(draw.normal(size=(size, size)), 2))
    lit = albedo[..., None] * np.maximum(normals @ lights.T, 0)
    lit += draw.choice([0, 0.3]) * np.maximum(normals @ half.T, 0) ** 40
    gains = draw.uniform(0.7, 1.4, len(lights))
    images = np.repeat((lit * gains * 0.6).transpose(2, 0, 1)[..., None], 3, axis=-1)
    images = np.clip(images + draw.normal(0, 0.004, images.shape), 0, 1).astype(np.float32)
    return Scene(kind, images, np.ones((size, size), bool), lights, gains)


if __name__ == "__main__":
    sys.exit(main())
