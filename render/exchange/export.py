"""Shards into another layout, scene by scene: each folder whole or absent, resumable, with a record of it all."""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np

from render.exchange.layouts import LAYOUTS
from render.exchange.layouts.foreign_samples import MARKER, read_record
from render.exchange.layouts.layout_base import Sample
from render.records.manifest import MANIFEST, SceneSpec, read_manifest
from render.records.mirror import select_rendered, shard_path
from render.records.shards import Shard, file_hash, read_shard
from render.shared.config import check_fields, to_plain
from render.shared.errors import InputError, unknown
from render.shared.files import atomic_folder, write_json
from render.shared.images import quantise
from render.shared.imaging import mixing
from render.shared.progress import progress_bar
from render.shared.seeds import generator
from render.shared.temporary import is_empty

RECORD = "export.json"
# What the record of the tree repeats from a scene's own record.
_LISTED = ("shape", "material", "split", "exposure", "clipped", "black", "sha256", "spec")
_INTENSITY_RANGE = (0.2, 2.0)  # of random intensities (SDPS-Net, section 5.1)
# Share of the object's values `auto` lets clip; 16 bits have room below for more highlight.
_AUTO_CLIPPED = {8: 0.01, 16: 0.001}


@dataclass(frozen=True, kw_only=True)
class ExportOptions:
    """How shards become pictures.

    Attributes:
        layout: A name of `LAYOUTS`.
        bits: 8 or 16 per channel; the layout's own by default.
        exposure: Factor on radiance, 1 maps a white Lambertian surface that faces its light to full scale; `auto`
            picks it per scene so that 1 % (8 bits) or 0.1 % (16 bits) of the object's values clip.
        intensities: `unit`, or `seed`: one per image, uniform in [0.2, 2), drawn from the scene's own seed.
        mixed: Light that is mixed from that of the scene (`render.shared.imaging.mixing`); None keeps a light an image.
        images: Images mixed of each scene.
        seed: Root seed of the mixtures.
    """

    layout: str
    bits: int | None = None
    exposure: float | Literal["auto"] | None = None
    intensities: Literal["unit", "seed"] = "unit"
    mixed: mixing.LightMix | None = None
    images: int = 10
    seed: int = 0

    def __post_init__(self) -> None:
        if self.layout not in LAYOUTS:
            raise unknown("layout", self.layout, LAYOUTS)
        layout = LAYOUTS[self.layout]
        if self.bits is not None and self.bits not in layout.bits:
            allowed = " or ".join(map(str, layout.bits))
            raise InputError(f"bits must be {allowed} for layout {self.layout}, got {self.bits}")
        number = isinstance(self.exposure, int | float) and 0 < self.exposure < float("inf")
        if not number and self.exposure not in ("auto", None):
            raise InputError(f"exposure must be a positive number or 'auto', got {self.exposure!r}")
        if self.intensities not in ("unit", "seed"):
            raise unknown("value for intensities:", str(self.intensities), ("unit", "seed"))
        if self.intensities != "unit" and not layout.intensities:
            raise InputError(f"layout {self.layout} has no file for intensities; leave them at 'unit'")
        if self.mixed is not None and layout.directions:
            others = " or ".join(name for name, other in LAYOUTS.items() if not other.directions)
            raise InputError(f"layout {self.layout} has one direction per image, mixed light has none; take {others}")
        check_fields(self, "at least 1", "images")
        check_fields(self, "not negative", "seed")

    def settings(self) -> dict[str, Any]:
        """Return the options with the layout's defaults filled in."""
        layout = LAYOUTS[self.layout]
        mixed = {"mixed": to_plain(self.mixed) | {"images": self.images, "seed": self.seed}} if self.mixed else {}
        return {
            "layout": self.layout,
            "bits": self.bits or layout.bits[0],
            "exposure": layout.exposure if self.exposure is None else self.exposure,
            "intensities": self.intensities,
        } | mixed


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
    sample, facts = _prepare(read_shard(source, scene), scene, options)
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


def _prepare(shard: Shard, scene: SceneSpec, options: ExportOptions) -> tuple[Sample, dict[str, Any]]:
    """Apply intensities and exposure and round to integers.

    Returns:
        The sample; its exposure, the share of the object's values that clip, and of its positive ones that round to 0;
        where light is mixed, what each image's light is made of.
    """
    bits, exposure = (options.settings()[name] for name in ("bits", "exposure"))
    radiance, directions, facts = _relight(shard, scene, options)
    intensities = np.ones(len(radiance))
    if options.intensities == "seed":
        rng = generator(scene.seed, "export", scene.id, "intensities")
        intensities = rng.uniform(*_INTENSITY_RANGE, len(radiance)).round(6)
    values = radiance.astype(np.float32) * intensities[:, None, None, None].astype(np.float32)
    inside = values[:, shard.mask]
    if exposure == "auto":
        level = float(np.quantile(inside, 1.0 - _AUTO_CLIPPED[bits], method="higher")) if inside.size else 0.0
        exposure = float(f"{1.0 / level:.6g}") if level > 0 else 1.0
    step = 0.5 / (2**bits - 1)  # what rounds to full scale, or to the first code, is not lost
    exposed = inside * np.float32(exposure)
    clipped, black = (
        float(lost.mean()) if lost.size else 0.0 for lost in (exposed > 1.0 + step, exposed[inside > 0] < step)
    )
    sample = Sample(quantise(values * np.float32(exposure), bits), shard.normals, shard.mask, directions, intensities)
    return sample, {"exposure": exposure, "clipped": round(clipped, 6), "black": round(black, 6)} | facts


def _relight(shard: Shard, scene: SceneSpec, options: ExportOptions) -> tuple[np.ndarray, np.ndarray, dict[str, Any]]:
    """Return radiance (Q, H, W, 3), the directions (Q, 3) its light comes from, and what that light is made of."""
    if options.mixed is None:
        return shard.images, np.asarray(scene.lights, np.float64).reshape(-1, 3), {}
    stage = mixing.LightStage(scene.light_directions(), f"scene {scene.id}")
    rng = generator(options.seed, "relight", scene.id)
    weights, recipes = options.mixed.draw(stage, options.images, rng)
    images = mixing.mix(shard.images.reshape(len(shard.images), -1, 3), weights)
    mean = stage.mean_directions(weights).astype(np.float64)
    return images.reshape(-1, *shard.images.shape[1:]), mean, {"lighting": recipes}
