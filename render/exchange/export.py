"""Shards into another layout, scene by scene: each folder whole or absent, resumable, with a record of it all."""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from render.exchange.layouts import LAYOUTS
from render.exchange.layouts.foreign_samples import MARKER, read_record
from render.exchange.samples import ExportOptions, prepare
from render.records.manifest import MANIFEST, SceneSpec, read_manifest
from render.records.mirror import select_rendered, shard_path
from render.records.shards import file_hash, read_shard
from render.shared.errors import InputError
from render.shared.files import atomic_folder, write_json
from render.shared.imaging import mixing
from render.shared.progress import progress_bar
from render.shared.temporary import is_empty

RECORD = "export.json"
_LISTED = ("shape", "material", "split", "exposure", "clipped", "black", "sha256", "spec")
"""What of a scene's record is in the record of the tree too."""


@dataclass(frozen=True)
class ExportReport:
    """What an export did: scenes written now, scenes that were there, and the record of every scene in the tree."""

    written: int
    kept: int
    scenes: dict[str, dict[str, Any]]

    def worst(self, field: str) -> tuple[float, float, str]:
        """Return mean and maximum of the shares `clipped` or `black`, and the scene that has the maximum."""
        shares = {name: scene[field] for name, scene in self.scenes.items()}
        worst = max(shares, key=shares.__getitem__)
        return float(np.mean(list(shares.values()))), shares[worst], worst


def export(folder: str | Path, out: str | Path, options: ExportOptions, scenes: Sequence[SceneSpec]) -> ExportReport:
    """Write `scenes` of a data folder to `out`; those that are there already are skipped.

    Args:
        folder: Data folder.
        out: Root of the tree; new, empty, or from an earlier export with the same options.
        options: How.
        scenes: What, from the folder's manifest.

    Raises:
        InputError: a missing or damaged shard, a foreign or differing tree in `out`, or a full disk. Scenes that were
            finished stay; the lists that name them are written last.
    """
    folder, root, layout = Path(folder), Path(out), LAYOUTS[options.layout]
    planned = read_manifest(folder)
    _check_shards(folder, scenes)
    versions = {"sdps": metadata.version("sdps"), "numpy": np.__version__, "opencv": cv2.__version__}
    record = options.settings() | {"manifest": file_hash(folder / MANIFEST), "versions": versions}
    places = layout.name_folders(planned)
    chosen = {scene.id for scene in scenes}
    there = [scene for scene in planned if scene.id in chosen or _read_marker(root / places[scene.id], scene)]
    _check_lights(folder, there, options)
    claim(root, record)
    written = 0
    with progress_bar(scenes, unit="scene", desc=f"export {options.layout}") as bar:
        for scene in bar:
            if _read_marker(root / places[scene.id], scene) is None:
                _write_scene(folder, root / places[scene.id], scene, options)
                written += 1
    found = {}
    for scene in planned:
        marker = _read_marker(root / places[scene.id], scene)
        if marker is not None:
            found[scene.id] = {"folder": places[scene.id]} | {key: marker[key] for key in _LISTED}
    layout.write_lists(root, [(scene, places[scene.id]) for scene in planned if scene.id in found])
    write_json(root / RECORD, record | {"scenes": found})
    return ExportReport(written, len(scenes) - written, found)


def _check_shards(folder: Path, scenes: Sequence[SceneSpec]) -> None:
    """Refuse scenes without a shard before anything is written."""
    there = {scene.id for scene in select_rendered(folder, scenes)}
    missing = [scene.id for scene in scenes if scene.id not in there]
    if missing:
        raise InputError(
            f"{folder}: {len(missing)} of {len(scenes)} shards are missing, the first is {missing[0]!r}; finish the "
            "folder with `sdps render-data` or pass --skip-missing"
        )


def _check_lights(folder: Path, scenes: Sequence[SceneSpec], options: ExportOptions) -> None:
    """Refuse numbers of lights that the layout or the mixture cannot do with."""
    counts = {len(scene.lights) for scene in scenes}
    LAYOUTS[options.layout].check_lights(counts, folder)
    if options.mixed is not None:
        mixing.require_enough(min(counts), str(folder))
        options.mixed.load()


def claim(root: Path, record: dict[str, Any]) -> None:
    """Start a tree, or make sure that the one there comes from the same scenes and options."""
    path = root / RECORD
    if root.exists() and not root.is_dir():
        raise InputError(f"{root}: is a file; choose another --out")
    if not path.exists():
        if root.is_dir() and not is_empty(root):
            raise InputError(f"{root}: has files but no {RECORD}, so it is not ours to write to; choose another --out")
        write_json(path, record | {"scenes": {}})
        return
    before = read_record(path)
    for field in ("layout", "bits", "exposure", "intensities", "manifest", "mixed"):
        if before.get(field) != record.get(field):
            raise InputError(
                f"{path}: {field} was {before.get(field)!r}, now it is {record.get(field)!r}; choose another --out"
            )


def _read_marker(path: Path, scene: SceneSpec) -> dict[str, Any] | None:
    """Return the record in a scene's folder, None where the scene is missing or from another manifest line."""
    if not (path / MARKER).is_file():
        return None
    marker = read_record(path / MARKER)
    return marker if marker.get("spec") == scene.digest() else None


def _write_scene(folder: Path, final: Path, scene: SceneSpec, options: ExportOptions) -> None:
    """Write one scene's folder, its record with it."""
    layout, source = LAYOUTS[options.layout], shard_path(folder, scene)
    sample, facts = prepare(read_shard(source, scene), scene, options)
    marker = {"id": scene.id, "shape": scene.shape, "material": scene.material, "split": scene.split} | facts
    marker |= {"bits": options.settings()["bits"], "sha256": file_hash(source), "spec": scene.digest()}
    if scene.light_distances:
        marker["light_positions"] = np.asarray(scene.light_positions(), np.float64).round(6).tolist()
    if scene.view.camera_distance is not None:
        marker["camera_distance"] = scene.view.camera_distance
    if not layout.directions and options.mixed is None:
        marker["light_directions"] = sample.directions.tolist()
        marker["light_intensities"] = sample.intensities.tolist()
    with atomic_folder(final) as temporary:
        layout.write(temporary, final, sample)
        (temporary / MARKER).write_text(json.dumps(marker) + "\n", encoding="utf-8")
