"""The EXR shard: the one file format both rooms share, and its only writer and reader.

A shard is one multi-part OpenEXR file (ZIP, lossless) per scene. Part `gt` (float32) holds
`normal.X/Y/Z` (camera frame, zero outside the mask), `Z` (depth), `mask` (0 or 1) and `coverage`
(share of a pixel's samples that hit the object), and of compositions `object` (uint32, which of the objects most
samples hit, from 1, zero outside the mask); a part `materials` (float32) of spatially-varying scenes holds the
weights `w0`, `w1`, ... of the materials its header names; parts `L000`, `L001`, ... (float16) hold the linear
RGB radiance under one light of irradiance pi, with its direction, and the position of a near one, in the part's header.

OpenEXR's binding silently corrupts non-contiguous arrays (openexr #1929) and arrays of unusual channel
counts, and opens damaged files with fewer parts; so there is one checked writer, a digest of the whole file, and
a reader that refuses anything that differs from the digest or the manifest.
"""

import hashlib
import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR

from render.records.manifest import SceneSpec
from render.shared.decoding import exr_parts
from render.shared.errors import InputError
from render.shared.files import atomic_path, read_bytes

SCHEMA = 1
_MATERIALS = "materials"
HALF_LIMIT = 65504.0
_OWN_ATTRIBUTES = ("ps:schema", "ps:scene_id", "ps:light_count", "ps:digest")
_DIGEST = re.compile(rb"ps:digest\0string\0\x40\0\0\0([0-9a-f]{64})")  # as OpenEXR lays an attribute out
_SPEC = re.compile(rb"ps:spec\0string\0\x40\0\0\0([0-9a-f]{64})")
_DTYPES = (np.dtype(np.float16), np.dtype(np.float32), np.dtype(np.uint32))


@dataclass(frozen=True, eq=False)
class Shard:
    """One rendered scene.

    Attributes:
        scene_id: Id of its manifest line.
        images: (L, H, W, 3) float16, linear radiance per light of irradiance pi.
        normals: (H, W, 3) float32, unit shading normals in the camera frame, zero outside the mask.
        depth: (H, W) float32, z of the surface in half image widths (towards the camera), zero outside.
        mask: (H, W) bool, pixels of which at least half the samples hit the object.
        coverage: (H, W) float32 in [0, 1], share of samples that hit the object.
        light_directions: (L, 3) float32, unit, from the surface to the light; to near lights, from the object's centre.
        weights: (M, H, W) float32 in [0, 1], mean weight of each material in a pixel of the mask (they sum to 1), zero
            outside; None for a scene of one material.
        materials: Names of the M materials; empty for a scene of one material.
        light_positions: (L, 3) float32, camera frame, half image widths, of near lights: points with irradiance pi at
            the object's centre, falling with the inverse square of the distance. None: distant lights.
        objects: (H, W) uint32, which object of a composition each pixel shows, from 1; 0 outside the mask. None for a
            scene of one object.
        provenance: File-level header attributes (schema, seed, versions, names), all text or numbers.
    """

    scene_id: str
    images: np.ndarray
    normals: np.ndarray
    depth: np.ndarray
    mask: np.ndarray
    coverage: np.ndarray
    light_directions: np.ndarray
    weights: np.ndarray | None = None
    materials: tuple[str, ...] = ()
    light_positions: np.ndarray | None = None
    objects: np.ndarray | None = None
    provenance: dict[str, str | int | float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        count, height, width = self.images.shape[:3]
        expected = {
            "images": ((count, height, width, 3), np.float16),
            "normals": ((height, width, 3), np.float32),
            "depth": ((height, width), np.float32),
            "mask": ((height, width), np.bool_),
            "coverage": ((height, width), np.float32),
            "light_directions": ((count, 3), np.float32),
        }
        if self.weights is not None or self.materials:
            expected["weights"] = ((len(self.materials), height, width), np.float32)
        if self.light_positions is not None:
            expected["light_positions"] = ((count, 3), np.float32)
        if self.objects is not None:
            expected["objects"] = ((height, width), np.uint32)
        for name, (shape, dtype) in expected.items():
            array = np.asarray(getattr(self, name))
            if array.shape != shape or array.dtype != dtype:
                raise InputError(
                    f"shard {self.scene_id}: {name} must be {np.dtype(dtype)} of shape {shape}, "
                    f"got {array.dtype} of shape {array.shape}"
                )

    @property
    def camera_distance(self) -> float | None:
        """Distance of a perspective camera from the plane z = 0, in half image widths; None: orthographic."""
        distance = self.provenance.get("camera_distance")
        return None if distance is None else float(distance)

    @property
    def centre(self) -> np.ndarray:  # (3,)
        """The object's centre in the camera frame, where near lights have irradiance pi."""
        return np.array([float(value) for value in str(self.provenance.get("light_reference", "0 0 0")).split()])


def write_exr(path: str | Path, parts: list[tuple[str, dict[str, Any], dict[str, np.ndarray]]]) -> None:
    """Write a multi-part OpenEXR file; the only place in the project that does.

    Args:
        path: Destination; written to a temporary name, checked, then renamed.
        parts: (name, header attributes, channels) per part. Channels are float16, float32 or uint32,
            (H, W) or (H, W, 3), finite.

    Raises:
        InputError: a non-finite value, or the disk refuses the file. Nothing is left behind.
    """
    checked = []
    for name, attributes, channels in parts:
        header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage, **attributes}
        checked.append(OpenEXR.Part(header, {key: _check(value, f"{name}.{key}") for key, value in channels.items()},
                                    name))  # fmt: skip
    with atomic_path(path) as temporary:
        try:
            OpenEXR.File(checked).write(str(temporary))
            _seal(temporary)
        except (RuntimeError, ValueError) as error:
            # The binding reports a full disk as RuntimeError; atomic_path turns OSError into one clear line.
            raise OSError(f"OpenEXR could not write it: {error}") from error


