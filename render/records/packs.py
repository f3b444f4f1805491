"""The packed form of a data folder: WebDataset tars of many scenes each, for sets that are read in a stream.

A packed set holds `manifest.jsonl` of the scenes packed, `pack.json`, which says what lies in which tar, and
`tars/<split>-<number>.tar`. A tar has `<id>.exr` of every scene, the shard byte for byte, and `<id>.json`, its manifest
line; `webdataset.WebDataset` reads it anywhere. A store holds one object where there were hundreds.
"""

import io
import json
import tarfile
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from render.records.manifest import SceneSpec
from render.records.shards import is_sealed
from render.shared.errors import InputError
from render.shared.files import read_json
from render.shared.seeds import generator

PACK = "pack.json"
TARS = "tars"
Plan = dict[str, dict[str, int]]
"""Of every tar, by its path in the set, the scenes in it with the bytes of their shards."""
_BLOCK = 512  # bytes; a tar's headers and contents fill whole ones


def plan_tars(scenes: Sequence[SceneSpec], sizes: Sequence[int], limit: int, seed: int) -> Plan:
    """Distribute scenes over tars, by splits, in random order: those of one shape should not lie side by side.

    Args:
        scenes: N scenes.
        sizes: N, bytes of their shards.
        limit: Bytes of a tar; a scene that is larger has one of its own.
        seed: Seed of the order.
    """
    plan: Plan = {}
    limit -= 2 * _BLOCK + tarfile.RECORDSIZE  # what ends a tar
    for split in sorted({scene.split for scene in scenes}):
        places = [place for place, scene in enumerate(scenes) if scene.split == split]
        filled, number, name = limit, -1, ""
        for place in generator(seed, "pack", split).permutation(places):
            scene, size = scenes[place], sizes[place]
            needed = _pad_size(size) + _pad_size(len(scene.line()))
            if filled + needed > limit:
                filled, number = 0, number + 1
                name = f"{TARS}/{split}-{number:06d}.tar"
                plan[name] = {}
            plan[name][scene.id] = size
            filled += needed
    return plan


def _pad_size(size: int) -> int:
    """Return what a member takes in a tar, header included."""
    return _BLOCK * (1 + -(-size // _BLOCK))


def plan_text(plan: Plan) -> bytes:
    """Return the content of `pack.json`."""
    return (json.dumps({"schema": 1, "tars": plan}, separators=(",", ":")) + "\n").encode()


def read_plan(folder: Path) -> Plan:
    """Read `pack.json`.

    Raises:
        InputError: it is missing or was not written by `sdps data pack`.
    """
    remedy = "pack the scenes again (`sdps data pack`)"
    found = read_json(folder / PACK, remedy)
    tars = found.get("tars") if isinstance(found, dict) and found.get("schema") == 1 else None
    if not isinstance(tars, dict) or not all(isinstance(scenes, dict) for scenes in tars.values()):
        raise InputError(f"{folder / PACK}: not a list of tars of this version; {remedy}")
    return tars


def pack_tar(samples: Iterable[tuple[SceneSpec, bytes]]) -> bytes:
    """Return the tar of some scenes and their shards, the same bytes for the same scenes."""
    stream = io.BytesIO()
    with _library().TarWriter(stream, encoder=False, mtime=0) as tar:
        for scene, shard in samples:
            tar.write({"__key__": scene.id, "exr": shard, "json": scene.line().encode()})
    return stream.getvalue()


def unpack_tar(data: bytes, ids: Iterable[str]) -> dict[str, bytes] | None:
    """Return the shards of a tar by scene; None if one of those that should be in it is not, or not whole."""
    from_tar = _library().tariterators.tar_file_iterator
    try:
        members = {member["fname"]: member["data"] for member in from_tar(io.BytesIO(data))}
    except (tarfile.TarError, EOFError):
        return None
    shards = {id: members.get(f"{id}.exr", b"") for id in ids}
    return shards if all(map(is_sealed, shards.values())) else None


def _library() -> Any:
    """Return the module `webdataset`, which loads torch where there is one: only when a tar is written or read."""
    try:
        import webdataset
    except ImportError as error:
        raise InputError(
            f"tars of scenes need a package that is missing ({error}); pip install 'sdps[storage]'"
        ) from error
    return webdataset
