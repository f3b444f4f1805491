"""How near lamps and perspective change the answers: rendered scenes at several distances and focal lengths.

    python -m lab.studies.near_study out/near --every 5
    python -m lab.studies.near_study out/near

Every scene is answered by the network, by refinement that takes lamps for distant and cameras for orthographic, by
refinement that is given the focal length and finds how near the lamps stand, and by the joined answer of the last.
Answers are kept in the folder, so that a run that was stopped goes on. Light directions count from the mean of the
pixels that are seen, as everywhere.
"""

import argparse
import json
import sys
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from lab.shared.answered_scenes import answer, make_runner
from lab.shared.scene_parts import add_part
from pipelines.shared.text_tables import render_text
from render.api import render_views
from render.planning.light_sets import draw
from sdps.core.geometry import Camera, Rig
from sdps.core.metrics import angle_degrees
from sdps.data.sample_geometry import lay_out, place
from sdps.methods.fusion.fuse import fuse
from sdps.methods.runner import Runner
from sdps.refinement.refine import RefineConfig, refine

SHAPES = ("sphere", "bunny", "sculpture:990011", "sculpture:990012", "blobby:990013", "composition:990014")
MATERIALS = ("white-paint", "blue-acrylic", "alum-bronze", "pink-felt", "gold-paint", "red-fabric", "black-phenolic",
             "yellow-plastic")  # fmt: skip
DISTANCES = (2.5, 5.0, 10.0, np.inf)
FOCAL_LENGTHS = (24.0, 50.0, 85.0, np.inf)
_HALF_FRAME = 18.0  # mm, half the width of a 35 mm frame, which the picture fills
_SIDE, _LAMPS, _SCALE = 96, 40, 0.8
_QUICK = RefineConfig(coarse_pixels=1400, iterations=500, iterations_before=300, fine_iterations=60)


@dataclass(frozen=True)
class Row:
    """Degrees of normals and of lights, by the network, with lamps taken for distant, with lamps found, and joined."""

    shape: str
    material: str
    distance: float
    focal: float
    start: tuple[float, float]
    distant: tuple[float, float]
    near: tuple[float, float]
    joined: tuple[float, float]
    nearness: float
    found: float


def settings(every: int) -> Iterator[tuple[str, str, float, float]]:
    """Yield shapes, materials, distances and focal lengths: all distances orthographic, all lenses at 5 and far."""
    pairs = [(shape, MATERIALS[(2 * row + turn) % len(MATERIALS)]) for turn in range(len(MATERIALS))
             for row, shape in enumerate(SHAPES)][::every]  # fmt: skip
    kinds = [(distance, np.inf) for distance in DISTANCES]
    kinds += [(distance, focal) for focal in FOCAL_LENGTHS[:-1] for distance in (5.0, np.inf)]
    for distance, focal in kinds:
        for shape, material in pairs:
            yield shape, material, distance, focal


def measure(runner: Runner, shape: str, material: str, distance: float, focal: float) -> Row:
    """Render a scene and answer it; the runner's method ends in `+refine`."""
    lens = None if np.isinf(focal) else focal / _HALF_FRAME
    lights = draw("hand-held", _LAMPS, np.random.default_rng(5))
    size = _SCALE if lens is None else min(_SCALE, lens / 2)  # a camera stands two radii away at least
    (view,) = render_views(
        shape, [material], lights, size=_SIDE, spp=32, scale=size, camera_distance=lens,
        light_distance=None if np.isinf(distance) else distance,
    )  # fmt: skip
    mask, truth = np.asarray(view.mask), np.asarray(view.normals)
    images = np.asarray(view.images, np.float32)
    layout = lay_out(view.scene, np.asarray(view.depth), mask, np.arange(_LAMPS))
    placed = place(layout, mask, view.scene.light_directions())

    def score(normals: np.ndarray, directions: np.ndarray) -> tuple[float, float]:
        off = angle_degrees(normals[mask], truth[mask]).mean(), angle_degrees(directions, placed.directions).mean()
        return round(float(off[0]), 3), round(float(off[1]), 3)

    camera = Camera() if lens is None else Camera(lens * _SIDE / 2)
    answered, evidence = answer(runner, images, mask, None, None, rig=Rig(camera))
    begun, near = answered.start, answered.refined
    joined = near.normals if evidence is None else fuse(answered, evidence, mask).normals
    start = begun.normals, begun.light_directions, begun.intensities
    distant = refine(images, mask, *start, config=_QUICK, rig=Rig(nearness=np.zeros(_LAMPS)), rim_known=True)
    answers = [(each.normals, each.light_directions) for each in (begun, distant, near)]
    scores = [score(*each) for each in (*answers, (joined, near.light_directions))]
    return Row(shape, material, distance, focal, *scores, float(placed.nearness.mean()), float(near.nearness.mean()))


def summarise(rows: Sequence[Row]) -> str:
    """Return the means of each distance and focal length."""
    lines = []
    for key in sorted({(row.focal, row.distance) for row in rows}, reverse=True):
        some = [row for row in rows if (row.focal, row.distance) == key]
        cells = [" / ".join(f"{np.mean([getattr(row, name)[k] for row in some]):.2f}" for k in (0, 1))
                 for name in ("start", "distant", "near", "joined")]  # fmt: skip
        close = [abs(row.found / row.nearness - 1) <= 0.1 for row in some if row.nearness]
        found = f"{np.mean([row.found for row in some]):.3f}"
        told = f"{np.mean([row.nearness for row in some]):.3f}"
        share = f"{sum(close)} of {len(close)}" if close else "-"
        lines.append([f"{key[1]:g}", f"{key[0]:g}", str(len(some)), *cells, told, found, share])
    head = ["distance", "focal mm", "scenes", "network", "distant", "near", "joined", "rho", "found", "within 10 %"]
    return render_text("Normals / lights, degrees", head, lines)


def main(arguments: Sequence[str] | None = None) -> int:
    """Print a line for every scene, and the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("out", type=Path)
    parser.add_argument("--every", type=int, default=1, help="take every so many pairs of shape and material")
    add_part(parser)
    args = parser.parse_args(arguments)
    args.out.mkdir(parents=True, exist_ok=True)
    file = args.out / "rows.jsonl"
    lines = file.read_text(encoding="utf-8").splitlines() if file.exists() else []
    kept = {tuple(row[:4]): Row(*row) for row in map(json.loads, lines)}
    wanted, runner = args.part.take(list(settings(args.every))), make_runner("sdps-frames+refine", refining=_QUICK)
    for number, setting in enumerate(wanted, start=1):
        if setting not in kept:
            kept[setting] = measure(runner, *setting)
            with file.open("a", encoding="utf-8") as out:
                out.write(json.dumps(list(asdict(kept[setting]).values())) + "\n")
        sys.stdout.write(f"{number} of {len(wanted)}: {kept[setting]}\n")
    sys.stdout.write(summarise([kept[setting] for setting in wanted]))
    return 0


if __name__ == "__main__":
    sys.exit(main())
