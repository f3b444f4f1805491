"""The page of `sdps data preview`: from counts, measures and pictures to one HTML file."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pipelines.data.preview_sample import STAGE_COLUMNS, Sample, Stage
from pipelines.shared import charts, pictures
from render.planning.plan_counts import PlanCounts, light_directions
from render.records.manifest import SceneSpec
from render.shared.config import read_yaml
from render.shared.errors import InputError
from render.shared.files import read_json, read_jsonl
from render.shared.templates import fill

QUALITIES = (85, 70, 50)  # JPEG, the first that fits the budget
BUDGET = 4_000_000  # bytes of the scenes' strips, and of their sheets
_TEMPLATE = Path(__file__).with_name("preview.html.j2")
_SCRIPT = Path(__file__).with_name("preview.js")


def render(
    folder: Path, scenes: Sequence[SceneSpec], there: Sequence[SceneSpec], counts: PlanCounts, sample: Sample,
    shown: Sequence[tuple[SceneSpec, np.ndarray]],
) -> str:  # fmt: skip
    """Build the page.

    Args:
        folder: Data folder.
        scenes: The manifest.
        there: Its scenes that have a shard.
        counts: What the manifest holds.
        sample: What was read of the shards.
        shown: (scene, strip) of the scenes on the page.
    """
    config = _config(folder)
    directions = light_directions(scenes)
    return fill(
        _TEMPLATE,
        title=f"Data: {config.get('name') or folder.resolve().name}",
        description=config.get("description") or "",
        counts=counts,
        there=len(there),
        images=sum(len(scene.lights) for scene in there),
        bytes=float(np.mean([row.bytes for row in sample.statistics])) * len(there),
        validation=_validation(folder),
        lights=len(directions),
        plots=_plots(directions, counts, sample),
        sample=sample,
        failures=_failures(folder),
        scenes=gallery(shown),
        stages=_stages(sample.stages),
        script=_SCRIPT.read_text(encoding="utf-8"),
    )


def _config(folder: Path) -> dict[str, Any]:
    """Read the resolved preset, if the folder has one."""
    try:
        return read_yaml(folder / "config.yaml")
    except InputError:
        return {}


def _validation(folder: Path) -> dict[str, Any]:
    """Return what the last validation found; empty if there was none."""
    try:
        report = read_json(folder / "validation.json", "validate the folder again")
        found = {key: int(report[key]) for key in ("checked", "errors", "warnings")}
        return found | {"time": str(report["time"])[:10], "sound": bool(report.get("sound"))}
    except (InputError, ValueError, KeyError, TypeError, OverflowError):
        return {}


def _failures(folder: Path) -> list[dict[str, Any]] | str:
    """Return the rows of `failed.jsonl`, or why they cannot be read."""
    if not (folder / "failed.jsonl").is_file():
        return []
    try:
        return [row for row in read_jsonl(folder / "failed.jsonl") if isinstance(row, dict)]
    except InputError as error:
        return str(error)


def _plots(directions: np.ndarray, counts: PlanCounts, sample: Sample) -> dict[str, list[str]]:
    """Draw the plots of every heading as SVG."""
    rows, elevation = sample.statistics, "elevation above the image plane, degrees"
    return {
        "lights": [
            charts.light_disc_svg(directions),
            charts.histogram(charts.elevations(directions), elevation, bounds=(0, 90)),
        ],
        "materials": [
            charts.bars(counts.categories, "scenes per material category"),
            charts.bars(counts.materials, "scenes per material"),
            charts.bars(counts.families, "scenes per shape family"),
        ],
        "measured": [
            charts.histogram([row.area for row in rows], "mask area, share of the frame", bounds=(0, 1)),
            charts.histogram([row.level for row in rows], "exposure: 95th percentile of radiance", log=True),
            charts.histogram(np.concatenate(sample.slants), "slant of the normals, degrees", bounds=(0, 90)),
        ],
    }


def gallery(shown: Sequence[tuple[SceneSpec, np.ndarray]]) -> list[tuple[str, str, int, int]]:
    """Return (caption, data URI, width, height) of the scenes, of the best quality that keeps the page small."""
    uris = _encode_pictures([strip for _, strip in shown])
    return [
        (_caption(scene), uri, strip.shape[1], strip.shape[0]) for (scene, strip), uri in zip(shown, uris, strict=True)
    ]


def _stages(stages: Sequence[Stage]) -> list[dict[str, Any]]:
    """Return what the page's script needs of scenes that are shown under each light."""
    uris = _encode_pictures([stage.sheet for stage in stages])
    return [
        {
            "caption": _caption(stage.scene),
            "sheet": uri,
            "columns": STAGE_COLUMNS,
            "height": stage.size[0],
            "width": stage.size[1],
            "lights": stage.lights.astype(float).round(3).tolist(),
        }
        for stage, uri in zip(stages, uris, strict=True)
    ]


def _caption(scene: SceneSpec) -> str:
    return f"{scene.id}: {scene.shape}, {scene.material} ({scene.split})"


def _encode_pictures(shown: Sequence[np.ndarray]) -> list[str]:
    """Return data URIs of the best quality that keeps all of them below the budget."""
    for quality in QUALITIES:
        uris = [pictures.data_uri(picture, quality=quality) for picture in shown]
        if sum(map(len, uris)) <= BUDGET:
            break
    return uris
