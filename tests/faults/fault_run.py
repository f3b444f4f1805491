"""Stop long commands at random moments, go on, and compare the results with those of a run left alone: `make faults`.

Each command is started again and again and meets a fault drawn from the seed: kill -9, SIGTERM, or a limit on the size
of files, which acts as a full disk. Then it runs once to its end. What it promises to repeat must be there byte by
byte, and no temporary file may be left.
"""

import argparse
import hashlib
import json
import os
import random
import resource
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

ROOT = Path(__file__).resolve().parents[2]
FAULTS = ("kill -9", "SIGTERM", "full disk")
SMALL = ["--preset", "smoke", "--set", "data.size=16", "--set", "data.spp=1", "--set", "data.light_count=4"]


class Job(NamedTuple):
    """A command that is disturbed.

    Attributes:
        words: Its words, given the folder it writes to and that of what it needs.
        kept: Patterns of the files that must be the same bytes in the end.
        needs: Name of the job whose undisturbed result it reads.
    """

    words: Callable[[Path, Path], list[str]]
    kept: tuple[str, ...]
    needs: str = ""


JOBS: dict[str, Job] = {
    "render": Job(lambda out, _: ["render-data", *SMALL, "--out", str(out)],
                  ("data/manifest.jsonl", "data/shards/*.exr")),
    "export": Job(lambda out, given: ["data", "export", str(given / "data"), "--layout", "psfcn", "--out",
                                      str(out / "tree")], ("tree/**/*.png", "tree/**/*.txt"), "render"),
    "train": Job(lambda out, given: ["train", *SMALL, "--data", str(given / "data"), "--out", str(out)],
                 ("**/manifest.jsonl",), "render"),
    "train --stream": Job(lambda out, _: ["train", *SMALL, "--stream", "--out", str(out)], ()),
    "evaluate": Job(lambda out, _: ["eval-classical", "--out", str(out), "--preset", "smoke"], ()),
    "infer": Job(lambda out, _: ["infer", "--self-test", "--method", "pf14", "--out", str(out)], ()),
}  # fmt: skip


def start(words: list[str], fault: str, rng: random.Random) -> subprocess.Popen[bytes]:
    """Start a command; a full disk is there from the beginning, at a random number of bytes."""
    limit = rng.choice([100, 2_000, 20_000, 200_000])

    def full() -> None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))

    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    return subprocess.Popen(
        [sys.executable, "-m", "pipelines.cli", *words], cwd=ROOT, env=environment, stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE, start_new_session=True, preexec_fn=full if fault == "full disk" else None,
    )  # fmt: skip


def disturbed(words: list[str], fault: str, seconds: float, rng: random.Random) -> dict[str, Any]:
    """Run a command into one fault; of `kill -9` its children, orphans then, must end by themselves."""
    process = start(words, fault, rng)
    try:
        if fault != "full disk":
            time.sleep(rng.uniform(0.0, seconds))
            process.send_signal(signal.SIGKILL if fault == "kill -9" else signal.SIGTERM)
        _, said = process.communicate(timeout=120 + 4 * seconds)
        hung = False
    except subprocess.TimeoutExpired:
        os.killpg(process.pid, signal.SIGKILL)
        said, hung = process.communicate()[1], True
    return {"code": process.returncode, "hang": hung, "traceback": b"Traceback" in said and fault != "kill -9"}


def digests(folder: Path, patterns: tuple[str, ...]) -> dict[str, str]:
    """Return the hash of every file that must repeat."""
    found = {path for pattern in patterns for path in folder.glob(pattern) if path.is_file()}
    return {str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest() for path in sorted(found)}


def left_over(folder: Path) -> list[str]:
    """Return the temporary files and folders below a folder."""
    return [str(path.relative_to(folder)) for path in folder.rglob(".*") if ".tmp" in path.name or ".old" in path.name]


def finished(words: list[str]) -> tuple[int, float]:
    """Run a command to its end; return its exit code and seconds."""
    begun = time.monotonic()
    process = start(words, "", random.Random(0))
    process.communicate(timeout=1200)
    return process.returncode, time.monotonic() - begun


def trial(name: str, out: Path, kills: int, seed: int) -> Iterator[dict[str, Any]]:
    """Disturb one job `kills` times, let it end, and yield a line per fault and one at the end."""
    job, given = JOBS[name], out / JOBS[name].needs.replace(" ", "") / "whole"
    whole, broken = (out / name.replace(" ", "") / kind for kind in ("whole", "broken"))
    seconds = 20.0
    if not whole.exists():
        code, seconds = finished(job.words(whole, given))
        if code != 0:
            raise SystemExit(f"{name}: the undisturbed run ended with {code}")
    shutil.rmtree(broken, ignore_errors=True)
    rng = random.Random(f"{seed}/{name}")
    for number in range(kills):
        fault = FAULTS[number % len(FAULTS)]
        yield {"job": name, "fault": fault, **disturbed(job.words(broken, given), fault, seconds, rng)}
    code, _ = finished(job.words(broken, given))
    same = digests(whole, job.kept) == digests(broken, job.kept)
    yield {"job": name, "fault": "none", "code": code, "same": same, "left": left_over(broken)}


def main() -> int:
    """Disturb every job; print a line per job, and return 1 where a promise is broken."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", default="out/faults")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--kills", type=int, default=100)
    parser.add_argument("--jobs", default=",".join(JOBS))
    args = parser.parse_args()
    out, bad = Path(args.out).absolute(), 0
    out.mkdir(parents=True, exist_ok=True)
    with open(out / "faults.jsonl", "a", encoding="utf-8") as log:
        for name in args.jobs.split(","):
            rows = []
            for row in trial(name, out, args.kills, args.seed):
                log.write(json.dumps(row) + "\n")
                log.flush()
                rows.append(row)
            end = rows[-1]
            broken = [row for row in rows[:-1] if row["traceback"] or row["hang"]]
            bad += bool(broken or end["code"] or not end["same"] or end["left"])
            sys.stdout.write(
                f"{name}: {len(rows) - 1} faults, {len(broken)} tracebacks or hangs; then exit code {end['code']}, "
                f"{'same' if end['same'] else 'OTHER'} bytes, {len(end['left'])} temporary files\n"
            )
    return int(bad > 0)


if __name__ == "__main__":
    sys.exit(main())
