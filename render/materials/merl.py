"""Tables of the MERL BRDF database (Matusik et al. 2003): the `.binary` format, and their plain numpy evaluation.

A file is three int32 (90, 90, 180), then a plane of 90 x 90 x 180 float64 for each of red, green and blue, all little
endian, with an entry at `phi_d + 180 (theta_d + 90 theta_h)` in the half and difference angles of Rusinkiewicz (1998):

    theta_h: cell floor(90 sqrt(theta_h / 90 deg)), finest about the mirror direction
    theta_d: cell floor(90 theta_d / 90 deg)
    phi_d:   cell floor(180 phi_d / 180 deg), half a turn, since exchanging the directions adds 180 deg

The reader of the database looks entries up by this truncation, so an entry stands for its whole cell, and here for the
cell's centre: what `evaluate` interpolates equals the looked-up entry there. phi_d is periodic. It is undefined where
theta_h or theta_d is zero, where a BRDF cannot depend on it: there the value is the mean over phi_d of the first cells.
`render.materials.kernels.merl_bsdf` evaluates the same knots in a kernel.
"""

import os
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from render.shared.errors import InputError
from render.shared.files import atomic_path

SHAPE = (90, 90, 180)  # cells of theta_h, theta_d, phi_d
SCALES = np.array([1.0, 1.15, 1.66]) / 1500  # of the red, green and blue plane, into 1/sr
SUFFIX = ".binary"
_HEADER = np.array(SHAPE, "<i4")
_BYTES = _HEADER.nbytes + 3 * int(np.prod(SHAPE)) * 8
_PLANES = ("red", "green", "blue")


@dataclass(frozen=True, kw_only=True, eq=False)
class MerlTable:
    """A measured isotropic BRDF in linear RGB; arrays are read-only.

    Attributes:
        name: The file's name without its suffix.
        path: The file, empty for a table that was never in one.
        values: (3, 90, 90, 180) float32 BRDF in 1/sr at the centres of the cells of (theta_h, theta_d, phi_d), >= 0.
        valid: (90, 90, 180) bool, entries that were measured; the values of the others are filled in, see `build`.
        category: Always `measured`.

    Raises:
        InputError: an array of the wrong shape, or a value that is negative or not finite.
    """

    name: str
    values: np.ndarray
    valid: np.ndarray
    path: str = ""
    category: str = "measured"

    def __post_init__(self) -> None:
        values = _check(self.values, self.name, np.float32)
        if values.min() < 0:
            raise InputError(f"{self.name}: values must be >= 0, got {values.min():g}; see merl.build")
        if self.valid.shape != SHAPE:
            raise InputError(f"{self.name}: valid must have the shape {SHAPE}, got {self.valid.shape}")
        for field, array in (("values", values), ("valid", np.asarray(self.valid, bool))):
            array = array.view()
            array.flags.writeable = False
            object.__setattr__(self, field, array)


def read(path: str | Path) -> MerlTable:
    """Read a MERL table.

    Raises:
        InputError: no such file, another header or size, a value that is not finite, or not one valid entry.
    """
    path = Path(path)
    try:
        with open(path, "rb") as handle:
            header, size = np.fromfile(handle, "<i4", 3), os.fstat(handle.fileno()).st_size
            if not np.array_equal(header, _HEADER):
                found = ", ".join(map(str, header)) or "nothing"
                raise InputError(f"{path}: header: expected the sizes 90, 90, 180, found {found}; not a MERL table")
            if size != _BYTES:
                raise InputError(f"{path}: size: expected {_BYTES:,} bytes, found {size:,}; fetch the file again")
            raw = np.fromfile(handle, "<f8").reshape(3, *SHAPE)
    except FileNotFoundError as error:
        raise InputError(f"{path}: no such file") from error
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error})") from error
    return build(raw * SCALES[:, None, None, None], path.stem, str(path))


def build(values: np.ndarray, name: str, path: str = "") -> MerlTable:
    """Make a table of values in which a negative entry means that nothing was measured there.

    MERL marks so what lies below the horizon and part of what is near grazing. An entry that is negative in any channel
    takes the colour of the nearest valid one of smaller theta_h at the same theta_d and phi_d, and where there is none,
    of the nearest along theta_h, then theta_d, then phi_d. With zeros instead, interpolation would draw a dark rim.

    Args:
        values: (3, 90, 90, 180) BRDF in 1/sr.
        name: Name of the table.
        path: Its file, for messages.

    Raises:
        InputError: wrong shape, a value that is not finite, or no valid entry.
    """
    values = _check(values, path or name, np.float32)
    valid = np.all(values >= 0, axis=0)
    if not valid.any():
        raise InputError(f"{path or name}: every entry is negative, which means not measured; fetch the file again")
    return MerlTable(name=name, values=_fill(values, valid), valid=valid, path=path)


