"""Join the finished scenes of several data folders into one, on which networks then train.

    python -m lab.studies.join_scenes out/world/data out/ship/data --out out/mix/data
    python -m lab.studies.join_scenes out/world/data out/ship/data --out out/less/data --train 800 0

Scenes that have no shard yet are left out. Shards are linked where the file system allows it, else copied. Plans
number their shapes alike: give each a prefix (`--set data.prefix=world-`), so that no name is met twice. With `--train`
a folder gives so many of its training scenes, evenly spread, and all its validation scenes: sets to compare, with the
same validation.
"""

import argparse
import os
import shutil
import sys
from collections.abc import Sequence
from pathlib import Path

from render.records.manifest import SceneSpec, claim, read_manifest
from render.shared.errors import InputError
from render.shared.files import atomic_path


def join(folders: Sequence[Path], out: Path, *, first: bool = False, train: Sequence[int] = ()) -> int:
    """Write `out`, a data folder, and return its number of scenes.

    Args:
        folders: Data folders.
        out: Folder to write.
        first: Of scenes of one name keep the first folder's, instead of refusing.
        train: Training scenes to take of each folder; empty for all.

    Raises:
        InputError: a folder without a manifest or with too few scenes, as many numbers as folders were expected, two
            scenes of one name, no scene at all, or another plan in `out`.
    """
    if train and len(train) != len(folders):
        raise InputError(f"--train: give a number for each of {len(folders)} folders, got {len(train)}")
    origins: dict[str, Path] = {}
    scenes: list[SceneSpec] = []
    for folder, count in zip(folders, train or [None] * len(folders), strict=True):
        for scene in _take(folder, count):
            if scene.id in origins:
                if first:
                    continue
                raise InputError(
                    f"{folder}: scene {scene.id} is in {origins[scene.id]} too; render one of them with another "
                    "data.prefix, or add --first"
                )
            origins[scene.id] = folder
            scenes.append(scene)
    if not scenes:
        raise InputError(f"{', '.join(map(str, folders))}: no finished scene; run `sdps render-data`")
    (out / "shards").mkdir(parents=True, exist_ok=True)
    claim(out, scenes)
    for scene in scenes:
        _link(origins[scene.id] / scene.file, out / scene.file)
    return len(scenes)


def _take(folder: Path, count: int | None) -> list[SceneSpec]:
    """Return a folder's finished scenes, of those for training `count`, evenly spread, or all."""
    scenes = [scene for scene in read_manifest(folder) if (folder / scene.file).is_file()]
    if count is None:
        return scenes
    training = [scene for scene in scenes if scene.split == "train"]
    if not 0 <= count <= len(training):
        raise InputError(f"{folder}: has {len(training)} finished training scenes, --train asks for {count}")
    kept = {training[place * len(training) // count].id for place in range(count)}
    return [scene for scene in scenes if scene.split != "train" or scene.id in kept]


def _link(source: Path, target: Path) -> None:
    if target.exists():
        return
    try:
        os.link(source, target)
    except OSError:  # another file system, or one without links
        with atomic_path(target) as temporary:
            shutil.copyfile(source, temporary)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; exit code 2 where the input cannot be used."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folders", nargs="+", type=Path, help="data folders")
    parser.add_argument("--out", type=Path, required=True, help="data folder to write")
    parser.add_argument("--first", action="store_true", help="of scenes of one name keep the first folder's")
    parser.add_argument("--train", nargs="+", type=int, default=(), help="training scenes of each (default: all)")
    args = parser.parse_args(arguments)
    try:
        count = join(args.folders, args.out, first=args.first, train=args.train)
    except InputError as error:
        sys.stderr.write(f"join_scenes: {error}\n")
        return 2
    sys.stdout.write(f"{args.out}: {count} scenes\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
