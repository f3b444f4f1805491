"""What of a data folder is done, failed and left, at what rate, and when it will be finished."""

import re
from collections import Counter
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from render.planning import budget
from render.records import ledger
from render.records.manifest import MANIFEST, no_manifest, read_failed, read_manifest
from render.records.mirror import display_name, mirror_of

REASONS = 5  # most frequent reasons of failure that are shown
QUIET = 300.0  # seconds without a finished scene after which a run is taken for stopped
_ID = re.compile(rb'^\{"id": "([^"\\]*)"', re.MULTILINE)


def folder_state(folder: Path, *, verify: bool = False) -> dict[str, Any]:
    """Collect the state of a data folder; plain values, ready for JSON.

    Args:
        folder: A folder with a manifest; a run may be going on.
        verify: Hash every shard; otherwise files count as whole if their size is what the ledger says.

    Raises:
        InputError: not a data folder.
    """
    ids = scene_ids(folder)
    runs, sizes, failures = ledger.read_runs(folder), ledger.shard_sizes(folder), read_failed(folder)
    lines = ledger.latest(runs)
    if verify:
        done = ledger.survey(folder, read_manifest(folder), verify=True).done
    else:
        done = frozenset(id for id in ids if id in sizes and lines.get(id, {}).get("bytes", sizes[id]) == sizes[id])
    planned = set(ids)
    failed = {id: rows for id, rows in failures.items() if id in planned and id not in done}
    left = len(ids) - len(done) - len(failed)
    used = sum(sizes[id] for id in done)
    rates = scene_rates(runs)
    newest = max((line["time"] for line in lines.values()), default=None)
    age = (datetime.now(UTC) - datetime.fromisoformat(newest)).total_seconds() if newest else None
    rate = rates["recent_per_hour"] if age is not None and age < QUIET else rates["overall_per_hour"]
    return {
        "folder": display_name(folder),
        "scenes": len(ids),
        "done": len(done),
        "damaged": sum(id in sizes and id not in done for id in ids),
        "failed": len(failed),
        "left": left,
        "reasons": dict(Counter(rows[-1]["reason"] for rows in failed.values()).most_common(REASONS)),
        **rates,
        "seconds_since_last": age,
        "seconds_left": 3600 * left / rate if rate else None,
        "bytes_used": used,
        "bytes_needed": left * used // len(done) if done else budget.disk_bytes(read_manifest(folder)),
        "bytes_free": None if mirror_of(folder) else budget.free_bytes(folder),
    }


def scene_ids(folder: Path) -> list[str]:
    """Return the ids of the manifest without reading the rest of its lines: 85,212 scenes are 200 MB.

    Raises:
        InputError: no manifest.
    """
    path = folder / MANIFEST
    try:
        data = path.read_bytes()
    except OSError as error:
        raise no_manifest(folder) from error
    found = [name.decode(errors="replace") for name in _ID.findall(data)]
    if len(found) == data.count(b"\n"):
        return found
    return [scene.id for scene in read_manifest(folder)]  # written by other means


def scene_rates(runs: Sequence[Sequence[dict[str, Any]]]) -> dict[str, float | None]:
    """Return scenes per hour over the last scenes and over all, without the time between runs."""
    spans, times = [], []
    for lines in runs:
        stamps = [datetime.fromisoformat(line["time"]).timestamp() for line in lines]
        spans.append((stamps[0] - lines[0]["seconds"], max(stamps)))
        times += stamps
    times.sort()
    rates = {}
    for name, recent in (("recent_per_hour", times[-budget.RECENT :]), ("overall_per_hour", times)):
        # Over all, the first scene's own time counts; in a window, the first scene is only its start.
        whole = len(recent) == len(times)
        start = min((first for first, _ in spans), default=0.0) if whole else recent[0]
        elapsed = measure_union([(max(first, start), last) for first, last in spans if last > start])
        rates[name] = 3600 * (len(recent) - (not whole)) / elapsed if elapsed > 0 else None
    return rates


def measure_union(spans: Sequence[tuple[float, float]]) -> float:
    """Return the length of the union of intervals: machines that work at the same time count once."""
    total, end = 0.0, float("-inf")
    for first, last in sorted(spans):
        total += max(0.0, last - max(first, end))
        end = max(end, last)
    return total