def write(path: str | Path, values: np.ndarray) -> None:
    """Write a table in the exact format of the database.

    Args:
        path: The file; its suffix should be `.binary`.
        values: (3, 90, 90, 180) BRDF in 1/sr at the centres of the cells; negative where nothing was measured.

    Raises:
        InputError: wrong shape, a value that is not finite, or a file that cannot be written.
    """
    values = _check(values, str(path), np.float64)
    with atomic_path(path) as temporary, open(temporary, "wb") as handle:
        handle.write(_HEADER.tobytes())
        for plane, scale in zip(values, SCALES, strict=True):
            handle.write((plane / scale).astype("<f8").tobytes())


def tabulate(brdf: Callable[[np.ndarray, np.ndarray], np.ndarray]) -> np.ndarray:
    """Sample a BRDF at the centres of the cells, in the form that `write` takes.

    Args:
        brdf: Function of (N, 3) `wi`, `wo` giving the (N, 3) BRDF in 1/sr.

    Returns:
        (3, 90, 90, 180) float32, -1 where either direction is below the horizon.
    """
    values = np.full((3, *SHAPE), -1, np.float32)
    for row in range(SHAPE[0]):
        wi, wo = centres(row)
        above = (wi[:, 2] > 0) & (wo[:, 2] > 0)
        values[:, row].reshape(3, -1)[:, above] = brdf(wi[above], wo[above]).T
    return values


def centres(row: int) -> tuple[np.ndarray, np.ndarray]:
    """Return `wi` and `wo`, each (90 * 180, 3), at the centres of the cells of one row of theta_h."""
    theta_h, theta_d, phi_d = ((np.arange(count) + 0.5) / count for count in SHAPE)
    wi, wo = directions(np.pi / 2 * theta_h[row] ** 2, np.pi / 2 * theta_d[:, None], np.pi * phi_d)
    return wi.reshape(-1, 3), wo.reshape(-1, 3)


