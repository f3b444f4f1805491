"""Reading scenes from shards, with an optional cache of decoded arrays that several processes may share."""

import hashlib
import logging
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from render.records.manifest import FAILED, SceneSpec, read_failed, read_manifest
from render.records.mirror import measure_stored, select_rendered, shard_path, touch_files
from render.records.shards import read_shard
from render.shared.decoding import decoding
from render.shared.errors import InputError
from render.shared.files import atomic_path

CACHE_FOLDER = "cache"
_LAYOUT = "packed with depth"  # names what an entry holds, so that those of earlier versions are not taken for it
_log = logging.getLogger(__name__)


class PackedImages:
    """Images whose pixels off the object, black under every light, take no space; indexed as (L, H, W, 3) would be.

    Args:
        values: (L, P, 3), the pixels kept, float16 in the cache; may be a memory map.
        kept: (H, W) bool, P of them true.
    """

    def __init__(self, values: np.ndarray, kept: np.ndarray) -> None:
        self.values, self.kept = values, kept

    @classmethod
    def of(cls, images: "np.ndarray | PackedImages") -> "PackedImages":
        """Return images (L, H, W, 3) packed, unless they are."""
        if isinstance(images, PackedImages):
            return images
        kept = np.any(images, axis=(0, 3))
        return cls(images[:, kept], kept)

    def __len__(self) -> int:
        return len(self.values)

    def __getitem__(self, chosen: np.ndarray | slice) -> np.ndarray:
        """Return (Q, H, W, 3), typed as the values: images chosen by slice or indices (Q,); only these are read."""
        values = self.values[chosen]
        images = np.zeros((len(values), *self.kept.shape, 3), values.dtype)
        images[:, self.kept] = values
        return images


class StoredScene(NamedTuple):
    """What training needs of a rendered scene; with a cache the images are packed, in a read-only memory map."""

    images: np.ndarray | PackedImages  # (L, H, W, 3) float16
    normals: np.ndarray  # (H, W, 3) float32
    mask: np.ndarray  # (H, W) bool
    depth: np.ndarray  # (H, W) float32, half image widths


class SceneStore:
    """Loads scenes of a data folder.

    Decoding an EXR shard always costs all of its lights; a memory-mapped array costs only those drawn, and on disk 0.4
    of what whole images would (scenes of preset `ship`).

    Args:
        folder: Data folder.
        cache: Keep decoded arrays in `<folder>/cache`. An entry is named by the manifest line and the
            shard's size and time of change, so a shard rendered again is decoded again.
    """

    def __init__(self, folder: Path, *, cache: bool) -> None:
        self.folder = folder
        self.cache = cache

    def fetch(self, scene: SceneSpec) -> None:
        """Bring a scene's shard to this disk, where the folder's shards lie elsewhere; InputError as in `load`."""
        shard_path(self.folder, scene)

    def load(self, scene: SceneSpec) -> StoredScene:
        """Return one scene.

        Raises:
            InputError: the shard is missing, damaged or differs from the manifest.
        """
        if not self.cache:
            return _decode(shard_path(self.folder, scene), scene)
        entry = f"{scene.id}-{_identity(self.folder, scene)}"
        images, truth = (self.folder / CACHE_FOLDER / f"{entry}.{kind}.npy" for kind in ("images", "truth"))
        if not touch_files(self.folder, truth, images):
            stored = _decode(shard_path(self.folder, scene), scene)
            packed = PackedImages.of(stored.images)
            # The images come last: where they are, the ground truth is.
            layers = [stored.normals, *(layer[..., None] for layer in (stored.mask, packed.kept, stored.depth))]
            _save(truth, np.concatenate(layers, axis=-1, dtype=np.float32))
            _save(images, packed.values)
            return stored
        with decoding(images, "an entry of the cache", f"delete {images.parent}"):
            ground = np.load(truth)  # (H, W, 6)
            packed = PackedImages(np.load(images, mmap_mode="r"), ground[..., 4] > 0.5)
            return StoredScene(packed, ground[..., :3], ground[..., 3] > 0.5, ground[..., 5])


def list_finished(folder: Path, split: str, *, skip_missing: bool = False) -> list[SceneSpec]:
    """Return the scenes of a split that have a shard.

    Args:
        folder: Data folder.
        split: `train`, `val` or `test`.
        skip_missing: Leave out scenes without a shard. Those that could not be rendered (`failed.jsonl`) are left out
            in any case, with a warning.

    Raises:
        InputError: no manifest, no scene of the split, or a folder whose rendering is not finished.
    """
    planned = read_manifest(folder, split)
    scenes = select_rendered(folder, planned)
    missing = {scene.id for scene in planned} - {scene.id for scene in scenes}
    failed = missing & read_failed(folder).keys() if missing and not skip_missing else set()
    if not scenes or (missing - failed and not skip_missing):
        raise InputError(
            f"{folder}: {len(missing)} of {len(planned)} shards of split {split!r} are missing; finish it with "
            "`sdps render-data` (a packed set with `sdps data pack`) or set skip_missing"
        )
    if failed:
        about = "%s: %d of %d scenes of split %r could not be rendered (%s) and are left out"
        _log.warning(about, folder, len(failed), len(planned), split, FAILED)
    return scenes


def require_equal_counts(where: str | Path, scenes: Sequence[SceneSpec], images: int) -> None:
    """Refuse scenes that cannot give equally many images, since their samples would not stack.

    Args:
        where: What the scenes belong to, for the message.
        scenes: Scenes to draw from.
        images: Images wanted of each.

    Raises:
        InputError: some scenes have fewer lights than `images`, and not all equally many.
    """
    counts = {min(len(scene.lights), images) for scene in scenes}
    if len(counts) > 1:
        raise InputError(
            f"{where}: scenes have from {min(counts)} lights up, so {images} images cannot be drawn from each; "
            f"set images to {min(counts)} or less"
        )


def _identity(folder: Path, scene: SceneSpec) -> str:
    """Return a short hash of the manifest line and the file's size and time, or what a store has for these."""
    try:
        size, version = measure_stored(folder, scene)
    except OSError as error:
        where = folder / scene.file
        raise InputError(f"{where}: no such shard; run `sdps render-data` to finish the folder") from error
    text = f"{_LAYOUT} {scene.digest()} {size} {version}"
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def _decode(path: Path, scene: SceneSpec) -> StoredScene:
    shard = read_shard(path, scene)
    return StoredScene(shard.images, shard.normals, shard.mask, shard.depth)


def _save(path: Path, array: np.ndarray) -> None:
    with atomic_path(path) as temporary:
        np.save(temporary, array)
