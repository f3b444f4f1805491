"""How often still pictures are said to have moved, and moved ones noticed: whole frames, few pictures, short shifts.

    python -m lab.studies.motion_study out/near out/far --photographs ball cat
    python -m lab.studies.motion_study out/near --every 5 --json study.json
    python -m lab.studies.motion_study --reliefs out/reliefs       # writes meshes of six reliefs, to be rendered

The folders are data folders of rendered scenes (`sdps regenerate`), of which those whose object fills the frame are
whole frames, and folders of photographs that are known to be still. Each set is looked at whole and in random subsets
of 4, 6, 8, 12 and 20 pictures, and again with one picture, a quarter of the pictures, or the second half moved. Whole
frames are cropped, so that the moved ones show what a moved camera sees.
"""

import argparse
import json
import sys
import zlib
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import trimesh
from scipy import ndimage

from pipelines.shared.text_tables import render_text
from render.records.manifest import read_manifest
from render.records.shards import read_shard
from sdps import photos
from sdps.photos.analysis.motion import Tracker, second_look
from sdps.photos.response import brightness

_MARGIN, _NOISE, _WHOLE = 8, 0.003, 0.97
_SIZES = (4, 6, 8, 12, 20)
_LENGTHS = (1, 2, 4, 8)


class Still(NamedTuple):
    """Pictures (L, H, W) of a still scene, and where its object is (H, W)."""

    name: str
    images: np.ndarray
    mask: np.ndarray


