"""Repeat the figures of docs/studies/refinement.md on rendered scenes: what refinement changes, what to expect of it.

    python -m lab.studies.refinement_study --out out/refinement
    python -m lab.studies.refinement_study --out out/refinement --images 8
    python -m lab.studies.refinement_study --out out/refinement --every 3 --images 0 8 16 32 --fit

48 scenes of shapes that no network was trained on, 96 lights; of every other scene only the 19 to 38 lights within 50
degrees of the camera. Random intensities. The start is `sdps-plus` with nothing given, or `psfcn` with the true lights
(`--lights`) or with wrong ones, to be refined (`--light-error`); `--start` names another method.
Scenes, starts and results are kept under --out, so a run that was stopped goes on. With `--merltest FOLDER`, the scenes
that `sdps eval-merltest` rendered are taken instead.
"""

import argparse
import subprocess
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from tqdm import tqdm

from pipelines.evaluate.workbench import draw_intensities
from pipelines.shared.presets import TestConfig
from render.records.manifest import SceneSpec, read_manifest
from render.records.shards import read_shard
from render.shared.errors import InputError
from render.shared.files import atomic_path
from render.shared.seeds import generator, spread_evenly
from sdps.core.estimate import Estimate
from sdps.core.metrics import angle_degrees, intensity_error
from sdps.inference.inference_config import InferenceConfig
from sdps.methods.parse import parse
from sdps.methods.pretrained import finder
from sdps.methods.runner import Runner
from sdps.refinement.image_model import Refined
from sdps.refinement.refine import refine
from sdps.refinement.trust import NORMAL, Trust, features, trust

PRESET = Path(__file__).parents[1] / "presets" / "refinement_study.yaml"
_NARROW = np.cos(np.radians(50.0))
_LOSS = 0.3  # degrees; what counts as losing
_OFFSET = 0.05  # degrees, added before the logarithm


class Scene:
    """A scene as photographs, its truth, and the start."""

    def __init__(self, folder: Path, spec: SceneSpec, narrow: bool, images: int, merltest: bool) -> None:
        shard, rng = read_shard(folder / spec.file, spec), generator(5, spec.id, "dev")
        every = np.arange(len(shard.light_directions))
        gains = draw_intensities(spec, TestConfig(), 0) if merltest else rng.uniform(0.2, 2.0, len(every))
        chosen = np.flatnonzero(shard.light_directions[:, 2] > _NARROW) if narrow else every
        if 0 < images < len(chosen):
            chosen = np.sort(rng.permutation(chosen)[:images])
        self.name, self.mask, self.normals = spec.id, shard.mask, shard.normals
        self.material, self.shape = spec.material, spec.shape
        self.lights, self.gains = shard.light_directions[chosen], gains[chosen].astype(np.float32)
        radiance = shard.images[chosen].astype(np.float32) * shard.mask[..., None]
        self.images = radiance * self.gains[:, None, None, None]  # (L, H, W, 3)


