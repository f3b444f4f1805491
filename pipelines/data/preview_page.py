"""The page of `sdps data preview`: from counts, measures and pictures to one HTML file."""

import html
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from string import Template
from typing import TYPE_CHECKING, Any

import numpy as np

from pipelines.data import preview_plots
from pipelines.shared import pictures
from render.planning.composition import Composition, light_directions
from render.records.manifest import SceneSpec
from render.shared.config import read_yaml
from render.shared.errors import InputError
from render.shared.files import read_jsonl, read_text

if TYPE_CHECKING:
    from pipelines.data.preview_sample import Sample

FAILURES = 12  # shown
QUALITIES = (85, 70, 50)  # JPEG, the first that fits the budget
BUDGET = 4_000_000  # bytes of all pictures of scenes


def render(
    folder: Path, scenes: Sequence[SceneSpec], there: Sequence[SceneSpec], counts: Composition, sample: "Sample",
    shown: Sequence[tuple[SceneSpec, np.ndarray]],
) -> str:  # fmt: skip
    """Build the page.

    Args:
        folder: Data folder.
        scenes: The manifest.
        there: Its scenes that have a shard.
        counts: Composition of the manifest.
        sample: What was read of the shards.
        shown: (scene, strip) of the scenes on the page.
    """
    template = Template((Path(__file__).parent / "preview.html").read_text(encoding="utf-8"))
    config = _config(folder)
    directions = light_directions(scenes)
    elevations = preview_plots.elevations(directions)
    return template.substitute(
        title=html.escape(f"Data: {config.get('name') or folder.resolve().name}"),
        description=html.escape(str(config.get("description") or "")),
        facts=_facts(scenes, there, counts, sample),
        verdict=_verdict(folder),
        composition=_composition(counts),
        lights=_figures(
            preview_plots.light_disc(directions),
            preview_plots.histogram(elevations, "elevation above the image plane, degrees", bounds=(0, 90)),
        ),
        light_note=f"{len(directions):,} lights of {counts.views:,} views, seen from the camera. Dotted rings mark the "
        "elevation above the image plane; at 90 degrees light comes from the camera.",
        materials=_figures(
            preview_plots.bars(counts.categories, "scenes per material category"),
            preview_plots.bars(counts.materials, "scenes per material"),
            preview_plots.bars(counts.families, "scenes per shape family"),
        ),
        names=_names(counts),
        measured=_measured(sample, len(there)),
        failures=_failures(folder),
        scene_note=f"{len(shown)} of {len(there):,} rendered scenes: normals, then images under one exposure per scene "
        "(spatially-varying scenes show their material weights second).",
        scenes=scene_gallery(shown),
    )


def _config(folder: Path) -> dict[str, Any]:
    """Read the resolved preset, if the folder has one."""
    try:
        return read_yaml(folder / "config.yaml")
    except InputError:
        return {}


def _facts(scenes: Sequence[SceneSpec], there: Sequence[SceneSpec], counts: Composition, sample: "Sample") -> str:
    """Render the numbers at the top."""
    size = np.mean([row.bytes for row in sample.statistics]) if sample.statistics else 0.0
    pairs = [
        (f"{len(there):,} of {len(scenes):,}", "scenes rendered"),
        (f"{sum(len(scene.lights) for scene in there):,}", "images"),
        (f"{counts.shapes:,}", "shapes"),
        (f"{counts.views:,}", "views"),
        (f"{len(counts.materials):,}", "materials"),
        (f"{counts.varying / counts.scenes:.0%}", "spatially varying"),
        (_size(size * len(there)), "on disk, about"),
    ]
    return "".join(f"<div><b>{html.escape(value)}</b><span>{html.escape(name)}</span></div>" for value, name in pairs)


def _size(count: float | np.floating) -> str:
    for unit in ("B", "kB", "MB", "GB"):
        if count < 1000:
            return f"{count:.3g} {unit}"
        count /= 1000
    return f"{count:.3g} TB"


def _verdict(folder: Path) -> str:
    """Tell what the last validation found, if there was one."""
    try:
        report = json.loads(read_text(folder / "validation.json"))
        checked, errors, warnings = (int(report[key]) for key in ("checked", "errors", "warnings"))
        when = str(report["time"])[:10]
    except (InputError, ValueError, KeyError, TypeError):
        return '<p class="note">Not validated yet: run <code>sdps data validate</code>.</p>'
    word = "sound" if report.get("sound") else '<b class="bad">not sound</b>'
    return f"<p>Validated on {html.escape(when)}: {word}; {checked:,} shards, {errors} errors, {warnings} warnings.</p>"


