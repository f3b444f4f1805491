"""PS-FCN trees and DiLiGenT folders into a data folder that the trainer and the tools read like a rendered one.

What the source does not say is not made up: depth is zero, coverage is the mask, samples and seed are zero, and each
shard's provenance says so. Radiance is per unit light intensity; its absolute scale is known only where our own export
left a record.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np

from render.exchange import frame
from render.exchange.layouts import LAYOUTS
from render.exchange.layouts.foreign_samples import Source, read_record, size_text
from render.exchange.layouts.layout_base import legal_name, unique_names
from render.records.manifest import MANIFEST, SceneSpec, View, read_manifest, write_manifest
from render.records.shards import Shard, is_whole, to_half, write_shard
from render.shared.config import to_plain
from render.shared.errors import InputError, unknown
from render.shared.files import write_json
from render.shared.progress import progress_bar
from render.shared.temporary import is_empty

RECORD = "import.json"
IMPORTABLE = [name for name, layout in LAYOUTS.items() if layout.importable]
SIZE_MULTIPLE = 4  # the normal networks halve the image twice


@dataclass(frozen=True, kw_only=True)
class ImportOptions:
    """How a foreign tree becomes shards.

    Attributes:
        layout: A name of `IMPORTABLE`.
        split: Split of all scenes; None takes that of the tree's lists, `test` where there are none.
        crop: Margin in pixels around the mask's bounding box, whose sides are rounded up to multiples of 4; None keeps
            the whole image.
        y_down: Normals and lights of the source have y pointing down; both are turned.
        limit: Only the first so many samples.
    """

    layout: str
    split: Literal["train", "val", "test"] | None = None
    crop: int | None = None
    y_down: bool = False
    limit: int | None = None

    def __post_init__(self) -> None:
        if self.layout not in IMPORTABLE:
            raise unknown("layout", self.layout, IMPORTABLE)
        if self.split not in (None, "train", "val", "test"):
            raise unknown("split", str(self.split), ("train", "val", "test"))
        if self.crop is not None and self.crop < 0:
            raise InputError(f"crop must be a margin of 0 pixels or more, got {self.crop}")
        if self.limit is not None and self.limit < 1:
            raise InputError(f"limit must be at least 1, got {self.limit}")


class Box(NamedTuple):
    """Part of an image; it may reach beyond the lower and right border, where zeros are filled in."""

    top: int
    left: int
    height: int
    width: int

    def cut(self, array: np.ndarray, axis: int = 0) -> np.ndarray:
        """Cut the box out of the rows and columns at `axis` and `axis + 1`."""
        rows, columns = slice(self.top, self.top + self.height), slice(self.left, self.left + self.width)
        part = array[(slice(None),) * axis + (rows, columns)]
        pad = {axis: (0, self.height - part.shape[axis]), axis + 1: (0, self.width - part.shape[axis + 1])}
        return np.pad(part, [pad.get(number, (0, 0)) for number in range(array.ndim)])


@dataclass(frozen=True)
class ImportReport:
    """What an import did: shards written now, shards that were there, scenes, and suspicions by scene id."""

    written: int
    kept: int
    scenes: list[SceneSpec]
    suspicions: dict[str, list[str]]


def ingest(tree: str | Path, out: str | Path, options: ImportOptions) -> ImportReport:
    """Turn the samples of `tree` into shards and a manifest in `out`; whole shards that are there are kept.

    Args:
        tree: Root of the tree.
        out: Data folder; new, empty, or from an earlier import of the same samples.
        options: How.

    Raises:
        InputError: a malformed tree, another content in `out`, or a full disk. Finished shards stay.
    """
    tree, out = Path(tree), Path(out)
    if not tree.is_dir():
        raise InputError(f"{tree}: no such folder; give the root of a {options.layout} tree")
    sources = [read() for read in LAYOUTS[options.layout].list_samples(tree)[: options.limit]]
    boxes = [crop_box(source.truth().mask, options.crop) for source in sources]
    scenes = _describe_scenes(sources, boxes, options)
    _claim(out, scenes)
    written = 0
    suspicions = read_record(out / RECORD).get("suspicions", {}) if (out / RECORD).is_file() else {}
    items = list(zip(sources, boxes, scenes, strict=True))
    with progress_bar(items, unit="scene", desc=f"import {options.layout}") as bar:
        for source, box, scene in bar:
            if is_whole(out / scene.file, scene):
                continue
            shard, found = _read_shard(source, box, scene, options)
            write_shard(out / scene.file, shard)
            written += 1
            if found:
                suspicions[scene.id] = found
    record = to_plain(options) | {"source": tree.resolve().name, "scenes": len(scenes), "suspicions": suspicions}
    write_json(out / RECORD, record)
    return ImportReport(written, len(scenes) - written, scenes, suspicions)


def _describe_scenes(sources: Sequence[Source], boxes: Sequence[Box], options: ImportOptions) -> list[SceneSpec]:
    """Describe each sample as a manifest line; fields only a renderer has are zero."""
    scenes = []
    # `_` parts shape and material.
    ids = ["_".join(map(legal_name, dict.fromkeys((source.shape, source.material)))) for source in sources]
    for name, source, box in zip(unique_names(ids), sources, boxes, strict=True):
        directions = source.directions * (1.0, -1.0 if options.y_down else 1.0, 1.0)
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        scenes.append(SceneSpec(
            id=name, seed=0, split=options.split or source.split, shape=f"imported:{source.shape}",
            material=f"imported:{source.material}", view=View(),
            lights=tuple((float(x), float(y), float(z)) for x, y, z in directions.round(8)),
            size=box.height if box.height == box.width else (box.height, box.width), spp=0, bounces=0,
        ))  # fmt: skip
    return scenes


def crop_box(mask: np.ndarray, margin: int | None) -> Box:
    """Return the mask's bounding box with its margin, its sides rounded up to multiples of 4."""
    height, width = mask.shape
    if margin is None:
        return Box(0, 0, height, width)
    sides = []
    for axis, extent in enumerate((height, width)):
        places = np.nonzero(mask.any(1 - axis))[0]
        low, high = max(int(places[0]) - margin, 0), min(int(places[-1]) + 1 + margin, extent)
        length = -(-(high - low) // SIZE_MULTIPLE) * SIZE_MULTIPLE
        sides.append((max(min(low, extent - length), 0), length))
    return Box(sides[0][0], sides[1][0], sides[0][1], sides[1][1])


def _read_shard(source: Source, box: Box, scene: SceneSpec, options: ImportOptions) -> tuple[Shard, list[str]]:
    """Read one sample; also return what looks flipped in it."""
    truth = source.truth()
    images, bits = source.stack(truth.mask.shape)
    exposure = source.exposure()
    images = box.cut(images, 1) / np.float32(exposure or 1.0)
    normals, mask = box.cut(truth.normals), box.cut(truth.mask)
    if options.y_down:
        normals = normals * np.array([1.0, -1.0, 1.0], np.float32)
    found = frame.find_faults(images, normals, mask, scene.light_directions())
    provenance: dict[str, str | int | float] = {
        "spec": scene.digest(),
        "shape": scene.shape,
        "material": scene.material,
        "imported_from": options.layout,
        "source": source.where,
        "source_sha256": source.digest(),
        "source_bits": bits,
        "irradiance": "relative: full scale / light intensity = 1" if exposure is None else "pi",
        "frame": "x right, y up, z to the camera" + (" (source: y down)" if options.y_down else ""),
        "normals": truth.origin.name,
        "depth": "unknown, zeros",
        "coverage": "unknown, the mask",
        "crop": f"top {box.top}, left {box.left}, of {size_text(truth.mask.shape)}",
        "frame_check": "; ".join(found) or "passed",
    }
    shard = Shard(
        scene_id=scene.id, images=to_half(images), normals=normals, depth=np.zeros(mask.shape, np.float32), mask=mask,
        coverage=mask.astype(np.float32), light_directions=scene.light_directions(), provenance=provenance,
    )  # fmt: skip
    return shard, found


def _claim(out: Path, scenes: Sequence[SceneSpec]) -> None:
    """Start a data folder, or make sure that the one there holds the same scenes."""
    if (out / MANIFEST).is_file():
        if read_manifest(out) != list(scenes):
            raise InputError(f"{out / MANIFEST}: holds other scenes; remove the folder or choose another --out")
    elif out.exists() and (not out.is_dir() or not is_empty(out)):
        raise InputError(f"{out}: is not empty and has no {MANIFEST}; choose another --out")
    else:
        write_manifest(out, scenes)
