"""The plan of a data folder: one line per scene, written before the first pixel is rendered."""

import hashlib
import json
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields, replace
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np

from render.shared.config import build, to_plain
from render.shared.errors import InputError
from render.shared.files import is_plain_name, read_jsonl, read_whole_lines, write_text

MANIFEST = "manifest.jsonl"
FAILED = "failed.jsonl"
OWN_MESHES = "meshes"  # family of shapes that are files of the user's own
COMPOSITION = "composition"  # family of shapes that are several objects in one scene
LARGEST = 16384  # pixels along a side
_LATER = ("light_distances",)


@dataclass(frozen=True, kw_only=True)
class View:
    """Pose of the object before the fixed camera, which is orthographic or, with `camera_distance`, perspective.

    Attributes:
        rotation: Row-major 3x3 rotation, object to camera frame (x right, y up, z to the camera).
        scale: Radius of the object's unit sphere, in half image widths (1 touches the frame).
        offset: Image-plane translation (x right, y up), in half image widths.
        camera_distance: Distance of a perspective camera, a pinhole on the z axis, from the plane z = 0 through the
            object's centre, in half image widths: in that plane the frame spans [-1, 1], as in an orthographic view.
            The field of view is 2 atan(1 / distance). None: orthographic.
    """

    rotation: tuple[float, ...] = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)
    scale: float = 0.9
    offset: tuple[float, float] = (0.0, 0.0)
    camera_distance: float | None = None

    def __post_init__(self) -> None:
        matrix = self.matrix()
        if matrix.shape != (3, 3) or not np.allclose(matrix @ matrix.T, np.eye(3), atol=1e-4):
            raise InputError("view.rotation must be the nine numbers of a rotation matrix")
        if not 0.0 < self.scale <= 10.0:
            raise InputError(f"view.scale must be in (0, 10], got {self.scale}")
        if self.camera_distance is not None and not self.scale < self.camera_distance < np.inf:
            raise InputError(
                f"view.camera_distance is {self.camera_distance:g}, but the object reaches {self.scale:g} towards the "
                "camera (view.scale); give a larger distance"
            )

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
        lights: Unit directions (x, y, z) from the surface to each light, camera frame, z > 0; of near lights, from the
            object's centre, (offset, 0) in the camera frame.
        size: Image side in pixels; (height, width) where they differ, which only imported scenes may.
        spp: Camera samples per pixel.
        bounces: Interreflection bounces (0 = direct light only).
        light_distances: Distance of each light, a point, from the object's centre, in half image widths; its irradiance
            there is pi and falls with the inverse square of the distance. Empty: distant lights.
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
    light_distances: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        if not is_plain_name(self.id):
            raise InputError(f"id: {self.id!r} cannot name a file; use letters, digits, '-', '_' and '.'")
        if min(self.seed, self.bounces, self.spp) < 0 or min(self.resolution) < 1 or max(self.resolution) > LARGEST:
            raise InputError(
                f"scene {self.id}: wants seed, bounces and spp from 0 and a size from 1 to {LARGEST}, "
                f"got seed {self.seed}, bounces {self.bounces}, spp {self.spp}, size {self.size}"
            )
        if not self.light_distances:
            return
        if len(self.lights) not in (0, len(self.light_distances)):  # a reader adds the lights last
            raise InputError(f"light_distances: {len(self.light_distances)} of {len(self.lights)} lights")
        for number, distance in enumerate(self.light_distances):
            if not self.view.scale < distance < np.inf:
                raise InputError(
                    f"light_distances: light {number} is {distance:g} from the object's centre, inside the sphere of "
                    f"radius {self.view.scale:g} that holds the object (view.scale); move it out"
                )

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
        return hashlib.sha256(json.dumps(self.row(), sort_keys=True).encode()).hexdigest()

    def line(self) -> str:
        """Return the manifest line, with its end."""
        return json.dumps(self.row()) + "\n"

    def row(self) -> dict[str, Any]:
        """Return the manifest line; what was added later stands in it only where it is used, so that bytes stay."""
        view = {key: value for key, value in to_plain(self.view).items() if value is not None}
        # Not `to_plain` as a whole: it would copy every light, and JSON writes tuples as lists anyway.
        row = {field.name: getattr(self, field.name) for field in fields(self)} | {"view": view}
        return {key: value for key, value in row.items() if value != () or key not in _LATER}

    def light_directions(self) -> np.ndarray:  # (L, 3) float32
        """Return the light directions as an array."""
        return np.asarray(self.lights, dtype=np.float32).reshape(-1, 3)

    def light_positions(self) -> np.ndarray | None:  # (L, 3) float32
        """Return the positions of near lights in the camera frame, in half image widths; None for distant lights."""
        if not self.light_distances:
            return None
        lights = np.asarray(self.lights, np.float64).reshape(-1, 3)
        unit = lights / np.linalg.norm(lights, axis=1, keepdims=True)
        centre = np.array([*self.view.offset, 0.0])
        return (centre + unit * np.asarray(self.light_distances)[:, None]).astype(np.float32)


