"""`sdps data pack`: a data folder's scenes in WebDataset tars, for training sets larger than the disk."""

import argparse
import sys
from collections.abc import Iterator
from pathlib import Path

from pipelines.shared.flags import add_cache_argument
from render.records.manifest import MANIFEST, SceneSpec, manifest_text, read_manifest
from render.records.mirror import display_name, measure_stored, open_folder, shard_path
from render.records.packs import PACK, TARS, pack_tar, plan_tars, plan_text
from render.records.shards import is_sealed
from render.shared.errors import InputError
from render.shared.progress import progress_bar
from render.shared.storage import Store, address


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the flags of `sdps data pack`."""
    parser.add_argument("folder", type=Path, help="data folder (the one with manifest.jsonl)")
    parser.add_argument("--out", required=True, help="folder or address to write; an interrupted run goes on there")
    parser.add_argument("--tar-mb", type=float, default=128.0, metavar="MB",
                        help="largest size of a tar")  # fmt: skip
    parser.add_argument("--seed", type=int, default=0, help="seed of the order of the scenes")
    parser.add_argument("--skip-missing", action="store_true", help="leave out planned scenes that have no shard yet")
    add_cache_argument(parser)


def main(args: argparse.Namespace) -> int:
    """Write the manifest and the plan, or make sure that they are those there; then the tars that are not there yet."""
    if not args.tar_mb > 0 or args.seed < 0:
        raise InputError(f"--tar-mb must be above 0 and --seed from 0 up, got {args.tar_mb:g} and {args.seed}")
    with open_folder(args.folder, args.cache_gb) as folder:
        scenes = list_scenes(folder, skip_missing=args.skip_missing)
        by_id = {scene.id: scene for scene in scenes}
        sizes = [measure_stored(folder, scene)[0] for scene in scenes]
        plan = plan_tars(scenes, sizes, round(args.tar_mb * 1e6), args.seed)
        store = Store(address(args.out) or f"file://{Path(args.out).resolve()}")
        there = {name for name in store.files() if name.startswith(f"{TARS}/")}
        for name, data in ((MANIFEST, manifest_text(scenes).encode()), (PACK, plan_text(plan))):
            if not there:
                store.write(name, data)
            elif store.read(name) != data:
                about = "holds other scenes, or tars of another --tar-mb or --seed; choose another --out"
                raise InputError(f"{store.url}/{name}: {about}")
        left = [name for name in plan if name not in there]
        for name in progress_bar(left, desc="pack", unit="tar", disable=None if left else True):
            store.write(name, pack_tar(_shards(folder, [by_id[id] for id in plan[name]])))
    sys.stdout.write(
        f"{args.out}: {len(scenes)} scenes ({sum(sizes) / 1e9:.3g} GB) in {len(plan)} tars, {len(left)} written now, "
        f"{len(plan) - len(left)} kept; train on it with `sdps train --data {args.out}`\n"
    )
    return 0


def list_scenes(folder: Path, *, skip_missing: bool) -> list[SceneSpec]:
    """Return the scenes to pack, in the order of the manifest.

    Raises:
        InputError: scenes that are still to be rendered, unless they are skipped.
    """
    from sdps.data.scene_store import list_finished

    scenes = read_manifest(folder)
    ready = {scene.id for split in {scene.split for scene in scenes}
             for scene in list_finished(folder, split, skip_missing=skip_missing)}  # fmt: skip
    return [scene for scene in scenes if scene.id in ready]


def _shards(folder: Path, scenes: list[SceneSpec]) -> Iterator[tuple[SceneSpec, bytes]]:
    """Yield scenes and the bytes of their shards; InputError for one that is not whole."""
    for scene in scenes:
        data = shard_path(folder, scene).read_bytes()
        if not is_sealed(data):
            raise InputError(
                f"{display_name(folder)}/{scene.file}: truncated or altered; "
                "`sdps render-data --verify` renders it again"
            )
        yield scene, data
