"""Render into an S3 server, and disturb it: kill -9, then a store that goes away; `python tests/faults/storage_run.py`.

Each trial renders a small plan into a prefix of its own: started, killed once some shards are there, started again, the
store taken away for some seconds once more shards are there, and started once more. Manifest and shards must be the
bytes of a run into a local folder, every scene must have one ledger line, and nothing may be left on this disk. Prints
a line per trial.
"""

import argparse
import json
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
sys.path += [str(ROOT / "tests" / "support"), str(ROOT / "tests" / "faults")]
from fault_run import SMALL, digests  # noqa: E402
from object_store import BUCKET, ObjectStore, object_store  # noqa: E402


def start(
    store: ObjectStore, out: str, cache: Path, where: Sequence[str] = ("--workers", "1")
) -> "subprocess.Popen[bytes]":
    """Start rendering, on this machine or a cluster."""
    environment = os.environ | store.environment | {"PYTHONPATH": str(ROOT), "SDPS_CACHE": str(cache)}
    words = ["render-data", *SMALL, "--set", "data.views=8", *where, "--out", out]
    return subprocess.Popen(
        [sys.executable, "-m", "pipelines.cli", *words], cwd=ROOT, env=environment, stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
    )  # fmt: skip


def until(store: ObjectStore, prefix: str, count: int, process: "subprocess.Popen[bytes]") -> None:
    """Wait until so many shards are in the store, or the process has ended."""
    while process.poll() is None:
        page = store.client().list_objects_v2(Bucket=BUCKET, Prefix=f"{prefix}/data/shards/")
        if page["KeyCount"] >= count:
            return
        time.sleep(0.05)


def trial(store: ObjectStore, folder: Path, number: int, away: float, where: Sequence[str]) -> dict[str, object]:
    """Kill, take the store away, let it end; return what came of it."""
    rng, prefix = random.Random(number), f"run{number}"
    out, cache = f"s3://{BUCKET}/{prefix}", folder / f"cache{number}"
    first = start(store, out, cache, where)
    until(store, prefix, rng.randrange(40), first)
    first.send_signal(signal.SIGKILL)
    first.communicate()
    kept = sum(name.endswith(".exr") for name in store.objects(prefix))
    second = start(store, out, cache, where)
    until(store, prefix, rng.randrange(kept + 1, 85), second)
    store.stop()
    time.sleep(away)
    store.start()
    said = second.communicate(timeout=300)[1].decode()
    third = start(store, out, cache, where)
    third.communicate(timeout=300)
    objects = store.objects(f"{prefix}/data")
    lines = [json.loads(row) for name, data in objects.items() if name.startswith("log/done-")
             for row in data.decode().splitlines()]  # fmt: skip
    for name, data in objects.items():
        path = folder / f"store{number}" / "data" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(data)
    whole, there = (digests(folder / name, ("data/manifest.jsonl", "data/shards/*.exr"))
                    for name in ("local", f"store{number}"))  # fmt: skip
    left = [path.name for path in cache.rglob("*") if path.name == ".waiting.jsonl"]
    return {
        "kept": kept, "codes": [second.returncode, third.returncode], "waited": "trying again" in said,
        "same": whole == there, "twice": sum(count > 1 for count in Counter(line["id"] for line in lines).values()),
        "scenes": len(whole) - 1, "left": left, "traceback": said.partition("Traceback")[2][-2000:],
    }  # fmt: skip


def main() -> int:
    """Run the trials; 1 where one ended otherwise than promised."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--trials", type=int, default=10)
    parser.add_argument("--away", type=float, default=30.0, help="seconds without a store")
    parser.add_argument("--first", type=int, default=0, help="number of the first trial, its seed")
    parser.add_argument("--cluster", help="render there, e.g. on local:2")
    args = parser.parse_args()
    bad = 0
    with tempfile.TemporaryDirectory() as name, object_store() as store:
        folder = Path(name)
        process = start(store, str(folder / "local"), folder / "cache")
        if process.wait() != 0:
            raise SystemExit("the undisturbed run failed")
        where = ["--cluster", args.cluster] if args.cluster else ["--workers", "1"]
        for number in range(args.first, args.first + args.trials):
            row = trial(store, folder, number, args.away, where)
            wrong = not row["same"] or row["twice"] or row["left"] or row["traceback"] or row["codes"] != [0, 0]
            bad += bool(wrong)
            sys.stdout.write(f"{'BAD' if wrong else 'good'} {json.dumps(row)}\n")
            sys.stdout.flush()
    return int(bad > 0)


if __name__ == "__main__":
    sys.exit(main())
