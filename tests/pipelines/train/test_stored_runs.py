"""Training under torchrun from and into an S3 server: the losses of one process that reads a folder."""

import json
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from object_store import BUCKET, ObjectStore, object_store
from sdps_scenes import write_data

from pipelines.cli import main

pytestmark = pytest.mark.slow
ROOT = Path(__file__).resolve().parents[3]
VALUES = {
    "size": 32, "crop": 16, "images": 2, "batch_scenes": 4, "schedule": "constant", "log_every": 1,
    "validation_scenes": 2, "precision": "float32", "shuffle_window": 3, "workers": 1, "minutes": "null",
}  # fmt: skip


@pytest.fixture(scope="module")
def store() -> Iterator[ObjectStore]:
    pytest.importorskip("moto.server", reason="the S3 server of sdps[storage-test] is missing")
    pytest.importorskip("webdataset", reason="the tars' library, of sdps[storage], is missing")
    with object_store() as server:
        yield server


def train(store: ObjectStore, cache: Path, data: str, out: str, processes: int, steps: int) -> str:
    """Train as a user would; return what went to standard error, the exit code first."""
    launch = (
        ["torch.distributed.run", "--standalone", "--nproc-per-node", str(processes), "-m"] if processes > 1 else []
    )
    words = ["train", "--preset", "smoke", "--models", "nenet", "--data", data, "--out", out, "--cache-gb", "0.001"]
    words += [word for name, value in VALUES.items() for word in ("--set", f"normals.{name}={value}")]
    command = [sys.executable, "-m", *launch, "pipelines.cli", *words, "--set", f"normals.steps={steps}"]
    environment = os.environ | store.environment | {
        "PYTHONPATH": str(ROOT), "SDPS_CACHE": str(cache), "OMP_NUM_THREADS": "1",
    }  # fmt: skip
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    return f"{done.returncode} {done.stderr}"


def losses(text: bytes) -> dict[int, float]:
    rows = [json.loads(line) for line in text.decode().splitlines()]
    return {row["step"]: row["loss"] for row in rows if "loss" in row}


def test_processes_share_a_packed_set_of_a_store_and_go_on_with_another_number(
    store: ObjectStore, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name, value in store.environment.items():
        monkeypatch.setenv(name, value)
    write_data(tmp_path / "data", ("train",) * 7 + ("val", "val"), lights=4, size=32)
    for out in (tars := f"s3://{BUCKET}/tars", str(tmp_path / "tars")):
        assert main(["data", "pack", str(tmp_path / "data"), "--out", out, "--tar-mb", "0.05"]) == 0
    said = train(store, tmp_path / "cache", str(tmp_path / "tars"), str(tmp_path / "one"), 1, 4)
    assert said[0] == "0", said[-2000:]
    expected = losses((tmp_path / "one" / "models" / "nenet" / "metrics.jsonl").read_bytes())
    # Each part finds nothing on its disk but what it fetches: its checkpoint, too, comes from the store.
    for number, (processes, steps) in enumerate(((1, 2), (2, 4))):
        said = train(store, tmp_path / f"cache{number}", tars, f"s3://{BUCKET}/run", processes, steps)
        assert said[0] == "0", said[-2000:]
    found = losses(store.objects("run/models/nenet")["metrics.jsonl"])
    assert len(expected) == 4 and found == pytest.approx(expected, rel=2e-4)
