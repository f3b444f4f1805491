"""A run's folder as rendering, training and evaluating leave it, small."""

import json
from pathlib import Path

import numpy as np
from data_folders import scene_of, sphere_shard, write_folder

from pipelines.evaluate.report.sections import Section, SectionWriter, Table
from render.records.manifest import FAILED


def write_run(folder: Path) -> None:
    """Write two rendered scenes and a failed one, a learning curve and a table of results."""
    shards = [sphere_shard(name=f"sphere-{number}", seed=number) for number in range(2)]
    missing = scene_of(sphere_shard(name="sphere-2", seed=2))
    write_folder(folder / "data", shards, [*map(scene_of, shards), missing])
    failure = {"id": "sphere-2", "time": "2026-01-01T00:00:00", "seed": 1, "reason": "out of memory"}
    (folder / "data" / FAILED).write_text(json.dumps(failure) + "\n")
    curve = folder / "models" / "lcnet" / "metrics.jsonl"
    curve.parent.mkdir(parents=True)
    curve.write_text('{"step": 1, "loss": 2.0}\n{"step": 2, "loss": 1.0, "val_direction_mae": 9.5}\n{"step": 3, "lo')
    table = Table(
        title="Normals", header=("object", "degrees"), rows=(("ball", "3.1"), ("cat", "12.4"), ("cow", "8.0"))
    )
    writer = SectionWriter(Section(name="some", title="Some <b>results</b>", text="Degrees.", tables=(table,)))
    writer.strip("Error maps", [("cat, 12.4 degrees", np.full((16, 16, 3), 90, np.uint8))])
    writer.write(folder)
