"""RGL material files (`.bsdf`): the container, what a usable file must hold, and writing one from any isotropic BRDF.

The files are those of Dupuy and Jakob, *An Adaptive Parameterization for Efficient Material Acquisition and Rendering*
(TOG 2018), and of https://rgl.epfl.ch/materials; Mitsuba's stock `measured` plugin renders them. For a pair of
directions with half vector m, it takes u = (sqrt(2 theta_m / pi), (phi_m - phi_i + pi) / 2 pi) through the distribution
function of the table `vndf` and reads f cos(theta_o) from the table `rgb` there, linear in theta_i between slices.
"""

import math
import struct
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from render.materials import model
from render.shared.decoding import decoding
from render.shared.errors import InputError
from render.shared.files import atomic_path, read_bytes

_MAGIC = b"tensor_file\0"
_VERSION = (1, 0)
_TYPES = dict(enumerate(map(np.dtype, ("u1", "i1", "<u2", "<i2", "<u4", "<i4", "<u8", "<i8", "<f2", "<f4", "<f8")), 1))
_ALIGNMENT = 8
_DIMENSIONS = {"theta_i": 1, "phi_i": 1, "ndf": 2, "sigma": 2, "vndf": 4, "luminance": 4, "rgb": 5}
_BYTES = {"description": None, "jacobian": 1}
_REMEDY = "download the *_rgb.bsdf file of an isotropic material again"

SLICES = 31  # incident angles of a written file: every three degrees
SIDE = 94  # three table rows per cell of the analytic model's 32 knots in theta_h
_STEEPEST = math.radians(89.9)
_WARP_KNOTS = 257


@dataclass(frozen=True)
class RglMaterial:
    """A checked, isotropic RGB `.bsdf` file.

    Attributes:
        name: File name without `_rgb.bsdf`.
        category: `measured`.
        path: The file.
        description: The file's own text about the material.
    """

    name: str
    category: str
    path: Path
    description: str = ""


def load(path: str | Path) -> RglMaterial:
    """Check that Mitsuba's `measured` can render a file in an RGB variant, and on surfaces without tangents.

    Args:
        path: A `.bsdf` file.

    Raises:
        InputError: not a tensor file, cut short, spectral, anisotropic, or a field that is missing, misshapen or not
            finite; one line naming file, field and remedy.
    """
    path = Path(path)
    fields = read_fields(path)
    if "wavelengths" in fields or ("spectra" in fields and "rgb" not in fields):
        raise InputError(f"{path}: spectra: a spectral measurement; use the *_rgb.bsdf file of the same material")
    for name, rank in _DIMENSIONS.items():
        table = _field(fields, path, name)
        if table.dtype != np.float32 or table.ndim != rank:
            raise InputError(
                f"{path}: {name}: expected {rank} dimensions of float32, got {table.dtype}{table.shape}; {_REMEDY}"
            )
        if not np.isfinite(table).all():
            raise InputError(f"{path}: {name}: holds values that are not finite; {_REMEDY}")
    for name, size in _BYTES.items():
        table = _field(fields, path, name)
        if table.dtype != np.uint8 or table.ndim != 1 or size not in (None, table.size):
            raise InputError(f"{path}: {name}: expected bytes, got {table.dtype}{table.shape}; {_REMEDY}")
    _check_shapes(fields, path)
    name = path.name.removesuffix(".bsdf").removesuffix("_rgb")
    description = fields["description"].tobytes().decode("utf-8", "replace").strip("\0\n ")
    return RglMaterial(name=name, category="measured", path=path, description=description)


def _field(fields: Mapping[str, np.ndarray], path: Path, name: str) -> np.ndarray:
    if name not in fields:
        raise InputError(f"{path}: {name}: no such field in the file; {_REMEDY}")
    return fields[name]