def _composition(counts: Composition) -> str:
    """Render the composition per family, and what all scenes share."""
    rows = [
        [name, f"{count:,}", f"{shapes:,}", f"{views:,}", f"{count / counts.scenes:.1%}"]
        for name, (count, shapes, views) in counts.per_family.items()
    ]
    rows.append(["all", f"{counts.scenes:,}", f"{counts.shapes:,}", f"{counts.views:,}", "100%"])
    shared = [
        ["split", _spelled(counts.splits)],
        ["lights per scene", _spelled(counts.light_counts)],
        ["image side, pixels", _spelled(counts.sizes)],
        ["samples per pixel", _spelled(counts.spp)],
        ["interreflection bounces", _spelled(counts.bounces)],
        ["spatially-varying scenes", f"{counts.varying:,}"],
    ]
    return _table(["shape family", "scenes", "shapes", "views", "share"], rows) + "<p></p>" + _table(None, shared)


def _spelled(values: Mapping[Any, int]) -> str:
    """Spell counts: the value alone when there is one, else each with its number of scenes."""
    if len(values) == 1:
        return str(next(iter(values)))
    return ", ".join(f"{value}: {count:,}" for value, count in values.items())


def _table(header: list[str] | None, rows: list[list[str]]) -> str:
    """Render a table; its first column is text."""
    head = f"<thead><tr>{''.join(f'<th>{html.escape(cell)}</th>' for cell in header)}</tr></thead>" if header else ""
    body = "".join(f"<tr>{''.join(f'<td>{html.escape(cell)}</td>' for cell in row)}</tr>" for row in rows)
    return f"<table>{head}<tbody>{body}</tbody></table>"


def _figures(*plots: str) -> str:
    return "".join(f"<figure>{plot}</figure>" for plot in plots)


def _names(counts: Composition) -> str:
    """List every material with its number of scenes, folded away."""
    items = "".join(f"<li>{html.escape(name)}: {count:,}</li>" for name, count in counts.materials.items())
    return f'<details><summary>All {len(counts.materials)} materials</summary><ul class="names">{items}</ul></details>'


def _measured(sample: "Sample", there: int) -> str:
    """Render the histograms of what was measured on the shards that were read."""
    rows = sample.statistics
    plots = _figures(
        preview_plots.histogram([row.area for row in rows], "mask area, share of the frame", bounds=(0, 1)),
        preview_plots.histogram([row.level for row in rows], "exposure: 95th percentile of radiance", log=True),
        preview_plots.histogram(np.concatenate(sample.slants), "slant of the normals, degrees", bounds=(0, 90)),
    )
    note = f"From {len(rows):,} of {there:,} shards. A white Lambertian surface facing the light has radiance 1."
    damaged = ""
    if sample.damaged:
        names = html.escape(", ".join(sample.damaged[:5]))
        damaged = (
            f'<p class="bad">{len(sample.damaged)} shards could not be read ({names}): run sdps data validate.</p>'
        )
    return f'{damaged}<div class="plots">{plots}</div><p class="note">{note}</p>'


def _failures(folder: Path) -> str:
    """List the newest failures of `failed.jsonl`."""
    path = folder / "failed.jsonl"
    if not path.is_file():
        return "<p>None recorded.</p>"
    try:
        rows = [row for row in read_jsonl(path) if isinstance(row, dict)]
    except InputError as error:
        return f'<p class="bad">{html.escape(str(error))}</p>'
    if not rows:
        return "<p>None recorded.</p>"
    body = ""
    for row in rows[-FAILURES:]:
        cells = "".join(f"<td>{html.escape(str(row.get(key, '')))}</td>" for key in ("id", "seed", "shape", "material"))
        body += f'<tr>{cells}<td class="long">{html.escape(str(row.get("reason", ""))[:300])}</td></tr>'
    head = "".join(f"<th>{name}</th>" for name in ("scene", "seed", "shape", "material", "reason"))
    more = f"the newest {FAILURES} of " if len(rows) > FAILURES else ""
    return (
        f'<p>{more}{len(rows)} failures; <code>sdps render-data --retry-failed</code> tries them again.</p>'
        f'<div class="wide"><table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table></div>'
    )  # fmt: skip


def scene_gallery(shown: Sequence[tuple[SceneSpec, np.ndarray]]) -> str:
    """Render strips with captions, of the best quality that keeps the page small."""
    gallery = ""
    for quality in QUALITIES:
        gallery = "".join(_scene(scene, strip, quality) for scene, strip in shown)
        if len(gallery) <= BUDGET:
            break
    return gallery


def _scene(scene: SceneSpec, strip: np.ndarray, quality: int) -> str:
    """Render one scene: its strip and a caption."""
    text = html.escape(f"{scene.id}: {scene.shape}, {scene.material} ({scene.split})")
    uri = pictures.data_uri(strip, quality=quality)
    height, width = strip.shape[:2]
    return (
        f'<figure><img src="{uri}" alt="{text}" width="{width}" height="{height}" loading="lazy">'
        f"<figcaption>{text}</figcaption></figure>"
    )
