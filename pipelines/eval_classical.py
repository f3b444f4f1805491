"""`sdps eval-classical`: every classical method on regenerated scenes, by kind of reflectance and of lights.

The scenes are those of the preset's `test` section under each light set, with random light intensities. The paper's
figure on PF14 (supplement: good on diffuse, bad on specular reflectance) is a row of these tables.
"""

import argparse
import logging
import sys
from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from pipelines import presets, scenes
from pipelines.presets import TestConfig
from pipelines.regenerate import split_list
from pipelines.render_data import render_planned
from pipelines.score_cache import ScoreCache
from pipelines.tables import number, render_text
from render.errors import InputError
from render.files import write_json
from render.manifest import SceneSpec
from render.materials import surfaces
from render.progress import progress_bar
from render.seeds import generator
from render.shards import Shard, read_shard
from sdps.classical import registry
from sdps.estimate import Estimate
from sdps.metrics import score

_log = logging.getLogger(__name__)
LIGHT_SETS = ("near-uniform:96", "biased:96")
TABLES = {
    "normal_mae": "Normals, mean angular error in degrees",
    "direction_mae": "Light directions, mean angular error in degrees",
    "intensity_error": "Light intensities, mean relative error",
}
DEFINITION = (
    "Means over scenes, one per shape and material, of random light intensities. Normals: mean angular error over mask "
    "pixels. Calibrated methods are given the true lights. Failures are scenes a method refused, with a reason."
)


@dataclass(frozen=True)
class Row:
    """What one method made of one scene.

    Attributes:
        method: Its name.
        lights: The light set.
        shape: Shape of the scene.
        category: Kind of reflectance.
        scores: Metrics by name; empty where the method refused.
        seconds: Time it took.
        reason: Why it refused, or empty.
    """

    method: str
    lights: str
    shape: str
    category: str
    scores: dict[str, float]
    seconds: float = 0.0
    reason: str = ""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the flags of `sdps eval-classical`."""
    presets.add_common_arguments(parser, default="classical")
    parser.add_argument("--methods", action="append", help=f"{', '.join(registry.METHODS)} (default: all)")
    parser.add_argument("--light-sets", action="append", help=f"default: {','.join(LIGHT_SETS)}")


def main(args: argparse.Namespace) -> int:
    """Render or reuse the scenes, run the methods, print the tables and write results.json."""
    preset, out = presets.from_arguments(args)
    names = split_list(args.methods) or list(registry.METHODS)
    for name in names:
        registry.method(name)
    rows: list[Row] = []
    for lights in split_list(args.light_sets) or LIGHT_SETS:
        test = replace(preset.test, lights=lights)
        wanted, folder = scenes.test_scenes(test), out / scenes.slug(lights)
        render_planned(wanted, folder, replace(preset, test=test))
        rows += evaluate(wanted, folder, names, test)
    tables = build_tables(rows, names)
    listed = [vars(row) for row in rows]
    rendered = {title: {"header": header, "rows": body} for title, (header, body) in tables.items()}
    write_json(out / "results.json", {"definition": DEFINITION, "tables": rendered, "rows": listed})
    sys.stdout.write("\n".join(render_text(f"\n{title}", *table) for title, table in tables.items()))
    sys.stdout.write(f"\n{DEFINITION}\n{out / 'results.json'}\n")
    return 0


def evaluate(wanted: list[SceneSpec], folder: Path, names: Iterable[str], config: TestConfig) -> list[Row]:
    """Run every method on every scene that is not in the cache yet."""
    cache = ScoreCache(folder / "scores.jsonl", f"{config.seed} {config.intensity_range}")
    rows = []
    with progress_bar(total=len(wanted) * len(list(names)), desc=config.lights, unit="map") as bar:
        for scene in wanted:
            shard = None
            for name in names:
                key = (name, registry.source_digest(name), scene.digest())
                if key not in cache:
                    shard = shard or read_shard(folder / scene.file, scene)
                    cache.add(key, _run(name, scene, shard, config))
                rows.append(Row(name, config.lights, scene.shape, category(scene), *cache[key]))
                bar.update()
    return rows


def category(scene: SceneSpec) -> str:
    """Return the kind of reflectance; `mixed` where materials vary over the surface."""
    kinds = {component.category for component in surfaces.load(scene.material).components}
    return kinds.pop() if len(kinds) == 1 else "mixed"


def _run(name: str, scene: SceneSpec, shard: Shard, config: TestConfig) -> tuple[dict[str, float], float, str]:
    """Run a method on a scene: scores of what it estimates, seconds, and why it refused."""
    rng = generator(config.seed, scene.id, "intensities", 0)
    gains = rng.uniform(*config.intensity_range, len(shard.images)).astype(np.float32)
    images = shard.images.astype(np.float32) * gains[:, None, None, None] * shard.mask[..., None]
    try:
        estimate = registry.run(name, images, shard.mask, shard.light_directions, gains)
    except InputError as error:
        _log.warning("%s, %s: %s", scene.id, name, error)
        return {}, 0.0, str(error)
    return scores(name, estimate, shard, gains), estimate.diagnostics["seconds"], ""


def scores(name: str, estimate: Estimate, shard: Shard, gains: np.ndarray) -> dict[str, float]:
    """Return the metrics of what the method estimated itself."""
    truth = {"normals": shard.normals}
    if not registry.METHODS[name].calibrated:
        truth |= {"light_directions": shard.light_directions, "intensities": gains}
    return {item.name: item.value for item in score(estimate, shard.mask, **truth)}


def build_tables(rows: list[Row], names: list[str]) -> dict[str, tuple[list[str], list[list[str]]]]:
    """Average over the scenes of a shape, kind of reflectance and light set: {title: (header, rows)}."""
    tables = {}
    for metric, title in TABLES.items():
        for lights in dict.fromkeys(row.lights for row in rows):
            for shape in dict.fromkeys(row.shape for row in rows):
                part = [row for row in rows if (row.lights, row.shape) == (lights, shape)]
                kinds = list(dict.fromkeys(row.category for row in part))
                shown = [n for n in names if metric == "normal_mae" or not registry.METHODS[n].calibrated]
                body = [[name, *(_cell(part, name, kind, metric) for kind in kinds)] for name in shown]
                tables[f"{title}: {shape}, {lights}"] = (["method", *kinds], body)
    return tables


def _cell(rows: list[Row], name: str, kind: str, metric: str) -> str:
    """Return a method's mean over the scenes of a category, and how many failed."""
    rows = [row for row in rows if (row.method, row.category) == (name, kind)]
    values = [row.scores[metric] for row in rows if metric in row.scores]
    text = number(float(np.mean(values))) if values else "-"
    return text + (f" [{len(rows) - len(values)} failed]" if len(values) < len(rows) else "")
