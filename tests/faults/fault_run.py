"""Stop long commands at random moments, go on, and compare the results with those of a run left alone: `make faults`.

Each command is started again and again and meets one fault after another at moments drawn from the seed; `FAULTS` says
which. Then it runs once to its end. What it promises to repeat must be there byte by byte, weights within `TOLERANCE`,
no file may be missing, and no temporary file may be left.
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
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

ROOT = Path(__file__).resolve().parents[2]
sys.path.append(str(ROOT / "tests" / "support"))
FAULTS = {
    "kill -9": "the process alone is killed; its children must end by themselves",
    "SIGTERM": "as a queue ends a job",
    "SIGINT twice": "Ctrl-C, and again 0.3 s later, to the whole group of processes",
    "full disk": "a limit on the size of files, there from the beginning",
    "folder vanishes": "the output folder is renamed; it comes back when the command has ended",
    "two at once": "the same command is started twice on one folder, and both run to their ends",
    "clock set back": "killed; what is there is then dated a day ahead, as a clock that is set back leaves it",
}
TOLERANCE = 1e-6  # largest difference of weights
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
    "ship": Job(lambda out, given: ["ship", "--preset", "smoke", "--out", str(given), "--into", str(out / "weights")],
                ("weights/*.*",), "train"),
    "import": Job(lambda out, given: ["data", "import", str(given / "tree"), "--layout", "psfcn", "--out",
                                      str(out / "data")], ("data/manifest.jsonl", "data/shards/*.exr"), "export"),
    "train --stream": Job(lambda out, _: ["train", *SMALL, "--stream", "--out", str(out)], ()),
    "evaluate": Job(lambda out, _: ["eval-classical", "--out", str(out), "--preset", "smoke", "--set", "test.size=32",
                                    "--set", "test.spp=1", "--methods", "least-squares,pf14", "--light-sets",
                                    "near-uniform:12"], ("*/manifest.jsonl", "*/shards/*.exr")),
    "infer": Job(lambda out, given: ["infer", str(photographs(given)), "--method", "pf14", "--out", str(out / "found")],
                 ("found/*.exr", "found/*.npy", "found/mesh.*", "found/lights.json")),
}  # fmt: skip


def photographs(folder: Path) -> Path:
    """Return a folder of twelve small pictures of a matte object below `folder`, made where it is not there."""
    place = folder / "photographs"
    if not place.is_dir():
        import photo_folders
        from data_folders import light_directions

        images, mask = photo_folders.matte(light_directions(12).astype(float), size=32)
        photo_folders.write_folder(folder / "new", images, mask)
        (folder / "new").rename(place)
    return place


def start(words: list[str], fault: str, rng: random.Random) -> subprocess.Popen[bytes]:
    """Start a command; a full disk is there from the beginning, at a random number of bytes."""
    limit = rng.choice([100, 2_000, 20_000, 200_000])

    def full() -> None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))

    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    program = "lab" if words[0] == "ship" else "pipelines.cli"
    return subprocess.Popen(
        [sys.executable, "-m", program, *words], cwd=ROOT, env=environment, stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE, start_new_session=True, preexec_fn=full if fault == "full disk" else None,
    )  # fmt: skip


def disturbed(words: list[str], fault: str, seconds: float, rng: random.Random, folder: Path) -> dict[str, Any]:
    """Run a command that writes into `folder` into one fault, and tell how it ended."""
    patience = 120 + 4 * seconds
    processes = [start(words, fault, rng) for _ in range(1 + (fault == "two at once"))]
    away = folder.with_name(f"{folder.name}-away")
    try:
        if fault not in ("full disk", "two at once"):
            time.sleep(rng.uniform(0.0, seconds))
            _strike(processes[0], fault, folder, away)
        said = b"".join(process.communicate(timeout=patience)[1] for process in processes)
        hung = False
    except subprocess.TimeoutExpired:
        for process in processes:
            with suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)
        said, hung = b"".join(process.communicate()[1] for process in processes), True
    if away.exists():
        shutil.rmtree(folder, ignore_errors=True)
        away.rename(folder)
    if fault == "clock set back":
        ahead = time.time() + 86_400
        for path in folder.rglob("*"):
            os.utime(path, (ahead, ahead))
    broken = b"Traceback" in said and fault not in ("kill -9", "clock set back")
    last = said.decode(errors="replace").strip().rsplit("\n", 1)[-1][-300:]
    return {"code": [process.returncode for process in processes], "hang": hung, "traceback": broken, "said": last}


def _strike(process: subprocess.Popen[bytes], fault: str, folder: Path, away: Path) -> None:
    """Do to a running command what the fault is."""
    if fault == "folder vanishes":
        with suppress(FileNotFoundError):
            folder.rename(away)
    elif fault == "SIGINT twice":
        for _ in range(2):
            with suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGINT)
            time.sleep(0.3)
    else:
        process.send_signal(signal.SIGTERM if fault == "SIGTERM" else signal.SIGKILL)


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


def weights_differ(whole: Path, broken: Path) -> float:
    """Return the largest difference of any weight of the runs of two folders; missing files differ endlessly."""
    from safetensors.numpy import load_file

    largest = 0.0
    for path in whole.glob("**/*.safetensors"):
        other = broken / path.relative_to(whole)
        if not other.is_file():
            return float("inf")
        mine, yours = load_file(path), load_file(other)
        largest = max([largest, *(float(abs(mine[name] - yours[name]).max(initial=0.0)) for name in mine)])
    return largest


def names(folder: Path) -> set[str]:
    """Return the names of all files but ledgers and the cache, of which every run writes its own."""
    found = (path.relative_to(folder) for path in folder.rglob("*") if path.is_file())
    return {str(path) for path in found if not {"log", "cache"} & {*path.parts}}


def whole(name: str, out: Path) -> tuple[Path, float]:
    """Return the folder of a job's undisturbed run, made where it is not there, and its seconds."""
    job, folder = JOBS[name], out / name.replace(" ", "") / "whole"
    told = folder.with_name("seconds.json")
    given = whole(job.needs, out)[0] if job.needs else out
    if not told.is_file():
        shutil.rmtree(folder, ignore_errors=True)
        code, seconds = finished(job.words(folder, given))
        if code != 0:
            raise SystemExit(f"{name}: the undisturbed run ended with {code}")
        told.write_text(json.dumps(seconds))
    return folder, json.loads(told.read_text())


