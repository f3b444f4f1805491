"""What the report shows of MERL-Test scenes: tables, pictures from the best to the worst, every scene's scores."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from pipelines import eval_merltest, pictures
from pipelines.evaluation import Evaluation, TestObject
from pipelines.lit import lit_object
from pipelines.merltest_tables import SceneScores
from pipelines.presets import Preset
from pipelines.sections import Section, SectionWriter, Table
from sdps.methods import Runner

ERROR_LIMIT = 45.0
_METRICS = (("normal_mae", "normals", 2), ("direction_mae", "directions", 2), ("intensity_error", "intensities", 3))


def write(
    out: Path,
    preset: Preset,
    tables: Sequence[Table],
    results: Sequence[SceneScores],
    folder: Path,
    evaluation: Evaluation,
    runners: Sequence[Runner],
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
    """
    config = preset.test
    repeats = f"{config.repeats} draws of intensities" if config.repeats > 1 else "one draw of intensities"
    text = (
        f"{len(results)} scenes of {config.size}x{config.size} pixels, {len(results[0].scene.lights)} lights, "
        f"{repeats}. {eval_merltest.DEFINITION} Error maps run from 0 (black) to {ERROR_LIMIT:g} degrees (yellow)."
    )
    names = [runner.method.name for runner in runners]
    section = Section(
        name="merltest",
        title="MERL-Test scenes",
        text=text,
        order=10,
        tables=(*tables, _per_scene(results, names)),
        command=f"sdps eval-merltest --preset {preset.name} --out {out}",
    )
    writer = SectionWriter(section)
    for result in choose(results, names[0], config.pictures):
        item = lit_object(result.scene, folder, config)
        title = f"{result.scene.shape}, {result.scene.material}"
        writer.strip(title, object_tiles(item, evaluation, runners))
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


def object_tiles(item: TestObject, evaluation: Evaluation, runners: Sequence[Runner]) -> list[tuple[str, object]]:
    """Return (caption, picture) of an object: input, truth, normals and errors of the methods, lights of the first."""
    from sdps.metrics import direction_mae, normal_error_map

    images, mask = item.load(), item.mask
    brightest = images[int(np.argmax(images[:, mask].mean((1, 2))))]
    tiles = [("input", pictures.tone_map(brightest, pictures.auto_exposure(brightest[None], mask)))]
    if item.normals is not None:
        tiles.append(("true normals", pictures.normal_map(item.normals, mask)))
    lights = []
    for number, runner in enumerate(runners):
        result = evaluation.result(item, runner, keep_normals=True)
        normals = result.normals()
        if normals is None:
            continue
        tiles.append((f"normals, {runner.method.name}", pictures.normal_map(normals, mask)))
        if item.normals is not None:
            errors = normal_error_map(normals, item.normals, mask)
            tiles.append((f"error, {np.nanmean(errors):.1f}°", pictures.error_map(errors, ERROR_LIMIT)))
        if number == 0 and "direction_mae" in result.scores:
            value = direction_mae(result.light_directions, item.light_directions)
            plot = pictures.light_plot(item.light_directions, result.light_directions)
            lights.append((f"lights, {value:.1f}°", plot))
    return tiles + lights


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
