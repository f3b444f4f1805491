"""Checking a data folder: every shard by itself, against its manifest line, and against the others.

One shard is in memory at a time (per process); of each only its findings, a few numbers and the digest of its pixels
are kept, so that memory does not depend on the number of lights or pixels.
"""

import hashlib
import multiprocessing
from collections import defaultdict
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import asdict, dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from render.backend.orphans import end_with_parent
from render.checks.folder_checks import CHECKSUMS, check_folder, find_duplicates, read_checksums
from render.checks.known_checks import CHECKS, ERROR, WARNING, Finding, check_shard
from render.checks.shard_checks import Limits
from render.checks.statistics import SceneStatistics, measure, summarise
from render.records.ledger import shard_sizes
from render.records.manifest import MANIFEST, SceneSpec, read_manifest
from render.records.mirror import shard_path
from render.records.shards import file_hash, read_shard
from render.shared.config import to_plain
from render.shared.errors import InputError
from render.shared.files import write_json
from render.shared.progress import progress_bar
from render.shared.seeds import spread_evenly

REPORT = "validation.json"
LISTED = 200  # findings per check in the report; their number is always given


@dataclass(frozen=True)
class ShardResult:
    """What one shard came to: findings, measures and SHA-256 of its pixels (none if unreadable), spatially varying."""

    scene: str
    findings: tuple[Finding, ...]
    statistics: SceneStatistics | None = None
    pixels: str = ""
    varying: bool = False


@dataclass(frozen=True)
class Validation:
    """What a folder came to.

    Attributes:
        folder: The data folder.
        planned: Lines of the manifest.
        left: Lines without a shard.
        checked: Shards looked at.
        findings: All findings, in the order of the checks, the worst first.
        statistics: Per measure, its spread over the shards (`render.checks.statistics.summarise`).
        limits: Thresholds.
        manifest: SHA-256 of the manifest.
        skipped: Checks that had nothing to look at (no `checksums.txt`, no material weights).
    """

    folder: Path
    planned: int
    left: int
    checked: int
    findings: tuple[Finding, ...]
    statistics: dict[str, dict[str, float]]
    limits: Limits
    manifest: str
    skipped: tuple[str, ...] = ()

    def count(self, level: str) -> int:
        """Return the number of findings of a level."""
        return sum(CHECKS[finding.check].level == level for finding in self.findings)

    @property
    def sound(self) -> bool:
        """True when shards were checked and nothing of level error was found."""
        return self.checked > 0 and self.count(ERROR) == 0

    def of(self, check: str) -> list[Finding]:
        """Return the findings of one check, worst first."""
        return [finding for finding in self.findings if finding.check == check]


def validate(
    folder: str | Path, *, limits: Limits | None = None, workers: int = 1, limit: int | None = None
) -> Validation:
    """Check the shards of a data folder that are there.

    Args:
        folder: Data folder with a manifest.
        limits: Thresholds; the defaults when omitted.
        workers: Processes; 1 checks in this one.
        limit: Check at most this many shards, spread evenly over the manifest.

    Raises:
        InputError: not a data folder, or a worker process died.
    """
    folder, limits = Path(folder), limits or Limits()
    if workers < 1 or (limit is not None and limit < 1):
        raise InputError("--workers and --limit must be at least 1")
    scenes = read_manifest(folder)
    present = shard_sizes(folder)
    # An id that stands twice in the manifest is one file.
    once = {scene.id: scene for scene in reversed(scenes) if scene.id in present}
    there = [scene for scene in scenes if once.get(scene.id) is scene]
    chosen = there
    if limit is not None and limit < len(there):
        chosen = spread_evenly(there, limit)
    sums = read_checksums(folder)
    findings, statistics, pixels = check_folder(folder, scenes, present, sums), [], defaultdict(list)
    varying = False
    tasks = [(str(folder), scene, limits, sums.get(scene.file) if sums else None) for scene in chosen]
    with progress_bar(total=len(tasks), unit="shard", desc="validate", disable=None if tasks else True) as bar:
        for result in _results(tasks, workers):
            findings += result.findings
            if result.statistics:
                statistics.append(result.statistics)
            varying |= result.varying
            if result.pixels:
                pixels[result.pixels].append(result.scene)
            bar.update()
    findings += find_duplicates(pixels)
    return Validation(
        folder=folder,
        planned=len(scenes),
        left=sum(scene.id not in present for scene in scenes),
        checked=len(chosen),
        findings=tuple(sorted(findings, key=_rank)),
        statistics=_summarise_measures(statistics),
        limits=limits,
        manifest=file_hash(folder / MANIFEST),
        skipped=tuple(name for name, has in (("checksum", sums), ("weights", varying)) if not has),
    )