def trial(name: str, out: Path, kills: int, seed: int, until: float = float("inf")) -> Iterator[dict[str, Any]]:
    """Disturb a job `kills` times or until a time is over, let it end; yield a line per fault and one at the end."""
    job = JOBS[name]
    sound, seconds = whole(name, out)
    broken, given = sound.with_name("broken"), whole(job.needs, out)[0] if job.needs else out
    shutil.rmtree(broken, ignore_errors=True)
    rng = random.Random(f"{seed}/{name}")
    for number in range(kills):
        if time.monotonic() > until:
            break
        fault = list(FAULTS)[number % len(FAULTS)]
        row = {"job": name, "fault": fault, **disturbed(job.words(broken, given), fault, seconds, rng, broken)}
        yield row
        if not any(row["code"]):
            shutil.rmtree(broken, ignore_errors=True)  # done: the next fault is to meet work
    code, _ = finished(job.words(broken, given))
    same = digests(sound, job.kept) == digests(broken, job.kept)
    yield {
        "job": name, "fault": "none", "code": code, "same": same, "left": left_over(broken),
        "difference": weights_differ(sound, broken), "missing": sorted(names(sound) - names(broken)),
    }  # fmt: skip


def summary(rows: list[dict[str, Any]]) -> tuple[str, bool]:
    """Return a line about a job, and whether it kept its promises."""
    end = rows[-1]
    broken = [row for row in rows[:-1] if row["traceback"] or row["hang"]]
    good = end["same"] and end["difference"] <= TOLERANCE and not end["missing"]
    text = (
        f"{end['job']}: {len(rows) - 1} faults, {len(broken)} tracebacks or hangs; then exit code {end['code']}, "
        f"{'same' if good else 'OTHER'} results, {len(end['left'])} temporary files\n"
    )
    return text, not broken and end["code"] == 0 and good and not end["left"]


def main() -> int:
    """Disturb every job; print a line per job, and return 1 where a promise is broken."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", default="out/faults")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--kills", type=int, default=100)
    parser.add_argument("--minutes", type=float, default=60.0, help="of faults of one job")
    parser.add_argument("--jobs", default=",".join(JOBS))
    args = parser.parse_args()
    out, bad = Path(args.out).absolute(), 0
    out.mkdir(parents=True, exist_ok=True)
    with open(out / "faults.jsonl", "a", encoding="utf-8") as log:
        for name in args.jobs.split(","):
            rows = []
            for row in trial(name, out, args.kills, args.seed, time.monotonic() + 60 * args.minutes):
                log.write(json.dumps(row) + "\n")
                log.flush()
                rows.append(row)
            text, kept = summary(rows)
            bad += not kept
            sys.stdout.write(text)
            sys.stdout.flush()
    return int(bad > 0)


if __name__ == "__main__":
    sys.exit(main())