def _check_shapes(fields: Mapping[str, np.ndarray], path: Path) -> None:
    """Compare the tables' shapes with each other, as `measured` does, and refuse anisotropic files."""
    theta, phi, side = fields["theta_i"], fields["phi_i"], fields["rgb"].shape[-1]
    slices = (len(phi), len(theta))
    expected = {"vndf": (*slices, *fields["vndf"].shape[2:]), "luminance": (*slices, side, side)}
    expected["rgb"] = (*slices, 3, side, side)
    for name, shape in expected.items():
        if fields[name].shape != shape or min(shape[-2:]) < 2:
            raise InputError(f"{path}: {name}: expected the shape {shape}, got {fields[name].shape}; {_REMEDY}")
    for name in ("ndf", "sigma"):
        if min(fields[name].shape) < 2:
            raise InputError(f"{path}: {name}: expected at least 2x2 values, got {fields[name].shape}; {_REMEDY}")
    if not len(theta) or theta[0] < 0 or theta[-1] > 1.58 or (np.diff(theta) <= 0).any():
        raise InputError(f"{path}: theta_i: expected rising angles from 0 to pi / 2; {_REMEDY}")
    if not 0 < len(phi) <= 2:
        raise InputError(
            f"{path}: phi_i: an anisotropic material ({len(phi)} azimuths), but surfaces here have no tangents; "
            "use an isotropic one"
        )


def read_fields(path: str | Path) -> dict[str, np.ndarray]:
    """Read every field of a tensor file, in the order of the file.

    Args:
        path: A tensor file: magic, version, number of fields; per field its name, rank, type, offset and shape; data.

    Raises:
        InputError: missing, unreadable, another kind of file, or cut short.
    """
    data = read_bytes(path)
    if data[: len(_MAGIC)] != _MAGIC:
        raise InputError(f"{path}: not an RGL material (it does not begin with 'tensor_file'); {_REMEDY}")
    with decoding(path, "an RGL material: its table of fields is wrong or cut short", _REMEDY):
        return _parse(data)


def _parse(data: bytes) -> dict[str, np.ndarray]:
    """Read version, table of fields and arrays; struct.error, KeyError or ValueError where the bytes make no sense."""
    position = len(_MAGIC)

    def take(form: str) -> tuple[Any, ...]:
        nonlocal position
        values = struct.unpack_from(form, data, position)
        position += struct.calcsize(form)
        return values

    major, minor, count = take("<BBI")
    if (major, minor) != _VERSION:
        raise ValueError(f"version {major}.{minor} is not 1.0")
    fields = {}
    for _ in range(count):
        (length,) = take("<H")
        name = take(f"<{length}s")[0].decode()
        rank, kind, offset = take("<HBQ")
        shape = take(f"<{rank}Q")
        size = math.prod(shape)
        if offset + size * _TYPES[kind].itemsize > len(data):
            raise ValueError(f"{name} lies beyond the end of the file")
        fields[name] = np.frombuffer(data, _TYPES[kind], size, offset).reshape(shape)
    return fields


def write_fields(path: str | Path, fields: Mapping[str, np.ndarray]) -> None:
    """Write a tensor file, atomically.

    Args:
        path: File to write.
        fields: Arrays of any integer or floating-point type, by name.

    Raises:
        InputError: the file cannot be written.
    """
    kinds = {dtype: number for number, dtype in _TYPES.items()}
    arrays = {name: np.ascontiguousarray(array).reshape(np.shape(array)) for name, array in fields.items()}
    head = len(_MAGIC) + 6 + sum(13 + len(name.encode()) + 8 * array.ndim for name, array in arrays.items())
    table, offset = [], _align(head)
    for name, array in arrays.items():
        text = name.encode()
        kind = kinds[array.dtype.newbyteorder("<")]
        table.append(
            struct.pack(f"<H{len(text)}sHBQ{array.ndim}Q", len(text), text, array.ndim, kind, offset, *array.shape)
        )
        offset = _align(offset + array.nbytes)
    with atomic_path(path) as temporary, open(temporary, "wb") as file:
        file.write(_MAGIC + struct.pack("<BBI", *_VERSION, len(arrays)) + b"".join(table))
        for array in arrays.values():
            file.write(bytes(_align(file.tell()) - file.tell()))
            file.write(array.astype(array.dtype.newbyteorder("<")).tobytes())


