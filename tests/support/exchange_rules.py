"""Checks of an exported tree against what the loaders of its layout demand.

The rules are those of docs/reference/formats.md. Reading goes through the strict readers of this package; every
violation is one line that starts with the file it is in.
"""

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from exchange_loaders import SAMPLES, Pictures, Samples

from render.exchange import frame
from render.exchange.folders import MARKER, read_record
from render.exchange.foreign_samples import Note, noted
from render.exchange.layouts import LAYOUTS
from render.records.manifest import SceneSpec, read_manifest
from render.records.mirror import shard_path
from render.records.shards import read_shard
from render.shared.errors import InputError, unknown
from render.shared.progress import progress_bar

_CROP = 128  # pixels; what the authors' trainers cut pictures to where nothing else is said
_ANGLE_TOLERANCE = 0.6  # degrees; the greatest error of rounding to 8 bits is 0.39


@dataclass
class RuleReport:
    """Result of a check: how many samples were looked at, with how many lights, what is wrong, and what may be."""

    samples: int = 0
    lights: tuple[int, int] = (0, 0)
    violations: list[str] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)


def check_tree(
    tree: str | Path, layout: str, *, source: str | Path | None = None, limit: int | None = None
) -> RuleReport:
    """Check a tree.

    Args:
        tree: Its root.
        layout: A name of `LAYOUTS`.
        source: Data folder it was exported from; masks, normals and lights are compared with the shards.
        limit: Look at the pictures of at most so many samples, spread evenly. Lists are always read whole.

    Raises:
        InputError: no such folder or layout, or a damaged data folder in `source`.
    """
    if layout not in LAYOUTS:
        raise unknown("layout", layout, LAYOUTS)
    root, report = Path(tree), RuleReport()
    if not root.is_dir():
        raise InputError(f"{root}: no such folder; give the root of a {layout} tree")
    planned = {scene.id: scene for scene in read_manifest(source)} if source is not None else {}
    samples: Samples = []
    note = report.violations.append
    with noted(note):
        samples = SAMPLES[layout](root, note)
    report.samples = len(samples)
    if limit is not None and limit < len(samples):
        samples = [samples[place] for place in np.linspace(0, len(samples) - 1, limit).round().astype(int)]
    counts, least = set(), _CROP
    for load in progress_bar(samples, unit="sample", desc=f"check {layout}"):
        with noted(note):
            pictures = load()
            counts.add(len(pictures.images))
            least = min(least, *pictures.mask.shape)
            _check_pictures(pictures, note)
            if source is not None:
                _compare(pictures, Path(source), planned, note)
    if layout == "psfcn" and least < _CROP:
        report.warnings.append(
            f"{root}: pictures of {least} pixels; SDPS-Net's defaults want {_CROP}x{_CROP}: render at that size, or "
            "set the sizes of its options"
        )
    report.lights = (min(counts, default=0), max(counts, default=0))
    return report


def _check_pictures(pictures: Pictures, note: Note) -> None:
    """Check what holds for every layout: an object, light on it, and a frame that fits."""
    if not pictures.mask.any():
        note(f"{pictures.folder}: the mask is empty; mark the object")
        return
    dark = int((pictures.images[:, pictures.mask].max((1, 2)) == 0).sum())
    if dark == len(pictures.images):
        note(f"{pictures.folder}: all images are black on the object; raise --exposure")
    if pictures.directions is not None and pictures.normals.any():
        for fault in frame.faults(pictures.images, pictures.normals, pictures.mask, pictures.directions):
            note(f"{pictures.folder}: {fault}; want x right, y up, z to the camera")


def _compare(pictures: Pictures, source: Path, planned: dict[str, SceneSpec], note: Note) -> None:
    """Compare a sample with the shard its record names."""
    scene = planned.get(str(read_record(pictures.folder / MARKER).get("id")))
    if scene is None:
        raise InputError(f"{pictures.folder / MARKER}: names no scene of {source}; give the folder it came from")
    shard = read_shard(shard_path(source, scene), scene)
    if not np.array_equal(shard.mask, pictures.mask):
        note(f"{pictures.folder}: the mask differs from the shard's; export the scene again")
        return
    cosine = (shard.normals[shard.mask] * pictures.normals[shard.mask]).sum(-1)
    worst = float(np.degrees(np.arccos(np.clip(cosine.min(initial=1.0), -1, 1))))
    if worst > _ANGLE_TOLERANCE:
        note(f"{pictures.folder}: normals differ from the shard's by {worst:.2f} degrees")
    if pictures.directions is not None and (
        pictures.directions.shape != shard.light_directions.shape
        or np.abs(pictures.directions - shard.light_directions).max() > 1e-5
    ):
        note(f"{pictures.folder}: lights differ from the shard's; export the scene again")