def main(argv: Sequence[str] | None = None) -> int:
    """Render, start, refine, print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--images", type=int, nargs="+", default=[0], help="of each scene (default: all)")
    parser.add_argument("--lights", action="store_true", help="lights are given")
    parser.add_argument("--light-error", type=float, default=0.0, help="degrees; intensities are off by 1 %% a degree")
    parser.add_argument("--start", default="", help="method to start from, as sdps-frames")
    parser.add_argument("--merltest", type=Path, help="folder with the scenes of eval-merltest")
    parser.add_argument("--every", type=int, default=1, help="take every so many scenes")
    parser.add_argument("--fit", action="store_true", help="print the constants of sdps/refinement/trust.py")
    args = parser.parse_args(argv)
    folder = args.merltest or render_scenes(PRESET, args.out / "scenes")
    specs = list(enumerate(read_manifest(folder)))[:: args.every]
    results = []
    for (number, spec), images in tqdm([(spec, images) for images in args.images for spec in specs], disable=None):
        tag = f"{'merltest' if args.merltest else 'dev'}-{images or 'all'}{'-given' if args.lights else ''}"
        tag += f"-{args.light_error:g}" if args.light_error else ""
        tag += f"-{args.start}" if args.start else ""
        scene = Scene(folder, spec, not args.merltest and number % 2 == 1, images, args.merltest is not None)
        results.append((scene, *refine_scene(scene, args.out / tag, args.start, args.lights, args.light_error)))
    for line in _fit(results) if args.fit else _table(results):
        sys.stdout.write(f"{line}\n")
    return 0


def render_scenes(preset: Path, out: Path) -> Path:
    """Render the scenes of a preset that are not there yet; return their folder."""
    command = [sys.executable, "-m", "pipelines.cli", "render-data", "--preset", str(preset), "--out", str(out)]
    subprocess.run(command, check=True)
    return out / "data" if (out / "data").is_dir() else out


def refine_scene(scene: Scene, out: Path, name: str, given: bool, wrong: float) -> tuple[Estimate, Refined]:
    """Return the start and what refinement makes of it, read back where it is there."""
    path = out / f"{scene.name.replace('/', '_')}.npz"
    if not path.exists():
        lit = given or wrong > 0.0
        method = parse(name or ("true+psfcn" if lit else "sdps-plus"), finder(None))
        runner = Runner(method, finder(None), InferenceConfig(light_views=None if lit else 8, normal_views=1))
        told = _turn(scene, wrong) if lit else (None, None)
        start = runner.estimate(scene.images, scene.mask, *told)
        gains = start.intensities if told[1] is None else told[1]
        found = refine(
            scene.images, scene.mask, start.normals, start.light_directions, gains,
            directions_given=given, rim_known=start.expected_error is not None,
        )  # fmt: skip
        path.parent.mkdir(parents=True, exist_ok=True)
        with atomic_path(path) as temporary, temporary.open("wb") as file:
            begun = {"normals": start.normals, "lights": start.light_directions, "gains": gains}
            if start.expected_error is not None:
                begun["expected_error"] = start.expected_error
            np.savez(file, **{f"start_{name}": value for name, value in begun.items()}, **vars(found))
    return _read_kept(path)


def _read_kept(path: Path) -> tuple[Estimate, Refined]:
    """Return a start and its refinement, read back."""
    with np.load(path) as archive:
        begun = Estimate(
            *(archive[f"start_{name}"] for name in ("normals", "lights", "gains")),
            expected_error=archive.get("start_expected_error"),
        )
        return begun, Refined(**{name: archive[name] for name in Refined.__dataclass_fields__})


def _turn(scene: Scene, degrees: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the true lights, each turned by an angle about an axis of its own, and gains off by 1 % a degree."""
    rng = generator(6, scene.name, "wrong")
    across = np.cross(scene.lights, rng.normal(size=scene.lights.shape))
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    lights = np.cos(np.radians(degrees)) * scene.lights + np.sin(np.radians(degrees)) * across
    lights[:, 2] = np.maximum(lights[:, 2], 0.05)
    gains = scene.gains * np.exp(0.01 * degrees * rng.normal(size=len(lights)))
    return (lights / np.linalg.norm(lights, axis=1, keepdims=True)).astype(np.float32), gains.astype(np.float32)


def _errors(scene: Scene, found: Estimate) -> tuple[float, float, float]:
    return (
        float(angle_degrees(found.normals[scene.mask], scene.normals[scene.mask]).mean()),
        float(angle_degrees(found.light_directions, scene.lights).mean()),
        intensity_error(found.intensities, scene.gains),
    )


def expect_errors(scene: Scene, begun: Estimate, found: Refined) -> Trust:
    """Return the errors to expect."""
    given = np.allclose(begun.light_directions, found.light_directions, atol=1e-6)  # of unit length but for rounding
    return trust(found, scene.mask, begun, given=given)


def _table(results: list[tuple[Scene, Estimate, Refined]]) -> Iterator[str]:
    """Yield a line a scene, then means by shape: start, refined, refined with the guard; errors that are expected."""
    rows, doubts = [], 0
    yield f"{'scene':28s} {'material':26s}   L  normals       lights        intensities    expected  doubt"
    for scene, begun, found in results:
        before = _errors(scene, begun)
        after = _errors(scene, Estimate(found.normals, found.light_directions, found.grey_intensities))
        judged = expect_errors(scene, begun, found)
        doubts += bool(judged.doubt)
        rows.append((scene.shape, before, after, before if judged.doubt else after))
        yield (
            f"{scene.name:28s} {scene.material:26s} {len(scene.lights):3d} {before[0]:6.2f} {after[0]:6.2f} "
            f"{before[1]:6.2f} {after[1]:6.2f}  {before[2]:6.3f} {after[2]:6.3f}  "
            f"{judged.normals[scene.mask].mean():6.2f}   {judged.doubt}"
        )
    kinds = sorted({row[0] for row in rows}) if len({row[0] for row in rows}) < 4 else []
    for kind in [*kinds, "all"]:
        part = [row for row in rows if kind in (row[0], "all")]
        start, refined, kept = (np.mean([row[k] for row in part], axis=0).round(3).tolist() for k in (1, 2, 3))
        lost = [sum(row[k][0] > row[1][0] + _LOSS for row in part) for k in (2, 3)]
        yield f"{kind}: start {start}, refined {refined}, with the guard {kept} (normals, lights, intensities)"
        yield f"{kind}: {lost[0]} of {len(part)} worse by more than {_LOSS} degrees, {lost[1]} with the guard"
    yield f"doubted: {doubts}"
    yield from _reliability(results)


