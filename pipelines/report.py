"""The page: one self-contained HTML file with tables, curves and pictures."""

import html
from pathlib import Path
from string import Template
from typing import TYPE_CHECKING

import numpy as np

from pipelines import pictures
from pipelines.presets import Preset
from render.errors import InputError
from render.files import read_jsonl, write_text
from render.manifest import read_manifest

if TYPE_CHECKING:
    from pipelines.eval_merltest import SceneResult

CURVES = (
    ("val_direction_mae", "light direction, degrees"),
    ("val_normal_mae", "normals, degrees"),
    ("loss", "training loss"),
)
ERROR_LIMIT = 45.0


def write(path: Path, preset: Preset, tables: dict, results: list["SceneResult"], out: Path) -> None:
    """Write the report of an evaluation to `path`.

    Args:
        path: The HTML file.
        preset: What was run.
        tables: {title: (header, rows)} from `eval_merltest.build_tables`.
        results: `SceneResult` of every scene.
        out: The run's folder, whose training logs and data are shown where present.
    """
    template = Template((Path(__file__).parent / "report.html").read_text(encoding="utf-8"))
    from pipelines.eval_merltest import DEFINITION

    page = template.substitute(
        title=html.escape(f"SDPS-Net, preset {preset.name}"),
        description=html.escape(preset.description),
        tables="".join(_table(title, *table) for title, table in tables.items()),
        definition=html.escape(DEFINITION),
        scenes="".join(_scene(result) for result in choose(results, preset.test.pictures)),
        materials=_per_material(results),
        curves=_curves(out),
        training=_training_scenes(out / "data"),
        limit=f"{ERROR_LIMIT:g}",
    )
    write_text(path, page)


def choose(results: list["SceneResult"], count: int) -> list["SceneResult"]:
    """Pick scenes of each shape spread from the best to the worst normal error, so the page shows both ends."""
    chosen = []
    for shape in dict.fromkeys(result.scene.shape for result in results):
        ranked = sorted((r for r in results if r.scene.shape == shape), key=_error)
        places = np.unique(np.linspace(0, len(ranked) - 1, count).round().astype(int))
        chosen += [ranked[place] for place in places]
    return chosen


def _error(result: "SceneResult") -> float:
    return result.scores[result.shown[0]].get("normal_mae", np.inf)


def _table(title: str, header: list[str], rows: list[list[str]]) -> str:
    """Render one table; published rows are marked by their class."""
    head = "".join(f"<th>{html.escape(cell)}</th>" for cell in header)
    body = "".join(
        f'<tr class="{"paper" if row[0].startswith("paper") else "ours"}">'
        + "".join(f"<td>{html.escape(cell)}</td>" for cell in row)
        + "</tr>"
        for row in rows
    )
    caption = html.escape(title)
    return f"<table><caption>{caption}</caption><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>"


def _scene(result: "SceneResult") -> str:
    """Render the pictures of one scene: input, truth, normals and errors of the methods shown, lights."""
    from sdps.metrics import normal_error_map

    mask = result.mask
    exposure = pictures.auto_exposure(result.picture[None], mask)
    tiles = [
        ("input", pictures.tone_map(result.picture, exposure)),
        ("true normals", pictures.normal_map(result.truth, mask)),
    ]
    for name, normals in result.normals.items():
        errors = normal_error_map(normals, result.truth, mask)
        tiles += [
            (f"normals, {name}", pictures.normal_map(normals, mask)),
            (f"error, {np.nanmean(errors):.1f}°", pictures.error_map(errors, ERROR_LIMIT)),
        ]
    directions = result.scores[result.shown[0]].get("direction_mae")
    if len(result.lights) and directions is not None:
        text = f"lights, {directions:.1f}°"
        tiles.append((text, pictures.light_plot(result.true_lights, result.lights)))
    figures = "".join(
        f'<figure><img src="{pictures.data_uri(picture)}" alt="{html.escape(text)}">'
        f"<figcaption>{html.escape(text)}</figcaption></figure>"
        for text, picture in tiles
    )
    name = html.escape(f"{result.scene.shape}, {result.scene.material}")
    return f'<section class="scene"><h3>{name}</h3><div class="strip">{figures}</div></section>'


def _per_material(results: list["SceneResult"]) -> str:
    """Render one line per scene, worst first."""
    wanted = [
        (name, metric, digits)
        for name in results[0].shown
        for metric, digits in (("normal_mae", 2), ("direction_mae", 2), ("intensity_error", 3))
        if any(metric in result.scores[name] for result in results)
    ]

    def cell(scores: dict[str, float], metric: str, digits: int) -> str:
        return f"{scores[metric]:.{digits}f}" if metric in scores else "-"

    rows = [
        [r.scene.shape, r.scene.material, *(cell(r.scores[name], metric, digits) for name, metric, digits in wanted)]
        for r in sorted(results, key=_error, reverse=True)
    ]
    about = {"normal_mae": "normals", "direction_mae": "directions", "intensity_error": "intensities"}
    header = ["shape", "material", *(f"{name}: {about[metric]}" for name, metric, _ in wanted)]
    return _table("Per scene, worst first", header, rows)


def _curves(out: Path) -> str:
    """Plot the training curves found in the run's folders."""
    series: dict[str, list] = {key: [] for key, _ in CURVES}
    for path in sorted((out / "models").glob("*/metrics.jsonl")):
        rows, minutes = [], 0.0
        for row in read_jsonl(path):
            minutes = row.get("seconds", minutes * 60) / 60
            rows.append((minutes, row))
        for key in series:
            points = [(when, row[key]) for when, row in rows if key in row]
            if points:
                series[key].append((path.parent.name, *np.array(points).T))
    figures = []
    for key, text in CURVES:
        # Losses of different models are different quantities: a plot each.
        groups = [series[key]] if key != "loss" else [[one] for one in series[key]]
        for group in groups:
            if group:
                title = text if len(group) > 1 else f"{group[0][0]}: {text}"
                source = pictures.data_uri(pictures.curve_plot(group, title))
                figures.append(f'<figure><img src="{source}" alt="{html.escape(title)} over training"></figure>')
    return f'<div class="strip">{"".join(figures)}</div>' if figures else "<p>No training logs in this folder.</p>"


def _training_scenes(folder: Path) -> str:
    """Show some of the training scenes rendered in this run."""
    try:
        sheet = pictures.scene_sheet(read_manifest(folder), folder, count=18)
    except InputError:
        return "<p>No training scenes in this folder.</p>"
    alt = "training scenes: normals and three of the images"
    return f'<img class="sheet" src="{pictures.data_uri(sheet)}" alt="{alt}">'