def directions(theta_h: np.ndarray, theta_d: np.ndarray, phi_d: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return `wi` and `wo`, each (..., 3), of half and difference angles in radians that broadcast; phi_h is 0."""
    x, y, z = np.sin(theta_d) * np.cos(phi_d), np.sin(theta_d) * np.sin(phi_d), np.cos(theta_d)
    sine, cosine = np.sin(theta_h), np.cos(theta_h)
    pair = [(cosine * a + sine * z, b, cosine * z - sine * a) for a, b in ((x, y), (-x, -y))]
    wi, wo = (np.stack(np.broadcast_arrays(*vector), -1) for vector in pair)
    return wi, wo


def knots(values: np.ndarray) -> np.ndarray:
    """Add the knots at theta_h = 0 and theta_d = 0, means over phi_d of the first cells.

    Args:
        values: (..., 90, 90, 180).

    Returns:
        (..., 91, 91, 180), of which knots 1 to 90 of either angle are the centres of the cells.
    """
    padded = np.concatenate([values[..., :1, :, :], values], -3)
    padded[..., 0, :, :] = values[..., 0, :, :].mean(-1, keepdims=True)
    return np.concatenate([padded[..., :1, :].mean(-1, keepdims=True).repeat(SHAPE[2], -1), padded], -2)


def evaluate(table: MerlTable, wi: np.ndarray, wo: np.ndarray) -> np.ndarray:
    """Evaluate the BRDF by trilinear interpolation in (sqrt(theta_h), theta_d, phi_d); reciprocal to the last bit.

    Args:
        table: The table.
        wi: (N, 3) unit vectors from the surface to the light, in the shading frame (z is the normal).
        wo: (N, 3) unit vectors to the camera.

    Returns:
        (N, 3) float64 linear RGB in 1/sr, without the cosine; zero where either vector is below the horizon.
    """
    wi, wo = np.asarray(wi, np.float64), np.asarray(wo, np.float64)
    at_knots = knots(table.values)
    value = sum(
        (weight * at_knots[:, row, column, cell] for row, column, cell, weight in _corners(wi, wo)), np.zeros(())
    )
    return np.where(((wi[:, 2] > 0) & (wo[:, 2] > 0))[:, None], value.T, 0.0)


def is_measured(table: MerlTable, wi: np.ndarray, wo: np.ndarray) -> np.ndarray:
    """Return for (N, 3) `wi` and `wo` whether `evaluate` there rests on measured entries alone; (N,) bool."""
    wi, wo = np.asarray(wi, np.float64), np.asarray(wo, np.float64)
    holes = knots((~table.valid).astype(np.float32)) > 0
    touched = sum(
        ((weight > 0) & holes[row, column, cell] for row, column, cell, weight in _corners(wi, wo)), np.zeros(())
    )
    return (wi[:, 2] > 0) & (wo[:, 2] > 0) & (touched == 0)


def as_brdf(table: MerlTable) -> Callable[[np.ndarray, np.ndarray], np.ndarray]:
    """Return a function of (N, 3) `wi`, `wo` giving the (N, 3) BRDF, NaN where it was not measured, for fitting."""

    def brdf(wi: np.ndarray, wo: np.ndarray) -> np.ndarray:
        return np.where(is_measured(table, wi, wo)[:, None], evaluate(table, wi, wo), np.nan)

    return brdf


def bivariate(table: MerlTable, theta_h: np.ndarray, theta_d: np.ndarray) -> np.ndarray:
    """Return the (3, A, B) mean over phi_d at (A,) theta_h and (B,) theta_d in radians (Romeiro et al. 2008)."""
    mean = knots(table.values.mean(-1, keepdims=True).repeat(SHAPE[2], -1))[..., 0]  # (3, 91, 91)
    row, a = _cell(np.sqrt(theta_h * (2 / np.pi)), SHAPE[0])
    column, b = _cell(theta_d * (2 / np.pi), SHAPE[1])
    rows = (1 - a)[:, None] * mean[:, row] + a[:, None] * mean[:, row + 1]
    return (1 - b) * rows[:, :, column] + b * rows[:, :, column + 1]


def _corners(wi: np.ndarray, wo: np.ndarray) -> Iterator[tuple[np.ndarray, ...]]:
    """Yield the knot (row, column, cell of phi_d) and the weight, (N,) each, of the eight about each pair.

    No difference vector is formed: with s = wi + wo, tan(theta_d) = |wi - wo| / |s|, and the components of the
    difference vector that give phi_d are proportional to |s| (wo.z - wi.z) and -2 (wi x wo).z.
    """
    total = wi + wo
    length = np.linalg.norm(total, axis=1)
    theta_h = np.arctan2(np.hypot(total[:, 0], total[:, 1]), total[:, 2])
    theta_d = np.arctan2(np.linalg.norm(wi - wo, axis=1), length)
    x, y = length * (wo[:, 2] - wi[:, 2]), 2 * (wi[:, 1] * wo[:, 0] - wi[:, 0] * wo[:, 1])
    phi_d = np.arctan2(np.abs(y), np.where(y < 0, -x, x))  # [0, pi]: exchanging the directions negates both
    row, a = _cell(np.sqrt(theta_h * (2 / np.pi)), SHAPE[0])
    column, b = _cell(theta_d * (2 / np.pi), SHAPE[1])
    position = phi_d * (SHAPE[2] / np.pi) - 0.5
    position = np.where(position < 0, position + SHAPE[2], position)
    cell = np.minimum(position.astype(int), SHAPE[2] - 1)
    c = position - cell
    for i, weight_h in ((0, 1 - a), (1, a)):
        for j, weight_d in ((0, 1 - b), (1, b)):
            for k, weight_p in ((0, 1 - c), (1, c)):
                yield row + i, column + j, (cell + k) % SHAPE[2], weight_h * weight_d * weight_p


def _cell(coordinate: np.ndarray, cells: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the first of the two knots about `coordinate` in [0, 1], and the weight of the second.

    Knot 0 is at the start of the first cell, the others at the centres of the cells, so the first step is half as long.
    """
    position = coordinate * cells - 0.5
    position = np.clip(np.minimum(2 * position + 1, position + 1), 0, cells)
    index = np.minimum(position.astype(int), cells - 1)
    return index, position - index


def _fill(values: np.ndarray, valid: np.ndarray) -> np.ndarray:
    """Fill the invalid entries from the nearest valid ones along each axis in turn, from smaller angles first."""
    for axis in range(3):
        if valid.all():
            break
        number = np.arange(SHAPE[axis]).reshape([-1 if k == axis else 1 for k in range(3)])
        for _ in range(2):  # the second time from larger angles
            last = np.maximum.accumulate(np.where(valid, number, 0), axis=axis)
            values = np.stack([np.take_along_axis(plane, last, axis) for plane in values])
            valid = np.logical_or.accumulate(valid, axis=axis)
            values, valid = np.flip(values, axis + 1), np.flip(valid, axis)
    return values


def _check(values: np.ndarray, where: str, dtype: type) -> np.ndarray:
    """Convert to a new array of `dtype`, or raise an InputError naming the first entry that is not a number."""
    values = np.asarray(values)
    if values.shape != (3, *SHAPE):
        raise InputError(f"{where}: values must have the shape {(3, *SHAPE)}, got {values.shape}")
    with np.errstate(over="ignore"):
        converted: np.ndarray = np.array(values, dtype, order="C")
    finite = np.isfinite(converted)
    if not finite.all():
        plane, *entry = (int(k) for k in np.argwhere(~finite)[0])
        raise InputError(
            f"{where}: {_PLANES[plane]} plane, entry (theta_h, theta_d, phi_d) = {tuple(entry)}: "
            f"{values[plane, *entry]} is not a finite number ({(~finite).sum():,} such); fetch the file again"
        )
    return converted