def write_manifest(folder: str | Path, scenes: Sequence[SceneSpec]) -> None:
    """Write `manifest.jsonl` in `folder`, atomically."""
    write_text(Path(folder) / MANIFEST, manifest_text(scenes))


def manifest_text(scenes: Sequence[SceneSpec]) -> str:
    """Return the content of `manifest.jsonl`: a line per scene."""
    return "".join(scene.line() for scene in scenes)


def claim(folder: str | Path, scenes: Sequence[SceneSpec]) -> None:
    """Write the manifest of a data folder, or make sure that the one there plans the same scenes.

    Raises:
        InputError: the folder holds another plan.
    """
    path = Path(folder) / MANIFEST
    if not path.exists():
        write_manifest(folder, scenes)
    elif read_manifest(folder) != list(scenes):
        raise InputError(f"{path}: holds another plan; remove the folder or choose another --out")


def read_manifest(folder: str | Path, split: str | None = None) -> list[SceneSpec]:
    """Read the scenes planned in `folder`, optionally only those of one split.

    Raises:
        InputError: no manifest (not a data folder), a malformed line, or no scene of the split.
    """
    path = Path(folder) / MANIFEST
    if not path.is_file():
        raise no_manifest(Path(folder))
    chosen = [scene for scene in _scenes(path) if split in (None, scene.split)]
    if not chosen:
        raise InputError(f"{path}: no scene{f' of split {split!r}' if split else ''}; plan more scenes")
    return chosen


def no_manifest(folder: Path) -> InputError:
    """Build the error for a folder that is not a data folder, naming the one inside it where there is one."""
    inner = folder / "data"
    if (inner / MANIFEST).is_file():
        return InputError(f"{folder}: no {MANIFEST} there; name its data folder, {inner}")
    return InputError(
        f"{folder}: no {MANIFEST} there; name a data folder such as out/small/data, or make one with `sdps data plan` "
        "or `sdps render-data`"
    )


def read_events(path: Path) -> Iterator[dict[str, Any]]:
    """Yield the whole lines of a ledger, which may be missing, and may be appended to at this moment.

    Raises:
        InputError: the file cannot be read.
    """
    # Of a line torn by a crash, the shard is found by its hash, the failure happens again.
    for row in read_whole_lines(path):
        if isinstance(row, dict) and isinstance(row.get("id"), str) and isinstance(row.get("time"), str):
            yield row


def read_failed(folder: Path) -> dict[str, list[dict[str, Any]]]:
    """Return all recorded failures by scene id, oldest first; some of these scenes may be done by now."""
    failures: dict[str, list[dict[str, Any]]] = {}
    for line in read_events(folder / FAILED):
        if not isinstance(line.get("reason"), str):
            continue  # damaged: it happens again
        failures.setdefault(line["id"], []).append(line)
    return failures


def _scenes(path: Path) -> Iterator[SceneSpec]:
    """Yield the scenes of a manifest; those of one view, which differ in id and material only, share its values."""
    last: Any = None
    scene: SceneSpec | None = None
    for number, row in enumerate(read_jsonl(path), start=1):
        own: dict[str, Any] = {key: row.get(key) for key in ("id", "material")} if isinstance(row, dict) else {}
        if scene is not None and {type(value) for value in own.values()} == {str} and row == last | own:
            scene = replace(scene, **own)
        else:
            scene = _scene(row, f"{path}: line {number}")
        last = row
        yield scene


def _scene(row: Any, where: str) -> SceneSpec:
    """Build a scene from a line; its lights, which are most of it, are not read number by number if all are sound."""
    lights: Any = row.get("lights") if isinstance(row, dict) else None
    if _is_vectors(lights):
        scene = replace(_build(row | {"lights": ()}, where), lights=tuple(map(tuple, lights)))
    else:
        scene = _build(row, where)
    if not all(map(math.isfinite, chain.from_iterable(scene.lights))):
        raise InputError(f"{where}.lights: a direction is not finite; plan the data again")
    return scene


def _build(row: Any, where: str) -> SceneSpec:
    """Build a scene; complaints name the line."""
    try:
        return build(SceneSpec, row, where)
    except InputError as error:
        raise InputError(str(error) if str(error).startswith(where) else f"{where}: {error}") from error


def _is_vectors(value: Any) -> bool:
    """Return whether a JSON value is a list of lists of three floats, which needs no conversion but to tuples."""
    return (
        isinstance(value, list)
        and {type(row) for row in value} == {list}
        and {len(row) for row in value} == {3}
        and {type(number) for number in chain.from_iterable(value)} == {float}
    )
