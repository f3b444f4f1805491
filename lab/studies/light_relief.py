"""How much of the errors of estimated lights is relief: one factor of x and y for each scene, and can images tell it.

    python -m lab.studies.light_relief out/shipped --method "lightset (shipped), 8 views"
    python -m lab.studies.light_relief out/shipped --method "lightset (shipped), 8 views" --every 6 --search

The folder is one of `sdps eval-merltest`. A surface that is taken for flatter than it is has lights that are taken for
lower than they are (the generalised bas-relief ambiguity, Belhumeur et al., IJCV 1999). With --search the factor is the
one under which a matte surface explains the images best, given the estimated lights and intensities.
"""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch

from pipelines.evaluate.workbench import draw_intensities, photograph
from pipelines.shared.presets import TestConfig
from render.records.manifest import SceneSpec, read_manifest
from render.records.shards import read_shard
from render.shared.errors import InputError
from render.shared.files import read_whole_lines
from render.shared.seeds import generator
from sdps.core.first_normals import first_normals
from sdps.core.metrics import angle_degrees

_FACTORS = np.exp(np.linspace(-0.3, 0.3, 61))
_SEARCHED = _FACTORS[::5]
_PIXELS = 700


def main(argv: Sequence[str] | None = None) -> int:
    """Print a line for every shape."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--method", required=True, help="its name in the tables")
    parser.add_argument("--every", type=int, default=1, help="take every so many scenes of a shape")
    parser.add_argument("--search", action="store_true", help="find the factor by the images too")
    args = parser.parse_args(argv)
    folder = args.folder / "merltest"
    scenes = {scene.id: scene for scene in read_manifest(folder)}
    lines = read_whole_lines(args.folder / "eval" / "scores.jsonl")
    found = {row["key"][2]: row["value"] for row in lines if row["key"][0] == args.method}
    if not found:
        raise InputError(f"{args.folder}: no scores of {args.method!r}; evaluate it with `sdps eval-merltest`")
    for shape in dict.fromkeys(scenes[name].shape for name in found):
        names = [name for name in found if scenes[name].shape == shape][:: args.every]
        rows = np.array([_row(scenes[name], folder, found[name], args.search) for name in names])
        error, best, factor, searched = rows.mean(axis=0)
        text = f"{shape}, {len(rows)} scenes: {error:.2f} degrees, best factor {best:.2f} ({factor:.3f} on average)"
        sys.stdout.write(f"{text}, a matte surface's {searched:.2f}\n" if args.search else f"{text}\n")
    return 0


def _row(scene: SceneSpec, folder: Path, found: dict, search: bool) -> tuple[float, float, float, float]:
    """Return the error in degrees, that with the best factor, that factor, and the error with the searched one."""
    truth, lights = scene.light_directions(), np.array(found["lights"], np.float32)
    errors = [_error(lights, factor, truth) for factor in _FACTORS]
    best = int(np.argmin(errors))
    searched = _error(lights, _search(scene, folder, lights, found["gains"]), truth) if search else np.nan
    return _error(lights, 1.0, truth), errors[best], float(_FACTORS[best]), searched


def _scale(lights: np.ndarray, factor: float) -> np.ndarray:
    moved = lights * np.array([factor, factor, 1.0], np.float32)
    return moved / np.linalg.norm(moved, axis=1, keepdims=True)


def _error(lights: np.ndarray, factor: float, truth: np.ndarray) -> float:
    return float(angle_degrees(_scale(lights, factor), truth).mean())


def _search(scene: SceneSpec, folder: Path, lights: np.ndarray, gains: Sequence[float]) -> float:
    """Return the factor under which robust first normals explain some pixels best."""
    shard = read_shard(folder / scene.file, scene)
    places = np.argwhere(shard.mask)
    places = places[generator(0, scene.id, "relief").permutation(len(places))[:_PIXELS]]
    seen = photograph(shard, draw_intensities(scene, TestConfig(), 0))[:, places[:, 0], places[:, 1]]  # (L, N, 3)
    values = torch.from_numpy(seen / np.array(gains, np.float32)[:, None, None]).permute(1, 0, 2).contiguous()
    residuals = []
    for factor in _SEARCHED:
        directions = torch.from_numpy(_scale(lights, factor))[None].expand(len(values), -1, -1)
        residuals.append(float(first_normals(values, directions)[2].mean()))
    return float(_SEARCHED[int(np.argmin(residuals))])


if __name__ == "__main__":
    try:
        sys.exit(main())
    except InputError as error:
        sys.exit(f"error: {error}")