def main(argv: Sequence[str] | None = None) -> int:
    """Print a line for every case: sets with the warning, moved pictures named, sets with others named."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folders", nargs="*", type=Path, help="data folders of rendered scenes")
    parser.add_argument("--photographs", nargs="*", type=Path, default=[], help="folders of still photographs")
    parser.add_argument("--every", type=int, default=1, help="take every so many sets")
    parser.add_argument("--json", type=Path, help="write the rows there")
    parser.add_argument("--reliefs", type=Path, help="write meshes of six reliefs into this folder first")
    args = parser.parse_args(argv)
    if args.reliefs:
        write_reliefs(args.reliefs)
    rows = [row for still in _sets(args.folders, args.photographs, args.every) for row in judge(still)]
    if args.json:
        args.json.write_text(json.dumps(rows))
    sys.stdout.write(_table(rows))
    return 0


def write_reliefs(folder: Path, side: int = 256) -> None:
    """Write plates that fill the frame once rendered with `--set test.scale=1.55`, as PLY files."""
    folder.mkdir(parents=True, exist_ok=True)
    x, y = np.meshgrid(np.linspace(-1, 1, side), np.linspace(-1, 1, side))

    def smooth(width: float, seed: int) -> np.ndarray:
        field = ndimage.gaussian_filter(np.random.default_rng(seed).normal(size=x.shape), width)
        return field / field.std()

    bumps, rng = np.zeros_like(x), np.random.default_rng(0)
    for column, row, radius in rng.uniform((-1, -1, 0.08), (1, 1, 0.2), (22, 3)):
        squared = radius**2 - (x - column) ** 2 - (y - row) ** 2
        bumps = np.maximum(bumps, 0.6 * np.sqrt(np.maximum(squared, 0)))
    letters = ndimage.gaussian_filter((smooth(6, 4) > 0.5).astype(float), 1.2)
    heights = {"flat": np.zeros_like(x), "plate": 0.006 * smooth(2.5, 1), "bumps": bumps, "letters": 0.05 * letters,
               "stones": 0.05 * abs(smooth(8, 2)) + 0.01 * smooth(3, 3), "waves": 0.06 * smooth(20, 5)}  # fmt: skip
    corner = np.arange(side * side).reshape(side, side)
    a, b, c, d = (part.ravel() for part in (corner[:-1, :-1], corner[:-1, 1:], corner[1:, 1:], corner[1:, :-1]))
    faces = np.concatenate([np.stack([a, b, c], axis=-1), np.stack([a, c, d], axis=-1)])
    for name, height in heights.items():
        points = np.stack([x, y, height], axis=-1).reshape(-1, 3)
        trimesh.Trimesh(points, faces, process=False).export(folder / f"{name}.ply")


def _sets(folders: Sequence[Path], photographs: Sequence[Path], every: int) -> Iterator[Still]:
    scenes = [(folder, scene) for folder in folders for scene in read_manifest(folder)][::every]
    for folder, scene in scenes:
        shard, rng = read_shard(folder / scene.file, scene), np.random.default_rng(zlib.crc32(scene.id.encode()))
        grey = shard.images.astype(np.float32).mean(-1) * rng.uniform(0.7, 1.3, (len(shard.images), 1, 1))
        inside = shard.mask[_MARGIN:-_MARGIN, _MARGIN:-_MARGIN]
        if inside.mean() < _WHOLE:
            grey, mask = np.pad(grey * shard.mask, ((0, 0), (20, 20), (20, 20))), np.pad(shard.mask, 20)
        else:
            mask = np.ones_like(shard.mask)
        grey = grey / np.percentile(grey[:, mask], 99.5) + rng.normal(0, _NOISE, grey.shape)
        yield Still(scene.id, _eight_bits(grey), mask)
    for folder in photographs:
        read = photos.load(folder)
        yield Still(str(folder), np.stack([brightness(read[k : k + 1][0]) for k in range(len(read))]), read.mask)


def _eight_bits(linear: np.ndarray) -> np.ndarray:
    """Return values as 8-bit files with a display curve keep them, (L, H, W) float32."""
    return ((np.rint(np.clip(linear, 0, 1) ** (1 / 2.2) * 255) / 255) ** 2.2).astype(np.float32)


def judge(still: Still) -> Iterator[dict]:
    """Look at a set still and moved, whole and in parts; a row for each."""
    rng = np.random.default_rng(zlib.crc32(still.name.encode()))
    count = len(still.images)
    parts = {size: rng.permutation(count)[:size] for size in _SIZES if size < count} | {count: np.arange(count)}
    for size, part in parts.items():
        yield _row(still, f"still, {size if size in _SIZES else 'all'} pictures", part, {})
    many = [size for size in parts if size >= min(8, count)]
    for length in _LENGTHS:
        part = parts[int(rng.choice(many))]
        yield _row(still, f"one by {length} pixels", part, {int(rng.integers(len(part))): _step(rng, length)})
        part, step = parts[int(rng.choice(many))], _step(rng, length)
        yield _row(still, f"half by {length} pixels", part, dict.fromkeys(range(len(part) // 2, len(part)), step))
    part = parts[int(rng.choice(many))]
    few = rng.permutation(len(part))[: max(1, len(part) // 4)]
    yield _row(still, "a quarter, each by 4 pixels its own way", part, {int(k): _step(rng, 4) for k in few})
    yield _row(still, "all, each its own way", part, {k: _step(rng, 5) for k in range(len(part))})
    for size in set(parts) & {4, 6}:
        yield _row(still, f"one of {size} by 4 pixels", parts[size], {int(rng.integers(size)): _step(rng, 4)})


def _step(rng: np.random.Generator, length: int) -> tuple[int, int]:
    angle = rng.uniform(0, 2 * np.pi)
    return round(length * np.sin(angle)), round(length * np.cos(angle))


def _row(still: Still, case: str, part: np.ndarray, steps: dict[int, tuple[int, int]]) -> dict:
    """Move the pictures of a part by their steps and say which are named."""
    images, mask = still.images[part].copy(), still.mask
    for number, step in steps.items():
        images[number] = np.roll(images[number], step, (0, 1))
    if mask.all():
        images, mask = (field[..., _MARGIN:-_MARGIN, _MARGIN:-_MARGIN] for field in (images, mask))
    tracker = Tracker(mask)
    first = [tracker.add(image) for image in np.ascontiguousarray(images)]
    shifts = second_look(tracker, first, lambda number: images[number])
    named = {number for number, shift in enumerate(shifts) if shift.length}
    kind = "whole frame" if mask.all() else "object"
    return {"set": still.name, "kind": kind, "case": case, "moved": len(steps), "named": len(named),
            "right": len(named & set(steps)), "wrong": len(named - set(steps))}  # fmt: skip


def _table(rows: Sequence[dict]) -> str:
    body = []
    for kind in ("object", "whole frame"):
        for case in dict.fromkeys(row["case"] for row in rows):
            part = [row for row in rows if (row["kind"], row["case"]) == (kind, case)]
            said, others = (sum(row[key] > 0 for row in part) for key in ("named", "wrong"))
            moved = sum(row["moved"] for row in part)
            share = f"{sum(row['right'] for row in part) / moved:.0%}" if moved else "-"
            body.append([kind, case, f"{said} of {len(part)}", share, str(others)])
    header = ["kind", "what was moved", "sets with the warning", "moved pictures named", "sets with others named"]
    return render_text("still and moved pictures", header, body)


if __name__ == "__main__":
    sys.exit(main())
