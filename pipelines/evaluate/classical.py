"""`sdps evaluate classical`: every classical method on regenerated scenes, by kind of reflectance and of lights.

The scenes are those of the preset's `test` section under each light set, with random light intensities. The paper's
figure on PF14 (supplement: good on diffuse, bad on specular reflectance) is a row of these tables.
"""

import argparse
from dataclasses import replace
from typing import Any

from pipelines.evaluate.report.sections import Section, SectionWriter, Table
from pipelines.evaluate.score_tables import mean, publish
from pipelines.evaluate.workbench import Workbench
from pipelines.shared import presets, scenes
from pipelines.shared.flags import pick_names, split_list
from render.materials import surfaces
from render.records.manifest import SceneSpec
from sdps.classical import registry
from sdps.methods import pretrained
from sdps.methods.parse import parse
from sdps.methods.runner import Runner

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


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the flags of `sdps evaluate classical`."""
    presets.add_common_arguments(parser, default="classical")
    parser.add_argument("--methods", action="append", help=f"{', '.join(registry.METHODS)} (default: all)")
    parser.add_argument("--light-sets", action="append", help=f"default: {','.join(LIGHT_SETS)}")


def main(args: argparse.Namespace) -> int:
    """Render or reuse the scenes, run the methods, print the tables and write results.json."""
    preset, out = presets.from_arguments(args)
    names = pick_names("method", args.methods, registry.METHODS)
    runners = tuple(Runner(parse(name, pretrained.require), pretrained.require) for name in names)
    bench, rows = Workbench(preset, out, runners), []
    for lights in split_list(args.light_sets) or LIGHT_SETS:
        rows += evaluate(bench, lights)
    section = Section(name="classical", title="Classical methods on regenerated scenes", text=DEFINITION, order=50,
                      tables=tuple(build_tables(rows, names)),
                      command=f"sdps evaluate classical --out {out}")  # fmt: skip
    publish(SectionWriter(section), out, out / "results.json", {"rows": rows})
    return 0


def evaluate(bench: Workbench, lights: str) -> list[dict[str, Any]]:
    """Run the methods on the scenes under a light set; results by names that are kept in results.json."""
    test = replace(bench.config, lights=lights)
    wanted, folder = bench.render(test, bench.out / scenes.slug(lights))
    results = bench.evaluation.run(bench.objects(wanted, folder, test), bench.runners, len(wanted), lights)
    return [
        {"method": runner.method.normals, "lights": lights, "shape": scene.shape, "category": category(scene),
         "scores": result.scores, "seconds": result.seconds, "reason": result.reason}
        for scene, runner, result in results
    ]  # fmt: skip


def category(scene: SceneSpec) -> str:
    """Return the kind of reflectance; `mixed` where materials vary over the surface."""
    kinds = {component.category for component in surfaces.load(scene.material).components}
    return kinds.pop() if len(kinds) == 1 else "mixed"


def build_tables(rows: list[dict[str, Any]], names: list[str]) -> list[Table]:
    """Average over the scenes of a shape, kind of reflectance and light set."""
    tables = []
    for metric, title in TABLES.items():
        shown = [name for name in names if metric == "normal_mae" or not registry.METHODS[name].calibrated]
        for lights, shape in dict.fromkeys((row["lights"], row["shape"]) for row in rows):
            part = [row for row in rows if (row["lights"], row["shape"]) == (lights, shape)]
            kinds = list(dict.fromkeys(row["category"] for row in part))
            scores: dict[tuple[str, str], list[dict[str, float]]] = {}
            for row in part:
                scores.setdefault((row["method"], row["category"]), []).append(row["scores"])
            body = tuple((name, *(mean(scores[name, kind], metric).cell() for kind in kinds)) for name in shown)
            tables.append(Table(title=f"{title}: {shape}, {lights}", header=("method", *kinds), rows=body))
    return tables