def _align(offset: int) -> int:
    return -(-offset // _ALIGNMENT) * _ALIGNMENT


def write(
    path: str | Path,
    brdf: Callable[[np.ndarray, np.ndarray], np.ndarray],
    *,
    description: str = "",
    slices: int = SLICES,
    side: int = SIDE,
) -> RglMaterial:
    """Tabulate an isotropic BRDF as a `.bsdf` file that Mitsuba's stock `measured` plugin renders.

    The published files warp each slice by the visible normals of its incident angle. Here one warp serves all slices:
    half vectors, in the coordinate of `render.materials.model.half_coordinate`, uniform in azimuth. So the plugin
    interpolates between incident angles at a fixed half vector, where a peak stays in place however narrow it is, and
    between the knots of the analytic model it interpolates what is linear there. `rgb` holds f cos(theta_o) itself
    (`jacobian` 0, `ndf` and `sigma` one), and `luminance` its density in the warped square, so that the plugin's
    sampling follows the reflected light.

    Args:
        path: File to write, ending in `.bsdf`.
        brdf: Maps unit vectors to the camera and to the light, each (N, 3) in the shading frame (z is the normal), to
            (N, 3) linear RGB in 1/sr without the cosine.
        description: Text kept in the file.
        slices: Number of incident angles.
        side: Rows and columns of a slice; the file has about 16 slices side^2 bytes.

    Raises:
        InputError: a BRDF that returns values that are not finite or are negative, or a file that cannot be written.
    """
    theta = np.linspace(0, _STEEPEST, slices)
    density, one = _warp_density(np.linspace(0, 1, _WARP_KNOTS)), np.ones((2, 2), np.float32)
    rgb, luminance = (np.stack(part) for part in zip(*(_slice(brdf, angle, side) for angle in theta), strict=True))
    if not np.isfinite(rgb).all() or (rgb < 0).any():
        raise InputError(f"{path}: rgb: the BRDF has values that are negative or not finite; repair its table")
    # Nowhere zero, or light just above the horizon between two dark entries would never be sampled.
    luminance += 1e-4 * luminance.mean((1, 2), keepdims=True) + 1e-12
    fields: dict[str, np.ndarray] = {
        "description": np.frombuffer(description.encode() or b"written by sdps", np.uint8),
        "jacobian": np.zeros(1, np.uint8),
        "phi_i": np.zeros(1, np.float32),
        "theta_i": theta.astype(np.float32),
        "ndf": one,
        "sigma": one,
        "vndf": np.broadcast_to(density, (1, slices, 2, len(density))).astype(np.float32),
        "luminance": luminance[None].astype(np.float32),
        "rgb": rgb[None].astype(np.float32),
    }
    write_fields(path, fields)
    return load(path)


def _slice(
    brdf: Callable[[np.ndarray, np.ndarray], np.ndarray], theta: float, side: int
) -> tuple[np.ndarray, np.ndarray]:
    """Tabulate one incident angle.

    Returns:
        f cos(theta_o), (3, side, side), and the density of its luminance in the warped square, (side, side); rows are
        azimuths of the half vector about that of the incident direction, from -pi to pi, columns are angles from 0.
    """
    u = _unwarp(np.linspace(0, 1, side))
    angle, phi = np.pi / 2 * u**2, np.linspace(-np.pi, np.pi, side)
    half = np.stack(np.broadcast_arrays(*_polar(angle, phi[:, None])), -1).reshape(-1, 3)
    wi = np.array([np.sin(theta), 0, np.cos(theta)])
    projection = half @ wi
    wo = 2 * projection[:, None] * half - wi
    cosine = np.maximum(wo[:, 2], 0)
    above = cosine > 1e-6
    value = np.zeros((len(wo), 3))
    value[above] = brdf(np.broadcast_to(wi, (above.sum(), 3)), wo[above]) * cosine[above, None]
    # Solid angle of wo per area of the square; see `measured`, whose density this inverts.
    measure = 4 * np.maximum(projection, 0) * np.tile(2 * np.pi**2 * u * np.sin(angle) / _warp_density(u), side)
    return value.T.reshape(3, side, side), (value @ model.LUMINANCE * measure).reshape(side, side)


def _polar(theta: np.ndarray, phi: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    return np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)


def _unwarp(x: np.ndarray) -> np.ndarray:
    """Return u = sqrt(2 theta_h / pi) at the half coordinate x, both in [0, 1]."""
    return np.sqrt(4 / np.pi * np.arcsin((x / (2 - x)) ** 2 / math.sqrt(2)))


def _warp_density(u: np.ndarray) -> np.ndarray:
    """Return dx / du of the half coordinate x(u): x = 2 r / (1 + r), r = sqrt(sqrt(2) sin(pi u^2 / 4))."""
    small = np.maximum(u, 1e-6)
    sine, cosine = np.sin(np.pi / 4 * small**2), np.cos(np.pi / 4 * small**2)
    root = np.sqrt(math.sqrt(2) * sine)
    return 2 / (1 + root) ** 2 * math.sqrt(2) * cosine * np.pi / 4 * small / root