def _reliability(results: list[tuple[Scene, Estimate, Refined]], bins: int = 8) -> Iterator[str]:
    """Yield the mean error by eighths of the expected one, every scene with the same weight."""
    normals, lights = [], []
    for scene, begun, found in results:
        judged = expect_errors(scene, begun, found)
        actual = angle_degrees(found.normals[scene.mask], scene.normals[scene.mask])
        some = spread_evenly(range(len(actual)), 500)
        normals.append(np.stack([judged.normals[scene.mask], actual])[:, some])
        lights.append(np.stack([judged.lights, angle_degrees(found.light_directions, scene.lights)]))
    for name, parts in (("normals", normals), ("lights", lights)):
        pairs = np.concatenate(parts, axis=1)
        for part in np.array_split(pairs[:, np.argsort(pairs[0])], bins, axis=1):
            yield f"reliability, {name}: expected {part[0].mean():6.2f}, actual {part[1].mean():6.2f}"


Pairs = list[tuple[str, np.ndarray, np.ndarray]]  # shape, features (N, K), actual degrees (N,)


def _fit(results: list[tuple[Scene, Estimate, Refined]]) -> Iterator[str]:
    """Yield the constants, and how far off shapes are that were left out, with all features and without the last."""
    parts: dict[str, Pairs] = {"NORMAL": [], "LIGHT": [], "START": []}
    for scene, begun, found in results:
        of_normals, of_lights, moved = features(found, scene.mask, begun)
        actual = angle_degrees(found.normals[scene.mask], scene.normals[scene.mask])
        parts["NORMAL"].append((scene.shape, of_normals, actual))
        parts["LIGHT"].append((scene.shape, of_lights, angle_degrees(found.light_directions, scene.lights)))
        parts["START"].append((scene.shape, moved[None], np.array([_errors(scene, begun)[0]])))
    for name, pairs in parts.items():
        yield f"{name} = ({', '.join(f'{value:.3f}' for value in _powers(pairs))})"
    for width in sorted({len(NORMAL), parts["NORMAL"][0][1].shape[1]}):
        each, means = _leave_out([(shape, x[:, :width], y) for shape, x, y in parts["NORMAL"]])
        yield f"NORMAL, {width} features, shapes left out: logarithms off by {each:.2f}, of means {means:.2f} (rms)"


def _powers(pairs: Pairs) -> np.ndarray:
    """Return constants (K,): least squares of the logarithms, every scene with the same weight, then the right mean."""
    weights = np.concatenate([np.full(len(y), 1.0 / np.sqrt(len(y))) for _, _, y in pairs])
    x, y = np.concatenate([x for _, x, _ in pairs]), np.concatenate([y for _, _, y in pairs])
    found, *_ = np.linalg.lstsq(x * weights[:, None], np.log(y + _OFFSET) * weights, rcond=None)
    found[0] += np.log(np.average(y, weights=weights**2) / np.average(np.exp(x @ found), weights=weights**2))
    return found


def _leave_out(pairs: Pairs) -> tuple[float, float]:
    """Fit without each shape in turn; return how far the logarithms of its errors, and of their means, are off."""
    each, means = [], []
    for left in {shape for shape, _, _ in pairs}:
        found = _powers([pair for pair in pairs if pair[0] != left])
        for _, x, y in (pair for pair in pairs if pair[0] == left):
            told = np.exp(x @ found)
            each.append(np.square(np.log((told + _OFFSET) / (y + _OFFSET))).mean())
            means.append(np.log(told.mean() / y.mean()) ** 2)
    return float(np.sqrt(np.mean(each))), float(np.sqrt(np.mean(means)))


if __name__ == "__main__":
    try:
        sys.exit(main())
    except InputError as error:
        sys.exit(f"error: {error}")
