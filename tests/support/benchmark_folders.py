"""Small folders in the layouts of the real benchmarks, of shapes without any shadow, whose answers are exact."""

import shutil
from pathlib import Path

import numpy as np
import OpenEXR
from sdps_scenes import hemisphere_lights, shade, sphere_normals

from pipelines import cli
from render.records.manifest import SceneSpec, View, write_manifest
from render.records.shards import Shard, to_half, write_shard
from render.shared.images import write_png

LIGHTS, SIZE = 26, 48


def cap(size: int = SIZE) -> tuple[np.ndarray, np.ndarray]:
    """Return normals and mask of a sphere's cap, tilted by less than 54 degrees."""
    normals, mask = sphere_normals(size, 0.9)
    normals /= np.maximum(np.linalg.norm(normals, axis=-1, keepdims=True), 1e-6)
    mask = mask & (normals[..., 2] > 0.6)
    return normals * mask[..., None], mask


def near_lights(count: int, seed: int = 0) -> np.ndarray:  # (count, 3)
    """Return directions within 32 degrees of the view, so that nothing of a cap is in shadow."""
    return hemisphere_lights(count, np.random.default_rng(seed), 0.85).astype(np.float64)


def write_diligent(root: Path, names: tuple[str, ...], *options: str, lights: int = LIGHTS) -> Path:
    """Export a cap per name through our own shards, as `<root>/pmsData/<name>PNG`; return the root."""
    data, scenes = root.parent / f"{root.name}-shards", []
    normals, mask = cap()
    for number, name in enumerate(names):
        directions = near_lights(lights, number)
        scene = SceneSpec(
            id=name, seed=number + 1, split="test", shape=name, material="lambert", view=View(), size=SIZE, spp=1,
            lights=tuple(tuple(round(float(value), 6) for value in row) for row in directions), bounces=0,
        )  # fmt: skip
        shard = Shard(
            scene_id=name, images=to_half(shade(normals, scene.light_directions(), np.array([0.45, 0.4, 0.3]))),
            normals=normals, depth=np.zeros((SIZE, SIZE), np.float32), mask=mask, coverage=mask.astype(np.float32),
            light_directions=scene.light_directions(), provenance={"spec": scene.digest()},
        )  # fmt: skip
        write_shard(data / scene.file, shard)
        scenes.append(scene)
    write_manifest(data, scenes)
    assert cli.main(["data", "export", str(data), "--layout", "diligent", "--out", str(root), "--exposure", "1",
                     "--intensities", "seed", *options]) == 0  # fmt: skip
    base = root / "pmsData"
    for folder, name in zip((base / "objects.txt").read_text().split(), names, strict=True):
        shutil.move(base / folder, base / f"{name}PNG")
    (base / "objects.txt").write_text("".join(f"{name}PNG\n" for name in names))
    return root


def photographs(directions: np.ndarray, gains: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return linear images (L, H, W, 3) of a cap in a wider frame, with its mask and normals."""
    normals, mask = (np.pad(part, ((5, 9), (3, 20), (0, 0))[: part.ndim]) for part in cap())
    images = shade(normals, directions, np.array([0.4, 0.35, 0.3])) * gains[:, None, None]
    return images.astype(np.float32), mask, normals


def write_exr(path: Path, image: np.ndarray) -> None:
    """Write (H, W, 3) as half-float RGB, as Gourd&Apple's pictures are."""
    half = np.ascontiguousarray(image.astype(np.float16))
    OpenEXR.File({"compression": OpenEXR.ZIP_COMPRESSION}, {"RGB": half}).write(str(path))


def write_rows(path: Path, rows: np.ndarray, *, numbered: bool = False) -> None:
    """Write numbers, a row a line, with the row's number in front or without."""
    path.write_text(
        "".join(
            (f"{number} " if numbered else "") + " ".join(f"{value:.8f}" for value in row) + "\n"
            for number, row in enumerate(rows)
        )
    )


def gains_of(count: int) -> np.ndarray:  # (count, 3)
    """Return coloured intensities."""
    return np.random.default_rng(1).uniform(0.4, 1.6, (count, 3))


def write_gourd_apple(root: Path, *, packed: bool = False, count: int = 9) -> Path:
    """Write `apple` in the layout of its authors, or as an array as loaders keep it."""
    folder = root / "apple"
    folder.mkdir(parents=True)
    directions, gains = near_lights(count, 3), gains_of(count)
    images, mask, _ = photographs(directions, gains)
    if packed:
        np.save(folder / "apple_uncalib.npy", np.concatenate(list(images), axis=2))
        write_png(folder / "mask.png", mask.astype(np.uint8) * 255)
    else:
        for number, image in enumerate(images):
            write_exr(folder / f"I_{number:04d}.exr", image)
        write_png(folder / "mask.png", mask.astype(np.uint8))  # 0 and 1, as published
    measured = directions + 0.1
    write_rows(folder / "light_directions_refined.txt", directions)
    write_rows(folder / "light_directions.txt", measured / np.linalg.norm(measured, axis=1, keepdims=True))
    for name in ("light_intensities_refined.txt", "light_intensities.txt"):
        write_rows(folder / name, gains)
    return root


def write_light_stage(root: Path, *, behind: int = 5, count: int = 9) -> Path:
    """Write `plant_left` under lights in front and behind, vectors along the light, a matte with a dark object."""
    folder = root / "plant_left"
    folder.mkdir(parents=True)
    directions = near_lights(count + behind, 4)
    directions[1 : 1 + behind, 2] *= -1
    gains = gains_of(count + behind)
    images, mask, _ = photographs(directions, gains)
    for number, image in enumerate(images):
        pixels = np.rint(np.clip(image, 0, 1) * 255).astype(np.uint8)
        write_png(folder / f"plant_left_{number:03d}.png", pixels)
    write_png(folder / "plant_left_matte.png", np.where(mask, 0, 255).astype(np.uint8))
    write_rows(root / "light_directions.txt", -directions, numbered=True)
    write_rows(root / "light_intensities.txt", gains, numbered=True)
    return root


def whole(images) -> np.ndarray:  # (L, H, W, 3)
    """Read all images of a source."""
    return images[0 : len(images)]


def run(command: str, *arguments: object) -> int:
    """Run a command as the command line does, but let its complaints out."""
    words = [*command.split(), *map(str, arguments)]
    args = cli.build_parser(command.split()).parse_args(words)
    return args.run(args)
