"""Checks of an exported tree, or of one somebody else made, against what the loaders of its layout demand.

The rules are those of docs/reference/formats.md. Trees are read as strictly as on import; every violation is one line
that starts with the file it is in.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from render.exchange import frame
from render.exchange.layouts import LAYOUTS
from render.exchange.layouts.foreign_samples import MARKER, Note, Source, Truth, read_record
from render.exchange.layouts.layout_base import Layout
from render.records.manifest import SceneSpec, read_manifest
from render.records.mirror import shard_path
from render.records.shards import read_shard
from render.shared.errors import InputError, unknown
from render.shared.progress import progress_bar
from render.shared.seeds import spread_evenly

_ANGLE_TOLERANCE = 0.6  # degrees; the greatest error of rounding to 8 bits is 0.39


@dataclass
class TreeReport:
    """Result of a check: how many samples were looked at, with how many lights, what is wrong, and what may be."""

    samples: int = 0
    lights: tuple[int, int] = (0, 0)
    violations: list[str] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)


def check_tree(
    tree: str | Path, layout_name: str, *, shards: str | Path | None = None, limit: int | None = None
) -> TreeReport:
    """Check a tree.

    Args:
        tree: Its root.
        layout_name: A name of `LAYOUTS`.
        shards: Data folder it was exported from; masks, normals and lights are compared with the shards.
        limit: Look at the pictures of at most so many samples, spread evenly. Lists are always read whole.

    Raises:
        InputError: no such folder or layout, or a damaged data folder in `shards`.
    """
    if layout_name not in LAYOUTS:
        raise unknown("layout", layout_name, LAYOUTS)
    if limit is not None and limit < 1:
        raise InputError(f"limit must be at least 1, got {limit}")
    root, layout, report = Path(tree), LAYOUTS[layout_name], TreeReport()
    if not root.is_dir():
        raise InputError(f"{root}: no such folder; give the root of a {layout_name} tree")
    planned = {scene.id: scene for scene in read_manifest(shards)} if shards is not None else {}
    sources: list[Source] = []
    note = report.violations.append
    with _passing_errors(note):
        for read in layout.list_samples(root):
            with _passing_errors(note):
                sources.append(read())
    with _passing_errors(note):
        layout.check_lists(root, sources, note)
    report.samples = len(sources)
    if limit is not None and limit < len(sources):
        sources = spread_evenly(sources, limit)
    counts, sides = set(), {layout.crop}
    for source in progress_bar(sources, unit="sample", desc=f"check {layout_name}"):
        with _passing_errors(note):
            truth = _check_sample(source, layout, note)
            counts.add(len(source.images))
            sides |= set(truth.mask.shape)
            if shards is not None:
                _compare(source, truth, Path(shards), planned, note)
    if min(sides) < layout.crop:
        report.warnings.append(
            f"{root}: pictures of {min(sides)} pixels; SDPS-Net's defaults want {layout.crop}x{layout.crop}: render at "
            "that size, or set the sizes of its options"
        )
    report.lights = (min(counts, default=0), max(counts, default=0))
    return report


@contextmanager
def _passing_errors(note: Note) -> Iterator[None]:
    """Give the message of an InputError to `note`."""
    try:
        yield
    except InputError as error:
        note(str(error))


def _check_sample(source: Source, layout: Layout, note: Note) -> Truth:
    """Check the layout's own rules, and what holds for every layout: an object, light on it, a frame that fits."""
    truth = source.truth()
    images, bits = source.stack(truth.mask.shape)
    layout.check_sample(source, truth, bits, note)
    if not images[:, truth.mask].any():
        note(f"{source.folder}: all images are black on the object; raise --exposure")
    if len(source.directions) and truth.normals.any():
        for fault in frame.find_faults(images, truth.normals, truth.mask, source.directions):
            note(f"{source.folder}: {fault}; want x right, y up, z to the camera")
    return truth


def _compare(source: Source, truth: Truth, folder: Path, planned: dict[str, SceneSpec], note: Note) -> None:
    """Compare a sample with the shard its record names."""
    path = source.folder / MARKER
    scene = planned.get(str(read_record(path).get("id")))
    if scene is None:
        raise InputError(f"{path}: names no scene of {folder}; give the folder it came from")
    shard = read_shard(shard_path(folder, scene), scene)
    if not np.array_equal(shard.mask, truth.mask):
        note(f"{source.folder}: the mask differs from the shard's; export the scene again")
        return
    cosine = (shard.normals[shard.mask] * truth.normals[shard.mask]).sum(-1)
    worst = float(np.degrees(np.arccos(np.clip(cosine.min(initial=1.0), -1, 1))))
    if worst > _ANGLE_TOLERANCE:
        note(f"{source.folder}: normals differ from the shard's by {worst:.2f} degrees")
    if len(source.directions) and (
        source.directions.shape != shard.light_directions.shape
        or np.abs(source.directions - shard.light_directions).max() > 1e-5
    ):
        note(f"{source.folder}: lights differ from the shard's; export the scene again")
