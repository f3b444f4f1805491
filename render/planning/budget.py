"""What a run will need: disk, time, processes; plain arithmetic on plans and ledgers."""

import os
import shutil
import statistics
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from render.records.manifest import SceneSpec
from render.shared.errors import InputError

GIBIBYTE = 1 << 30
KEEP_FREE = 2 * GIBIBYTE  # always left free on the disk
HALF_RATIO = 0.33  # ZIP-compressed shard over raw half-float images, before anything of the run is measured
TRUTH_BYTES = 12  # compressed ground truth per pixel
WORKER_MEMORY = 2 * GIBIBYTE  # one pass over many samples, images of a view, kernels, libraries
RECENT = 50  # scenes that decide the present rate


def raw_bytes(scene: SceneSpec) -> int:
    """Return the bytes of the uncompressed half-float RGB images of a scene."""
    return len(scene.lights) * _pixels(scene) * 6


def _pixels(scene: SceneSpec) -> int:
    height, width = scene.resolution
    return height * width


def disk_bytes(scenes: Sequence[SceneSpec], measured: Sequence[tuple[SceneSpec, int]] = ()) -> int:
    """Estimate the bytes of the shards of `scenes`.

    Args:
        scenes: Scenes still to be written.
        measured: Finished scenes and the bytes of their shards; their mean ratio to the raw images replaces
            `HALF_RATIO`, which is that of objects covering about half the frame.
    """
    raw = sum(raw_bytes(scene) for scene in scenes)
    if measured:
        return round(raw * sum(size for _, size in measured) / sum(raw_bytes(scene) for scene, _ in measured))
    return round(HALF_RATIO * raw + TRUTH_BYTES * sum(_pixels(scene) for scene in scenes))


def free_bytes(folder: Path) -> int:
    """Return the free bytes of the disk that holds `folder` (or will, when it does not exist yet)."""
    folder = folder.absolute()
    while not folder.exists():
        folder = folder.parent
    return shutil.disk_usage(folder).free


def require_space(folder: Path, needed: int, keep_free: int = KEEP_FREE) -> None:
    """Refuse to start what does not fit.

    Raises:
        InputError: less than `needed + keep_free` bytes are free.
    """
    free = free_bytes(folder)
    if needed + keep_free > free:
        raise InputError(
            f"{folder}: needs about {gigabytes(needed)} and {gigabytes(keep_free)} kept free, but only "
            f"{gigabytes(free)} are free; free space, choose another --out, or lower --keep-free"
        )


def gigabytes(size: float) -> str:
    """Format bytes for people: `1.2 GB`, `34 MB`."""
    return f"{size / 1e9:,.1f} GB" if size >= 1e9 else f"{size / 1e6:,.0f} MB"


def duration(seconds: float) -> str:
    """Format seconds for people: `45 s`, `12 min`, `3.4 h`, `2.1 days`."""
    for limit, unit, name in ((120, 1, "s"), (7200, 60, "min"), (172_800, 3600, "h")):
        if seconds < limit:
            return f"{seconds / unit:.{1 if name == 'h' else 0}f} {name}"
    return f"{seconds / 86400:.1f} days"


@dataclass(frozen=True)
class Pace:
    """How fast scenes are rendered.

    Attributes:
        seconds: Seconds of one process per scene in steady state.
        workers: Processes that render side by side.
    """

    seconds: float
    workers: int

    def per_hour(self) -> float:
        """Return scenes per hour of all processes together."""
        return 3600 * self.workers / max(self.seconds, 1e-9)

    def left(self, scenes: int) -> float:
        """Return the seconds that `scenes` more scenes take."""
        return scenes * self.seconds / self.workers


def recent_pace(lines: Sequence[dict[str, Any]], workers: int) -> Pace | None:
    """Return the pace of the last `RECENT` ledger lines, or None without any."""
    seconds = [line["seconds"] for line in lines[-RECENT:]]
    return Pace(statistics.median(seconds), workers) if seconds else None


def estimate_pace(lines: Sequence[dict[str, Any]], loads: float, workers: int) -> Pace | None:
    """Estimate the pace of a whole run from a sample whose views are spread over many shapes.

    Args:
        lines: Ledger lines of the sample, without those in whose time kernels were compiled.
        loads: How often a scene of the run loads a shape, over how often one of the sample did; below 1, since
            consecutive views share a shape.
        workers: Processes.
    """
    if not lines:
        return None
    total, stages = sum(line["seconds"] for line in lines), stage_seconds(lines)
    loading = stages.get("shape", 0.0) + stages.get("build", 0.0)
    return Pace((total - loading + loading * loads) / len(lines), workers)


def default_workers(variant: str) -> int:
    """Return how many processes to run: one on a GPU, else as many as cores and memory allow."""
    if variant.startswith("cuda"):
        return 1
    return max(1, min(cores(), available_memory() // WORKER_MEMORY))


def cores() -> int:
    """Return the cores this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def available_memory() -> int:
    """Return the bytes of memory free for new processes, caches included; a guess where they are not known."""
    try:
        text = Path("/proc/meminfo").read_text(encoding="ascii")
        return next(1024 * int(line.split()[1]) for line in text.splitlines() if line.startswith("MemAvailable"))
    except (OSError, StopIteration, ValueError, IndexError):
        pages = os.sysconf("SC_PHYS_PAGES") if hasattr(os, "sysconf") else 0
        return pages * os.sysconf("SC_PAGE_SIZE") // 2 if pages > 0 else 4 * WORKER_MEMORY


def stage_seconds(lines: Collection[dict[str, Any]]) -> dict[str, float]:
    """Sum the seconds per stage over ledger lines."""
    total: dict[str, float] = {}
    for line in lines:
        for name, seconds in line["stages"].items():
            total[name] = total.get(name, 0.0) + seconds
    return total
