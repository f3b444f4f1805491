"""`lab bench-checks`: how often the checks of photographs cry wolf, and how often they notice, on rendered scenes.

Rendered scenes stand still under white lights, so any word of movement or of a changing colour is a false alarm. The
same scenes with half of the pictures moved, one picture moved, or a channel of some dimmed tell what is noticed.
"""

import argparse
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from pipelines.evaluate.workbench import photograph, write_photographs
from pipelines.shared.flags import add_out
from pipelines.shared.text_tables import render_text
from render.records.manifest import SceneSpec, read_manifest
from render.records.shards import read_shard
from render.shared.errors import InputError
from render.shared.files import write_json
from render.shared.progress import progress_bar
from render.shared.seeds import generator
from sdps.photos import Finding, check, load

MOST = 40
"""Pictures of a scene at most."""
_PAD, _STEP, _DIMMED = 24, (5, -3), 0.8
_MOVED, _COLOUR = ("moved", "edges lie in different"), ("colour changes",)


class Spoilt(NamedTuple):
    """What was done to a scene's pictures, and what should be said of it."""

    title: str
    words: tuple[str, ...]
    which: str  # of the pictures: none, half, one or eighth
    channel: int | None = None  # dimmed, instead of a movement


CASES = {
    "still": Spoilt("nothing wrong, said to have moved", _MOVED, "none"),
    "white": Spoilt("nothing wrong, said to change colour", _COLOUR, "none"),
    "half": Spoilt("second half moved by 6 pixels", _MOVED, "half"),
    "one": Spoilt("one picture moved by 6 pixels", _MOVED, "one"),
    "red": Spoilt("red dimmed by a fifth in every eighth picture", _COLOUR, "eighth", 0),
    "blue": Spoilt("blue dimmed by a fifth in every eighth picture", _COLOUR, "eighth", 2),
}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the flags of `python -m lab bench-checks`."""
    parser.add_argument("folders", nargs="+", type=Path, help="data folders of rendered scenes")
    parser.add_argument("--every", type=int, default=1, metavar="N", help="every N-th scene (default: all)")
    add_out(parser, Path("out/bench-checks"))


def main(args: argparse.Namespace) -> int:
    """Check every scene in every case, print the table and write bench_checks.json."""
    if args.every < 1:
        raise InputError(f"--every must be at least 1, got {args.every}")
    scenes = [(folder, scene) for folder in args.folders for scene in read_manifest(folder)][:: args.every]
    rows = [row for folder, scene in progress_bar(scenes, desc="check", unit="scene") for row in judge(folder, scene)]
    write_json(args.out / "bench_checks.json", {"scenes": len(scenes), "rows": rows})
    sys.stdout.write(f"{table(rows, len(scenes))}{args.out / 'bench_checks.json'}\n")
    return 0


def judge(folder: Path, scene: SceneSpec) -> list[dict[str, Any]]:
    """Check a scene in every case: whether the words came, and which pictures were named, rightly and wrongly."""
    shard = read_shard(folder / scene.file, scene)
    rng = generator(0, scene.id, "checks")
    gains = rng.uniform(0.2, 2.0, len(shard.images)).astype(np.float32)
    chosen = np.sort(rng.permutation(len(gains))[:MOST])
    images = photograph(shard, gains)[chosen]
    images /= np.percentile(images[:, shard.mask], 99.5)
    images = np.pad(images, ((0, 0), (_PAD, _PAD), (_PAD, _PAD), (0, 0)))
    mask, rows, alarms = np.pad(shard.mask, _PAD), [], {}
    for case, spoilt in CASES.items():
        picked = _pick(spoilt.which, len(images))
        done = spoilt.which, spoilt.channel
        if done not in alarms:  # two cases leave the pictures as they are
            alarms[done] = _alarms(_alter(images, spoilt, picked), mask)
        named = _named(alarms[done], spoilt.words)
        right = (named or set()) & set(picked.tolist())
        rows.append({"scene": scene.id, "case": case, "said": named is not None, "pictures": len(picked),
                     "right": len(right), "wrong": len((named or set()) - right)})  # fmt: skip
    return rows


def _pick(which: str, count: int) -> np.ndarray:
    """Return which pictures are spoilt."""
    places = {"none": slice(0, 0), "half": slice(count // 2, None), "one": slice(count // 3, count // 3 + 1),
              "eighth": slice(5, None, 8)}  # fmt: skip
    return np.arange(count)[places[which]]


def _alter(images: np.ndarray, spoilt: Spoilt, picked: np.ndarray) -> np.ndarray:
    """Return the pictures with what a case does to some of them."""
    altered = images.copy()
    if spoilt.channel is not None:
        altered[picked, ..., spoilt.channel] *= _DIMMED
    elif len(picked):
        altered[picked] = np.roll(altered[picked], _STEP, (1, 2))
    return altered


def _alarms(images: np.ndarray, mask: np.ndarray) -> list[Finding]:
    """Write photographs and check them; notes are no alarms."""
    with tempfile.TemporaryDirectory() as temporary:
        folder = write_photographs(Path(temporary), images, mask)
        return [finding for finding in check(load(folder)) if finding.level != "note"]


def _named(alarms: Sequence[Finding], words: Sequence[str]) -> set[int] | None:
    """Return the pictures named with one of the words; None without the words."""
    found = [finding for finding in alarms if any(word in finding.text for word in words)]
    return {int(name[:3]) for finding in found for name in finding.images} if found else None


def table(rows: Sequence[dict[str, Any]], scenes: int) -> str:
    """Lay out how many scenes were warned of, and the share of spoilt pictures named."""
    body = []
    for case, spoilt in CASES.items():
        part = [row for row in rows if row["case"] == case]
        spoilt_pictures = sum(row["pictures"] for row in part)
        share = f"{sum(row['right'] for row in part) / spoilt_pictures:.0%}" if spoilt_pictures else "-"
        wrong = sum(row["wrong"] > 0 for row in part)
        body.append([spoilt.title, f"{sum(row['said'] for row in part)} of {scenes}", share, str(wrong)])
    header = ["pictures", "scenes with the warning", "spoilt pictures named", "scenes with others named"]
    return render_text(f"{scenes} rendered scenes of up to {MOST} pictures, 16 bits", header, body)