def check_one(task: tuple[str, SceneSpec, Limits, str | None]) -> ShardResult:
    """Check one shard: (folder, manifest line, limits, SHA-256 from checksums.txt or None)."""
    folder, scene, limits, expected = task
    findings: list[Finding] = []
    try:
        path = shard_path(Path(folder), scene)
    except InputError as error:
        return ShardResult(scene.id, (Finding("file", scene.id, str(error)),))
    if expected is not None and file_hash(path) != expected:
        findings.append(Finding("checksum", scene.id, f"SHA-256 differs from {CHECKSUMS}", 1.0))
    try:
        shard = read_shard(path, scene)
    except InputError as error:
        # A file that is sound by itself but not what the manifest says is still worth the other checks.
        try:
            shard = read_shard(path)
        except InputError as broken:
            return ShardResult(scene.id, (*findings, Finding("file", scene.id, _without_remedy(broken, path))))
        findings.append(Finding("manifest", scene.id, _without_remedy(error, path)))
    checked = [replace(finding, where=scene.id) for finding in check_shard(shard, limits)]
    finite = not any(finding.check == "values" for finding in checked)
    return ShardResult(
        scene=scene.id,
        findings=(*findings, *checked),
        statistics=measure(shard, path.stat().st_size) if finite else None,
        pixels=hashlib.sha256(shard.images.data).hexdigest(),
        varying=shard.weights is not None,
    )


def _without_remedy(error: InputError, path: Path) -> str:
    """Cut the path and the remedy off a reader's message; the summary has both in their own places."""
    return str(error).removeprefix(f"{path}: ").split(";")[0]


def _results(tasks: Sequence[tuple[str, SceneSpec, Limits, str | None]], workers: int) -> Iterator[ShardResult]:
    """Check the shards here or in several processes, in order."""
    if workers == 1 or len(tasks) < 2:
        yield from map(check_one, tasks)
        return
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(min(workers, len(tasks)), context, initializer=end_with_parent) as pool:
        try:
            yield from pool.map(check_one, tasks, chunksize=max(1, min(16, len(tasks) // (4 * workers))))
        except BrokenProcessPool as error:
            raise InputError("a checking process died, likely for want of memory; use fewer --workers") from error


def _rank(finding: Finding) -> tuple[int, float, str]:
    """Return what findings are sorted by: check, then severity, the worst first."""
    return list(CHECKS).index(finding.check), -finding.severity, finding.where


def _summarise_measures(statistics: Sequence[SceneStatistics]) -> dict[str, dict[str, float]]:
    """Summarise each measure over the shards."""
    if not statistics:
        return {}
    rows = [asdict(row) for row in statistics]
    return {name: summarise([row[name] for row in rows]) for name in rows[0]}


def to_report(result: Validation) -> dict[str, Any]:
    """Turn a validation into the plain mapping of `validation.json`; findings beyond 200 per check are only counted."""
    checks = []
    for check in CHECKS.values():
        found = result.of(check.name)
        checks.append(
            {
                "name": check.name, "level": check.level, "about": check.about, "remedy": check.remedy,
                "findings": len(found), "scenes": len({finding.where for finding in found}),
                "worst": [{"where": f.where, "message": f.message} for f in found[:LISTED]],
            }
        )  # fmt: skip
    return {
        "schema": 1,
        "time": datetime.now(UTC).isoformat(timespec="seconds"),
        "sound": result.sound,
        "planned": result.planned,
        "checked": result.checked,
        "left": result.left,
        "errors": result.count(ERROR),
        "warnings": result.count(WARNING),
        "manifest_sha256": result.manifest,
        "limits": to_plain(result.limits),
        "statistics": result.statistics,
        "skipped": list(result.skipped),
        "checks": checks,
    }


def write_report(result: Validation) -> Path:
    """Write `validation.json` into the folder, atomically, and return its path."""
    path = result.folder / REPORT
    write_json(path, to_report(result))
    return path
