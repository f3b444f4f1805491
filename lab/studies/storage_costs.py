"""Count the requests and bytes of a data folder in object storage: `python -m lab.studies.storage_costs`.

Renders a small plan into an S3 server of this process (`pip install 'sdps[storage,storage-test]'`) and counts what each
command asks of it, as its log has it.
"""

import logging
import os
import re
import subprocess
import sys
import tempfile
from collections import Counter
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
sys.path.append(str(ROOT / "tests" / "support"))
from object_store import BUCKET, object_store  # noqa: E402

PLAN = ["--preset", "smoke", "--set", "data.views=8", "--set", "data.size=32", "--set", "data.spp=1"]
PLACE, TARS = f"s3://{BUCKET}/run", f"s3://{BUCKET}/tars"
STEPS = {
    "render-data": ["render-data", *PLAN, "--workers", "1", "--out", PLACE],
    "data status": ["data", "status", f"{PLACE}/data"],
    "data validate": ["data", "validate", f"{PLACE}/data"],
    "data validate, again": ["data", "validate", f"{PLACE}/data"],
    "data status, again": ["data", "status", f"{PLACE}/data"],
    "data pack": ["data", "pack", f"{PLACE}/data", "--out", TARS, "--tar-mb", "0.5"],
    "train": ["train", *PLAN, "--models", "lcnet", "--out", PLACE],
    "train, packed": ["train", *PLAN, "--models", "lcnet", "--data", TARS, "--out", f"s3://{BUCKET}/packed"],
}


class Counting(logging.Handler):
    """Counts the requests of the server's log by kind."""

    def __init__(self) -> None:
        super().__init__()
        self.kinds: Counter[str] = Counter()

    def emit(self, record: logging.LogRecord) -> None:
        if match := re.search(r"(GET|PUT|HEAD|POST|DELETE) /(\S*)", record.getMessage()):
            self.kinds["LIST" if "list-type" in match[2] else match[1]] += 1


def main() -> None:
    """Print a line per command."""
    counting = Counting()
    log = logging.getLogger("werkzeug")
    log.addHandler(counting)
    log.setLevel(logging.INFO)
    log.propagate = False
    with tempfile.TemporaryDirectory() as cache, object_store() as store:
        environment = os.environ | store.environment | {"PYTHONPATH": str(ROOT), "SDPS_CACHE": cache}
        for name, words in STEPS.items():
            counting.kinds.clear()
            words = [sys.executable, "-m", "pipelines.cli", *words]
            done = subprocess.run(words, cwd=ROOT, env=environment, check=False, capture_output=True, text=True)
            sys.stdout.write(f"{name}: {dict(counting.kinds)}\n{done.stderr if done.returncode else ''}")
            sys.stdout.flush()
        sizes = {key: len(data) for key, data in store.objects("run/data").items()}
        tars = [len(data) for name, data in store.objects("tars").items() if name.endswith(".tar")]
        shards = [size for key, size in sizes.items() if key.endswith(".exr")]
        other = {key: size for key, size in sizes.items() if not key.endswith(".exr")}
        sys.stdout.write(
            f"{len(shards)} shards of {sum(shards) / len(shards):,.0f} bytes in {len(tars)} tars; the rest: {other}\n"
        )


if __name__ == "__main__":
    main()
