"""Feed mutated files to every reader in child processes, and count what comes of it: `make fuzz`.

Input number i of a seed is the same on every machine. Results go to `results.jsonl` in the output folder, one line per
input, so that a run that was stopped goes on where it was; what was found lies in `findings` beside it.
"""

import argparse
import hashlib
import io
import json
import os
import random
import resource
import shutil
import signal
import subprocess
import sys
import time
import traceback
import warnings
from collections import Counter
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
for place in (ROOT, ROOT / "tests" / "support", ROOT / "tests" / "fuzz"):
    if str(place) not in sys.path:
        sys.path.insert(0, str(place))

from fuzz_mutate import mutated  # noqa: E402
from fuzz_targets import SLOW, TARGETS  # noqa: E402

from render.shared.errors import InputError  # noqa: E402

HANGS = 20.0  # seconds on one input
MEMORY = 2 << 30  # bytes above what the process held before
BAD = ("traceback", "refused badly", "hang", "crash", "memory")
_PER_SLOW = 12  # of so many inputs, one is for a slow target
_RENEW = 10_000  # inputs of one child
FAST = [name for name in TARGETS if name not in SLOW]


def chosen(number: int) -> str:
    """Return the target of an input."""
    if number % _PER_SLOW == 0:
        return SLOW[number // _PER_SLOW % len(SLOW)]
    return FAST[number % len(FAST)]


class Corpus:
    """The sound files of all targets, made when first asked for, below one folder."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._files: dict[str, list[tuple[Path, bytes]]] = {}

    def files(self, name: str) -> list[tuple[Path, bytes]]:
        """Return the files of a target that are mutated, with their contents."""
        if name not in self._files:
            folder, target = self.place(name), TARGETS[name]
            shutil.rmtree(folder, ignore_errors=True)
            folder.mkdir(parents=True)
            with redirect_stdout(io.StringIO()), redirect_stderr(io.StringIO()):
                target.make(folder)
            found = sorted(path for path in folder.glob(target.pattern) if path.is_file())
            self._files[name] = [(path, path.read_bytes()) for path in found]
        return self._files[name]

    def place(self, name: str) -> Path:
        """Return the folder of a target."""
        return self.folder / name.replace(" ", "-").replace(",", "")


def one(corpus: Corpus, seed: int, number: int) -> tuple[str, str, str, bytes]:
    """Read one input.

    Returns:
        The target, what came of it (`accepted`, `refused` or one of `BAD`), details, and the content.
    """
    name = chosen(number)
    rng = random.Random(f"{seed}/{number}")
    path, sound = rng.choice(corpus.files(name))
    data = mutated(sound, path.name, rng)
    path.write_bytes(data)
    before = _reset_peak()
    said, outcome, detail = io.StringIO(), "accepted", ""
    try:
        with redirect_stdout(io.StringIO()), redirect_stderr(said), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            TARGETS[name].read(corpus.place(name), path)
    except InputError as error:
        outcome, detail = judged(f"sdps: {error}\n")
    except Exception:
        outcome, detail = "traceback", f"{path.name}: {traceback.format_exc()}"
    else:
        if "sdps:" in said.getvalue():
            lines = [line for line in said.getvalue().splitlines() if line.startswith("sdps:")]
            outcome, detail = max(judged(f"{line}\n") for line in lines)  # "refused badly" comes after "refused"
    finally:
        path.write_bytes(sound)
    used = _peak() - before
    if used > MEMORY and len(data) < 1 << 20:
        outcome, detail = "memory", f"{path.name}: {used >> 20} MiB; {detail}"
    return name, outcome, detail, data


def judged(text: str) -> tuple[str, str]:
    """Tell whether a refusal is one line of text with a remedy (after a semicolon or colon)."""
    fine = text.count("\n") == 1 and text[:-1].isprintable() and len(text) < 1100
    return ("refused", "") if fine else ("refused badly", text[:500])


def _reset_peak() -> int:
    """Start a new peak of memory; return what is held now, in bytes."""
    Path("/proc/self/clear_refs").write_text("5")
    return _status("VmRSS")


def _peak() -> int:
    return _status("VmHWM")


def _status(field: str) -> int:
    line = next(line for line in Path("/proc/self/status").read_text().splitlines() if line.startswith(field + ":"))
    return int(line.split()[1]) << 10


def child(folder: Path, seed: int, first: int, last: int) -> None:
    """Read inputs until `last`, telling each before and after; runs in a process of its own."""
    corpus = Corpus(folder / f"work-{os.getpid()}")
    held = _status("VmSize")
    resource.setrlimit(resource.RLIMIT_AS, (held + 4 * MEMORY, held + 4 * MEMORY))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    results = os.fdopen(os.dup(1), "w", buffering=1)
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
    try:
        for number in range(first, last):
            corpus.files(chosen(number))
            results.write(f"{number}\n")
            name, outcome, detail, data = one(corpus, seed, number)
            if outcome in BAD:
                place = folder / "findings" / f"{number}-{outcome.replace(' ', '-')}"
                place.parent.mkdir(exist_ok=True)
                place.with_suffix(".bin").write_bytes(data)
                place.with_suffix(".txt").write_text(f"{name}\n{detail}", encoding="utf-8", errors="replace")
            results.write(json.dumps({"i": number, "target": name, "outcome": outcome}) + "\n")
    finally:
        shutil.rmtree(corpus.folder, ignore_errors=True)


def run(folder: Path, seed: int, inputs: int, minutes: float, again: bool = False) -> Counter[tuple[str, str]]:
    """Read inputs that no earlier run has read, until enough are read or the time is over; return all counts.

    With `again`, those that ended badly are read once more instead, and what comes of them now is what counts.
    """
    folder.mkdir(parents=True, exist_ok=True)
    path, until = folder / "results.jsonl", time.monotonic() + 60 * minutes
    done = _earlier(path)
    todo = [range(number, number + 1) for number, row in done.items() if row["outcome"] in BAD]
    if not again:
        first = max(done, default=-1) + 1
        todo = [range(start, min(start + _RENEW, inputs)) for start in range(first, inputs, _RENEW)]
    with open(path, "a", encoding="utf-8") as log:
        for part in todo:
            first = part.start
            while first < part.stop and time.monotonic() < until:
                for row in _leg(folder, seed, first, part.stop, until):
                    log.write(json.dumps(row) + "\n")
                    log.flush()
                    done[row["i"]] = row
                    first = row["i"] + 1
    return Counter((row["target"], row["outcome"]) for row in done.values())


def _earlier(path: Path) -> dict[int, dict[str, Any]]:
    """Return the last result of every input."""
    if not path.is_file():
        return {}
    rows = (json.loads(line) for line in path.read_text().splitlines() if line.endswith("}"))
    return {row["i"]: row for row in rows}


def _leg(folder: Path, seed: int, first: int, last: int, until: float):
    """Yield the results of one child; of an input that kills or blocks it, that."""
    words = [sys.executable, __file__, "--out", str(folder), "--seed", str(seed), "--child", str(first), str(last)]
    process = subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, cwd=ROOT)
    assert process.stdout is not None
    os.set_blocking(process.stdout.fileno(), False)
    begun, since, pending = None, time.monotonic(), b""
    try:
        while True:
            got = process.stdout.read()
            pending += got or b""
            *lines, pending = pending.split(b"\n")
            for line in lines:
                since = time.monotonic()
                if line.startswith(b"{"):
                    begun = None
                    yield json.loads(line)
                else:
                    begun = int(line)
            if got == b"":
                break
            if begun is not None and time.monotonic() - since > HANGS:
                yield {"i": begun, "target": chosen(begun), "outcome": "hang"}
                return
            if time.monotonic() > until or (begun is None and time.monotonic() - since > 120):
                return
            time.sleep(0.02)
        if begun is not None and process.wait() != 0:
            yield {"i": begun, "target": chosen(begun), "outcome": "crash", "signal": -process.returncode}
        elif process.wait() != 0:
            raise SystemExit(f"the child of inputs {first} to {last} could not begin (exit code {process.returncode})")
    finally:
        process.send_signal(signal.SIGKILL)
        process.wait()
        shutil.rmtree(folder / f"work-{process.pid}", ignore_errors=True)


def table(counts: Counter[tuple[str, str]]) -> str:
    """Lay out the counts as Markdown."""
    kinds = ("accepted", "refused", *BAD)
    rows = [["reader", "inputs", "accepted", "refused in one line", *BAD], ["---"] * (3 + 1 + len(BAD))]
    for name in [*TARGETS, "all"]:
        mine = [sum(n for (target, got), n in counts.items() if got == kind and name in (target, "all"))
                for kind in kinds]  # fmt: skip
        rows.append([name, *(f"{value:,}" for value in (sum(mine), *mine))])
    return "\n".join("| " + " | ".join(row) + " |" for row in rows)


def main() -> int:
    """Run, print the table, and return 1 where anything bad was found."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", default="out/fuzz")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--inputs", type=int, default=100_000)
    parser.add_argument("--minutes", type=float, default=120.0)
    parser.add_argument("--again", action="store_true", help="read those that ended badly once more")
    parser.add_argument("--child", type=int, nargs=2, help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.child:
        child(Path(args.out), args.seed, *args.child)
        return 0
    counts = run(Path(args.out), args.seed, args.inputs, args.minutes, args.again)
    digest = hashlib.sha256(repr(sorted(counts.items())).encode()).hexdigest()[:12]
    sys.stdout.write(f"{table(counts)}\n\nseed {args.seed}, counts {digest}\n")
    return int(any(kind in BAD for _, kind in counts))


if __name__ == "__main__":
    sys.exit(main())
