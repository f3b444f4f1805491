"""Compute what scenes of the preset `paper` cost by the number of them: `python -m lab.studies.scale_table`.

Everything measured is a constant here, with the command that measures it. All else follows by multiplication.
"""

import sys

from render.planning.budget import disk_bytes
from render.records.manifest import SceneSpec, View

SIZES = {"85,212": 85_212, "1 million": 1_000_000, "100 million": 100_000_000}

SCENES_PER_HOUR = 2_682  # of a core: `python -m lab bench --only workers`
CHUNK_SCENES = 27  # that fit 64 MB, which is a chunk of a cluster
CHUNKS_PER_SECOND, CHUNK_MS, SCHEDULER_MB = 66, 6.7, 412  # `cluster_trials.py load --slots 1000 --bytes 1000`
INTAKE = 37e6  # bytes a second of shards through one command to a disk: `cluster_trials.py load --bytes 50000000`
INTAKE_CORE = 4.8e-9  # seconds of a core a byte, the same command
LINE, HELD = 2_300, 10_400  # bytes of a scene in the manifest and in memory: `cluster_trials.py plan`
PUT, GET = 1.05, 1.0  # requests a scene, to render and to read: `storage_costs.py`
LISTED = 1_000  # objects in an answer of S3
TAR = 128e6  # bytes of a packed set's tar
TAR_GETS = 1.0  # requests to read one: `storage_costs.py`
SLOTS = 100  # cores that render


def shard_bytes() -> float:
    """Return the estimated bytes of a shard of the preset: 128x128 pixels, 64 lights."""
    scene = SceneSpec(id="s", seed=0, split="train", shape="sphere", material="chrome", view=View(),
                      lights=((0.0, 0.0, 1.0),) * 64, size=128, spp=128, bounces=2)  # fmt: skip
    return disk_bytes([scene])


def column(scenes: int) -> dict[str, str]:
    """Return what a number of scenes costs."""
    size = scenes * shard_bytes()
    hours, chunks, tars = scenes / SCENES_PER_HOUR, scenes / CHUNK_SCENES, size / TAR
    return {
        "core hours of rendering": rounded(hours),
        f"hours with {SLOTS} cores": rounded(hours / SLOTS),
        "storage": bytes_text(size),
        "requests to render into a bucket (PUT)": rounded(scenes * PUT),
        "requests to read it once (GET)": rounded(scenes * GET),
        "requests of one listing (LIST)": rounded(max(1.0, scenes / LISTED)),
        "the same packed: tars, and GET to read them": f"{rounded(tars)}, {rounded(tars * TAR_GETS)}",
        "manifest": bytes_text(scenes * LINE),
        "memory of the command for the plan": bytes_text(scenes * HELD),
        "tasks of the scheduler": rounded(chunks),
        "core hours of command and scheduler for the tasks": rounded(chunks * CHUNK_MS / 3.6e6),
        "core hours of the command for the shards' bytes": rounded(size * INTAKE_CORE / 3600),
        "hours in which one command takes the shards in": rounded(size / INTAKE / 3600),
    }


def rounded(value: float) -> str:
    """Return a number with two digits, or all before the point."""
    return f"{value:.2g}" if value < 10 else f"{value:,.0f}" if value < 1e4 else f"{float(f'{value:.3g}'):,.0f}"


def bytes_text(value: float) -> str:
    """Return bytes in GB or TB."""
    return f"{rounded(value / 1e12)} TB" if value >= 1e12 else f"{rounded(value / 1e9)} GB"


def main() -> None:
    """Print the table, and how many cores and slots each part could serve."""
    columns = [column(count) for count in SIZES.values()]
    sys.stdout.write(f"| | {' | '.join(SIZES)} |\n|---|{'---|' * len(SIZES)}\n")
    for name in columns[0]:
        sys.stdout.write(f"| {name} | {' | '.join(row[name] for row in columns)} |\n")
    chunk = CHUNK_SCENES * 3600 / SCENES_PER_HOUR
    rate = shard_bytes() * SCENES_PER_HOUR / 3600
    sys.stdout.write(
        f"\na shard is {shard_bytes() / 1e6:.2f} MB; a slot takes {chunk:.0f} s for a chunk and returns "
        f"{rate / 1e6:.1f} MB/s; one scheduler feeds {CHUNKS_PER_SECOND * chunk:,.0f} slots; one command takes in "
        f"from {INTAKE / rate:.0f} to a slow disk, from {1 / INTAKE_CORE / rate:.0f} with a core and a fast one\n"
    )


if __name__ == "__main__":
    main()