def _check(array: np.ndarray, name: str) -> np.ndarray:
    """Return a contiguous copy of an array OpenEXR writes correctly, or refuse it."""
    assert array.dtype in _DTYPES, f"{name}: {array.dtype}"
    assert array.ndim == 2 or (array.ndim == 3 and array.shape[2] == 3), f"{name}: {array.shape}"
    if array.dtype != np.uint32 and not np.isfinite(array).all():
        raise InputError(f"{name}: the image has infinite or NaN values; refusing to write it")
    return np.ascontiguousarray(array)


def write_shard(path: str | Path, shard: Shard) -> None:
    """Write `shard` atomically; radiance was already rounded to half precision by the caller.

    Raises:
        InputError: non-finite values or an unwritable disk.
    """
    attributes = {"ps:schema": SCHEMA, "ps:scene_id": shard.scene_id, "ps:light_count": len(shard.images)}
    attributes["ps:digest"] = "0" * 64  # filled in by `_seal`
    attributes |= {f"ps:{key}": value for key, value in shard.provenance.items()}
    ground_truth = {
        "normal.X": shard.normals[..., 0],
        "normal.Y": shard.normals[..., 1],
        "normal.Z": shard.normals[..., 2],
        "Z": shard.depth,
        "mask": shard.mask.astype(np.float32),
        "coverage": shard.coverage,
    }
    if shard.objects is not None:
        ground_truth["object"] = shard.objects
    parts = [("gt", attributes, ground_truth)]
    if shard.weights is not None:
        channels = {f"w{number}": weight for number, weight in enumerate(shard.weights)}
        parts.append((_MATERIALS, {"ps:materials": "+".join(shard.materials)}, channels))
    for index, (image, direction) in enumerate(zip(shard.images, shard.light_directions, strict=True)):
        header = {"ps:light_dir": direction.astype(np.float32)}
        if shard.light_positions is not None:
            header["ps:light_pos"] = shard.light_positions[index].astype(np.float32)
        parts.append((f"L{index:03d}", header, {"RGB": image}))
    write_exr(path, parts)


def _seal(path: Path) -> None:
    """Put the digest of the file into its `ps:digest` attribute, if it has one."""
    data = path.read_bytes()
    match = _DIGEST.search(data)
    if match:
        with open(path, "r+b") as handle:
            handle.seek(match.start(1))
            handle.write(_digest(data, match).encode())


def _digest(data: bytes, match: re.Match[bytes]) -> str:
    """Return the SHA-256 of the whole file but for the digest itself, since OpenEXR alone overlooks altered bytes."""
    digest = hashlib.sha256(memoryview(data)[: match.start(1)])
    digest.update(memoryview(data)[match.end(1) :])
    return digest.hexdigest()


def to_half(images: np.ndarray) -> np.ndarray:
    """Round radiance to float16, saturating at the largest half instead of overflowing to infinity."""
    return np.minimum(images, HALF_LIMIT).astype(np.float16)


