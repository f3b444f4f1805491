"""What refinement under low-order light gains, by kind of light and number of images.

    python -m lab.studies.low_order_study DATA
    python -m lab.studies.low_order_study DATA --method anylight

Scenes and light are those of `any_light_study`. It starts from true normals that are disturbed (`disturb`), or from
those of a method, with the errors that it expects.
"""

import argparse
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy import ndimage

from lab.studies.any_light_study import choose, photograph, unpack
from pipelines.shared.text_tables import render_text
from render.records.manifest import SceneSpec
from render.shared.imaging.vectors import unit
from render.shared.seeds import generator
from sdps.api import estimate
from sdps.core.metrics import angle_degrees
from sdps.data.scene_store import SceneStore, list_finished
from sdps.refinement.surroundings.low_order import refine_low_order

LIGHTS = ("lamps and room", "surroundings", "distant lamps")
_BLUR, _WIDTH, _LEAST_Z = 2.0, 1 / 8, 0.05
"""Pixels of blur, width of the waves over the object's, and the least n_z that is left."""


@dataclass(frozen=True)
class Gain:
    """Mean errors of normals in degrees before and after, the misfits, and the time it took."""

    light: str
    images: int
    before: float
    after: float
    misfit: tuple[float, float]
    kept: bool
    seconds: float


def disturb(normals: np.ndarray, mask: np.ndarray, rng: np.random.Generator, degrees: float = 8.0) -> np.ndarray:
    """Return normals (H, W, 3) without their detail, turned by slow random waves of so many degrees, RMS.

    Args:
        normals: True ones, unit.
        mask: (H, W) bool.
        rng: Draws the waves.
        degrees: How far normals are turned.
    """

    def blur(maps: np.ndarray, sigma: float) -> np.ndarray:
        return ndimage.gaussian_filter(maps, (sigma, sigma, 0))

    soft = unit(blur(np.where(mask[..., None], normals, 0.0), _BLUR))
    waves = blur(rng.normal(size=normals.shape), _WIDTH * max(np.ptp(part) for part in np.nonzero(mask)))
    waves -= (waves * soft).sum(axis=-1, keepdims=True) * soft  # only what turns normals
    turns = np.linalg.norm(waves, axis=-1, keepdims=True)
    waves *= np.radians(degrees) / np.sqrt((turns[mask] ** 2).mean())
    turns = np.linalg.norm(waves, axis=-1, keepdims=True)
    turned = soft * np.cos(turns) + np.cross(waves, soft) * np.sinc(turns / np.pi)
    turned[..., 2] = np.maximum(turned[..., 2], _LEAST_Z)
    return (unit(turned) * mask[..., None]).astype(np.float32)


def measure(scene: SceneSpec, store: SceneStore, light: str, counts: Sequence[int], method: str) -> list[Gain]:
    """Return what refinement gains on a scene; without a method, from disturbed normals."""
    sample, found = photograph(scene, store, light), []
    images, mask, normals, camera = unpack(scene, sample)
    for count in counts:
        some, expected = images[:count], None
        if method:
            begun = estimate(some, mask, method, camera=camera)
            start, expected = begun.normals, begun.expected_error
        else:
            start = disturb(normals, mask, generator(0, "low-order", scene.id))
        began = time.perf_counter()
        refined = refine_low_order(some, mask, start, expected, camera)
        seconds = time.perf_counter() - began
        errors = (float(angle_degrees(each[mask], normals[mask]).mean()) for each in (start, refined.normals))
        found.append(Gain(light, count, *errors, refined.misfit, not refined.doubt, seconds))
    return found


def summarise(gains: Sequence[Gain], counts: Sequence[int]) -> str:
    """Return the mean errors by light and number of images."""
    lines = []
    for light, count in ((light, count) for light in LIGHTS for count in counts):
        some = [gain for gain in gains if (gain.light, gain.images) == (light, count)]
        if not some:
            continue
        before, after, seconds = np.array([(gain.before, gain.after, gain.seconds) for gain in some]).T
        worse, kept = int((after > before).sum()), sum(gain.kept for gain in some)
        lines.append([light, str(count), str(len(some)), f"{before.mean():.2f}", f"{after.mean():.2f}", str(worse),
                      str(kept), f"{np.median(seconds):.1f}"])  # fmt: skip
    return render_text(
        "Mean error of the normals, degrees",
        ["light", "images", "scenes", "start", "refined", "worse", "kept", "seconds"],
        lines,
    )


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure, a scene at a time, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("data", type=Path)
    parser.add_argument("--method", default="", help="where to start from (default: disturbed true normals)")
    parser.add_argument("--scenes", type=int, default=10)
    parser.add_argument("--images", type=int, nargs="+", default=[8, 16])
    args = parser.parse_args(arguments)
    scenes, store = list_finished(args.data, "val", skip_missing=True), SceneStore(args.data, cache=False)
    gains: list[Gain] = []
    for light in LIGHTS:
        for scene in choose(scenes, light, args.scenes):
            gains += (new := measure(scene, store, light, args.images, args.method))
            told = ", ".join(f"{gain.images}: {gain.before:.2f} to {gain.after:.2f}, misfit {gain.misfit[0]:.4f}"
                             for gain in new)  # fmt: skip
            sys.stdout.write(f"{light}, {scene.id}: {told}\n")
            sys.stdout.flush()
    sys.stdout.write(summarise(gains, args.images))
    return 0


if __name__ == "__main__":
    sys.exit(main())
