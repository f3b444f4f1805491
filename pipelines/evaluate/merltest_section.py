"""What the report shows of MERL-Test scenes: tables, pictures from the best to the worst, every scene's scores."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from pipelines.evaluate.evaluation import Evaluation
from pipelines.evaluate.lit import lit_object
from pipelines.evaluate.merltest_tables import SceneScores, definition
from pipelines.evaluate.object_pictures import ERROR_LIMIT, tiles
from pipelines.report.sections import Section, SectionWriter, Table
from pipelines.shared.presets import Preset
from sdps.methods.runner import Runner

_METRICS = (("normal_mae", "normals", 2), ("direction_mae", "directions", 2), ("intensity_error", "intensities", 3))


def write(
    out: Path,
    preset: Preset,
    tables: Sequence[Table],
    results: Sequence[SceneScores],
    folder: Path,
    evaluation: Evaluation,
    runners: Sequence[Runner],
    networks: str,
) -> Path:
    """Write the section.

    Args:
        out: The run's folder.
        preset: What was run.
        tables: Tables A and B.
        results: Scores of every scene.
        folder: The rendered scenes.
        evaluation: Holds the normal maps.
        runners: The methods whose pictures are shown, the main one first.
        networks: How networks were used, in words.
    """
    config = preset.test
    repeats = f"{config.repeats} draws of intensities" if config.repeats > 1 else "one draw of intensities"
    text = (
        f"{len(results)} scenes of {config.size}x{config.size} pixels, {len(results[0].scene.lights)} lights, "
        f"{repeats}. {definition(config)}{networks} "
        f"Error maps run from 0 (black) to {ERROR_LIMIT:g} degrees (yellow)."
    )
    names = [runner.method.name for runner in runners]
    section = Section(
        name="merltest",
        title="MERL-Test scenes",
        text=text,
        order=10,
        tables=tuple(tables),
        command=f"sdps eval-merltest --preset {preset.name} --out {out}",
    )
    writer = SectionWriter(section)
    for result in choose(results, names[0], config.pictures):
        item = lit_object(result.scene, folder, config)
        found = {
            runner.method.name: {item.name: evaluation.result(item, runner, keep_normals=True)} for runner in runners
        }
        writer.strip(f"{result.scene.shape}, {result.scene.material}", tiles(item, found, names))
    single = Section(name="merltest-scenes", title="MERL-Test, scene by scene", text="", order=15,
                     tables=(_per_scene(results, names),))  # fmt: skip
    SectionWriter(single).write(out)
    return writer.write(out)


def choose(results: Sequence[SceneScores], name: str, count: int) -> list[SceneScores]:
    """Pick scenes of each shape spread from the best to the worst normal error, so the page shows both ends."""
    chosen = []
    for shape in dict.fromkeys(result.scene.shape for result in results):
        ranked = sorted((r for r in results if r.scene.shape == shape), key=lambda r: _error(r, name))
        places = np.unique(np.linspace(0, len(ranked) - 1, count).round().astype(int))
        chosen += [ranked[place] for place in places]
    return chosen


def _error(result: SceneScores, name: str) -> float:
    return result.scores[name].get("normal_mae", np.inf)


def _per_scene(results: Sequence[SceneScores], names: Sequence[str]) -> Table:
    """Return one line per scene, worst first."""
    wanted = [
        (name, metric, about, digits)
        for name in names
        for metric, about, digits in _METRICS
        if any(metric in result.scores[name] for result in results)
    ]

    def cell(scores: dict[str, float], metric: str, digits: int) -> str:
        return f"{scores[metric]:.{digits}f}" if metric in scores else "-"

    rows = [
        (r.scene.shape, r.scene.material, *(cell(r.scores[name], metric, digits) for name, metric, _, digits in wanted))
        for r in sorted(results, key=lambda r: _error(r, names[0]), reverse=True)
    ]
    header = ("shape", "material", *(f"{name}: {about}" for name, _, about, _ in wanted))
    return Table(title="Per scene, worst first", header=header, rows=tuple(rows))