def read_shard(path: str | Path, scene: SceneSpec | None = None) -> Shard:
    """Read a shard and refuse anything damaged or different from its manifest line.

    Args:
        path: The EXR file.
        scene: The manifest line; when given, its id, lights and size are compared with the file.

    Raises:
        InputError: missing, truncated, altered or foreign file.
    """
    parts = _read_parts(path)
    header = parts[0].header
    if parts[0].name() != "gt" or header.get("ps:schema") != SCHEMA:
        raise InputError(f"{path}: not a shard of schema {SCHEMA} (first part {parts[0].name()!r}); render it again")
    mixture, lit = (parts[1], parts[2:]) if len(parts) > 1 and parts[1].name() == _MATERIALS else (None, parts[1:])
    if [part.name() for part in lit] != [f"L{index:03d}" for index in range(len(lit))]:
        raise InputError(f"{path}: light parts are missing or out of order; delete the file and render it again")
    truth = {name: channel.pixels for name, channel in parts[0].channels.items()}
    try:
        normals = truth["normal"] if "normal" in truth else np.stack([truth[f"normal.{c}"] for c in "XYZ"], axis=-1)
        shard = Shard(
            scene_id=str(header["ps:scene_id"]),
            images=np.stack([part.channels["RGB"].pixels for part in lit]),
            normals=normals,
            depth=truth["Z"],
            mask=truth["mask"] > 0.5,
            coverage=truth["coverage"],
            light_directions=np.stack([np.asarray(part.header["ps:light_dir"], np.float32) for part in lit]),
            weights=mixture and np.stack([mixture.channels[f"w{k}"].pixels for k in range(len(mixture.channels))]),
            materials=tuple(str(mixture.header["ps:materials"]).split("+")) if mixture else (),
            light_positions=(
                np.stack([np.asarray(part.header["ps:light_pos"], np.float32) for part in lit])
                if any("ps:light_pos" in part.header for part in lit)
                else None
            ),
            objects=truth.get("object"),
            provenance={
                key[3:]: value for key, value in header.items() if key.startswith("ps:") and key not in _OWN_ATTRIBUTES
            },
        )
    except (KeyError, ValueError) as error:
        raise InputError(f"{path}: incomplete shard ({error}); delete the file and render it again") from error
    if len(shard.images) != header.get("ps:light_count"):
        raise InputError(f"{path}: light parts are missing; delete the file and render it again")
    if scene is not None:
        _compare(path, shard, scene)
    return shard


def is_whole(path: str | Path, scene: SceneSpec) -> bool:
    """Return, without decoding a pixel, whether the shard is there, unaltered, and of this manifest line."""
    try:
        data = _read_sealed(path)
    except InputError:
        return False
    spec = _SPEC.search(data)
    return spec is not None and spec.group(1).decode() == scene.digest()


def is_sealed(data: bytes) -> bool:
    """Return whether the bytes are those of a whole, unaltered shard."""
    match = _DIGEST.search(data)
    return match is not None and _digest(data, match) == match.group(1).decode()


def _read_sealed(path: str | Path) -> bytes:
    """Read the file and check its digest.

    This comes before OpenEXR opens a file, because OpenEXR skips over what is damaged and reports it on stderr only.
    """
    data = read_bytes(path, "no such shard; run `sdps render-data` to finish the folder")
    if _DIGEST.search(data) is None:
        raise InputError(f"{path}: not a shard of schema {SCHEMA}, or truncated; delete the file and render it again")
    if not is_sealed(data):
        raise InputError(f"{path}: truncated or altered since it was written; delete the file and render it again")
    return data


def _read_parts(path: str | Path) -> list[OpenEXR.Part]:
    """Return the parts of a file whose digest is right."""
    _read_sealed(path)
    return exr_parts(path, "delete the file and render it again")


def _compare(path: str | Path, shard: Shard, scene: SceneSpec) -> None:
    """Refuse a shard whose id, number of lights, directions or size is not what the manifest says."""
    directions = scene.light_directions()
    if shard.scene_id != scene.id:
        raise InputError(f"{path}: holds scene {shard.scene_id!r}, the manifest says {scene.id!r}; render it again")
    if len(shard.images) != len(directions):
        raise InputError(f"{path}: {len(shard.images)} lights, the manifest says {len(directions)}; render it again")
    if not np.allclose(shard.light_directions, directions, atol=1e-5):
        raise InputError(f"{path}: light directions differ from the manifest; render it again")
    pair = (scene.light_positions(), shard.light_positions)
    planned, found = (np.zeros((0, 3)) if places is None else places for places in pair)
    if planned.shape != found.shape or not np.allclose(found, planned, rtol=1e-5, atol=1e-5):
        raise InputError(f"{path}: light positions differ from the manifest; render it again")
    if shard.images.shape[1:3] != scene.resolution:
        raise InputError(f"{path}: images are {shard.images.shape[1:3]}, the manifest says {scene.size}; render again")
    if shard.provenance.get("spec", scene.digest()) != scene.digest():
        raise InputError(
            f"{path}: rendered from another manifest line (shape, material, view, seed or samples differ); render again"
        )


def file_hash(path: str | Path) -> str:
    """Return the SHA-256 of a file as hex."""
    with open(path, "rb") as handle:
        return hashlib.file_digest(handle, "sha256").hexdigest()
