"""Checks of a data folder as a whole: what is there, what is planned, and what is there twice."""

import os
from collections import defaultdict
from collections.abc import Collection, Hashable, Sequence
from pathlib import Path
from typing import Any

from render.checks.known_checks import Finding
from render.planning.plan_counts import IMPORTED, family
from render.records.ledger import SHARDS
from render.records.manifest import MANIFEST, SceneSpec
from render.records.mirror import CHECKSUMS
from render.records.shards import file_hash
from render.shared.files import read_text
from render.shared.temporary import is_temporary


def read_checksums(folder: Path) -> dict[str, str]:
    """Read `checksums.txt` (lines of `sha256sum`) where there is one: {relative path: SHA-256}."""
    path = folder / CHECKSUMS
    if not path.is_file():
        return {}
    rows = (line.split(maxsplit=1) for line in read_text(path).splitlines() if line.strip())
    return {row[1].lstrip("*"): row[0] for row in rows if len(row) == 2}


def check_folder(
    folder: Path, scenes: Sequence[SceneSpec], present: Collection[str], sums: dict[str, str]
) -> list[Finding]:
    """Check the manifest against itself, its checksum and the files.

    Args:
        folder: Data folder.
        scenes: The manifest.
        present: Ids of the scenes that have a shard file.
        sums: Checksums by relative path, see `read_checksums`.
    """
    findings = []
    if MANIFEST in sums and sums[MANIFEST] != file_hash(folder / MANIFEST):
        findings.append(Finding("checksum", MANIFEST, f"SHA-256 differs from {CHECKSUMS}"))
    ids = [scene.id for scene in scenes]
    for name, numbers in _groups(ids).items():
        findings.append(
            Finding("ids", name, f"manifest lines {', '.join(map(str, numbers))} have this id", len(numbers))
        )
    # The sampler's seed and the split do not make another sample.
    kinds = [_kind(scene) for scene in scenes]
    for numbers in _groups(kinds).values():
        first, *others = (ids[number - 1] for number in numbers)
        message = f"same shape, material, view and lights as {', '.join(others[:5])}"
        findings.append(Finding("twins", first, message, len(numbers)))
    unplanned = sorted(f"{SHARDS}/{id}.exr" for id in set(present) - set(ids))
    findings += [Finding("unplanned", name, "no manifest line") for name in unplanned]
    for place in (folder, folder / SHARDS):
        if place.is_dir():
            names = sorted(entry.name for entry in os.scandir(place) if is_temporary(entry.name))
            findings += [Finding("temporary", str((place / name).relative_to(folder)), "left behind") for name in names]
    return findings


def _kind(scene: SceneSpec) -> tuple[Hashable, ...]:
    """Return what makes a scene a sample of its own; nothing says that imported scenes of one name show one view."""
    imported = scene.id if family(scene.shape) == IMPORTED else ""
    lights = (scene.lights, scene.light_distances)
    return scene.shape, scene.material, scene.view, lights, scene.size, imported


def _groups(items: Sequence[Any]) -> dict[Any, list[int]]:
    """Return {item: line numbers from 1} of the items that occur more than once."""
    places = defaultdict(list)
    for number, item in enumerate(items, start=1):
        places[item].append(number)
    return {item: numbers for item, numbers in places.items() if len(numbers) > 1}


def find_duplicates(pixels: dict[str, list[str]]) -> list[Finding]:
    """Find scenes of different ids whose images are the same bytes."""
    return [
        Finding("duplicates", first, f"same pixels as {', '.join(others[:5])}", len(others))
        for first, *others in pixels.values()
        if others
    ]
