"""The plan of a data folder: one line per scene, written before the first pixel is rendered."""

import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from render.config import build, to_plain
from render.errors import InputError
from render.files import read_jsonl, write_jsonl

MANIFEST = "manifest.jsonl"


@dataclass(frozen=True, kw_only=True)
class View:
    """Pose of the object before the fixed orthographic camera.

    Attributes:
        rotation: Row-major 3x3 rotation, object to camera frame (x right, y up, z to the camera).
        scale: Radius of the object's unit sphere, in half image widths (1 touches the frame).
        offset: Image-plane translation (x right, y up), in half image widths.
    """

    rotation: tuple[float, ...] = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)
    scale: float = 0.9
    offset: tuple[float, float] = (0.0, 0.0)

    def __post_init__(self) -> None:
        matrix = self.matrix()
        if matrix.shape != (3, 3) or not np.allclose(matrix @ matrix.T, np.eye(3), atol=1e-4):
            raise InputError("view.rotation must be the nine numbers of a rotation matrix")
        if not 0.0 < self.scale <= 10.0:
            raise InputError(f"view.scale must be in (0, 10], got {self.scale}")

    def matrix(self) -> np.ndarray:  # (3, 3)
        """Return the rotation as a float64 matrix."""
        values = np.asarray(self.rotation, dtype=np.float64)
        return values.reshape(3, 3) if values.size == 9 else values


@dataclass(frozen=True, kw_only=True)
class SceneSpec:
    """Everything that determines one rendered scene, and so one shard.

    Attributes:
        id: Unique name; the shard is `shards/<id>.exr`.
        seed: Seed of the sampler.
        split: `train`, `val` or `test`.
        shape: A name `render.shapes.load` understands.
        material: A name `render.materials.library.load` understands.
        view: Pose.
        lights: Unit directions (x, y, z) from the surface to each light, camera frame, z > 0.
        size: Image side in pixels; (height, width) where they differ, which only imported scenes may.
        spp: Camera samples per pixel.
        bounces: Interreflection bounces (0 = direct light only).
    """

    id: str
    seed: int
    split: str
    shape: str
    material: str
    view: View
    lights: tuple[tuple[float, float, float], ...]
    size: int | tuple[int, int]
    spp: int
    bounces: int

    @property
    def file(self) -> str:
        """Path of the shard relative to the data folder."""
        return f"shards/{self.id}.exr"

    @property
    def resolution(self) -> tuple[int, int]:
        """Height and width of the images in pixels."""
        return (self.size, self.size) if isinstance(self.size, int) else self.size

    def digest(self) -> str:
        """Return the SHA-256 of the whole line, which its shard carries."""
        return hashlib.sha256(json.dumps(to_plain(self), sort_keys=True).encode()).hexdigest()

    def light_directions(self) -> np.ndarray:  # (L, 3) float32
        """Return the light directions as an array."""
        return np.asarray(self.lights, dtype=np.float32).reshape(-1, 3)


def write_manifest(folder: str | Path, scenes: Sequence[SceneSpec]) -> None:
    """Write `manifest.jsonl` in `folder`, atomically."""
    write_jsonl(Path(folder) / MANIFEST, [to_plain(scene) for scene in scenes])


def read_manifest(folder: str | Path, split: str | None = None) -> list[SceneSpec]:
    """Read the scenes planned in `folder`, optionally only those of one split.

    Raises:
        InputError: no manifest (not a data folder), a malformed line, or no scene of the split.
    """
    path = Path(folder) / MANIFEST
    if not path.is_file():
        raise InputError(f"{folder}: no {MANIFEST} there; render it with `sdps render-data --out {folder}`")
    scenes = [build(SceneSpec, row, f"{path}: line {number}") for number, row in enumerate(read_jsonl(path), start=1)]
    chosen = [scene for scene in scenes if split in (None, scene.split)]
    if not chosen:
        raise InputError(f"{path}: no scene{f' of split {split!r}' if split else ''}; plan more scenes")
    return chosen
