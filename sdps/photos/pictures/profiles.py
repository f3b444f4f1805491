"""What an embedded ICC profile says: the curve of its values and its primaries.

Reference: ICC.1:2022, 10.6 curveType, 10.18 parametricCurveType, 10.31 XYZType.
"""

import struct
from dataclasses import dataclass

import numpy as np

SRGB_EXPONENT = 2.224
"""log f(1/2) / log(1/2) of sRGB's decoding curve f, by which colour profiles with that curve are recognised."""
_NEAR_SRGB = 0.015

_PRIMARIES = {
    "": (0.436, 0.222, 0.014, 0.385, 0.717, 0.097, 0.143, 0.061, 0.714),  # sRGB
    "Display P3": (0.515, 0.241, -0.001, 0.292, 0.692, 0.042, 0.157, 0.067, 0.784),
    "Adobe RGB": (0.610, 0.311, 0.019, 0.205, 0.626, 0.061, 0.149, 0.063, 0.745),
    "ProPhoto RGB": (0.798, 0.288, 0.000, 0.135, 0.712, 0.000, 0.031, 0.000, 0.825),
    "Rec. 2020": (0.673, 0.279, -0.002, 0.166, 0.675, 0.030, 0.125, 0.046, 0.797),
}
"""XYZ of red, green and blue, adapted to D50, by the name of the colour space."""
_ALIKE = 0.01
_ROUGH = 0.01
"""Greatest difference of values from which on the curve that is taken off is not the profile's."""
_LEAST, _MOST = 0.3, 4.0
"""Exponents of curves in use."""
_FORMS = ("g", "gab", "gabc", "gabcd", "gabcdef")


@dataclass(frozen=True)
class Profile:
    """A colour profile.

    Attributes:
        exponent: log f(1/2) / log(1/2) of the red or grey curve f, 1 for linear; None where it tells none.
        primaries: Name of its colour space, empty for that of sRGB, `its own` for another.
        rough: Neither sRGB's curve nor the power with that exponent is within 1 % of full scale of f.
    """

    exponent: float | None = None
    primaries: str = ""
    rough: bool = False


def name_curve(exponent: float) -> str | float:
    """Return the curve of an exponent: linear, srgb or itself."""
    if abs(exponent - 1) < 0.05:
        return "linear"
    return "srgb" if abs(exponent - SRGB_EXPONENT) < _NEAR_SRGB else exponent


def read_profile(data: bytes | None) -> Profile:
    """Read a profile; one that is damaged, or has tables in place of curves, says nothing."""
    try:
        return _read(data or b"")
    except (struct.error, TypeError, ValueError, IndexError, KeyError):
        return Profile()


def _read(data: bytes) -> Profile:
    (count,) = struct.unpack_from(">I", data, 128)
    tags = {bytes(tag): offset for tag, offset, _ in struct.iter_unpack(">4sII", data[132 : 132 + 12 * count])}
    places = np.linspace(0, 1, 65)
    values = _sample(data, tags[b"rTRC"] if b"rTRC" in tags else tags[b"kTRC"], places)
    if values is None:
        return Profile()
    half = float(values[32])
    exponent = round(float(np.log(half) / np.log(0.5)), 12)  # what a profile says as a number stays that number
    if not _LEAST <= exponent <= _MOST:  # damaged, or not finite
        return Profile()
    found = name_curve(exponent)
    srgb = np.where(places <= 0.04045, places / 12.92, ((places + 0.055) / 1.055) ** 2.4)
    taken = {"linear": places, "srgb": srgb}.get(str(found), places**exponent)
    return Profile(exponent, _name_primaries(data, tags), bool(np.abs(values - taken).max() > _ROUGH))


def _sample(data: bytes, offset: int, places: np.ndarray) -> np.ndarray | None:
    """Return a curve's values, None for a kind that is not known."""
    kind, _, number = struct.unpack_from(">4sII", data, offset)
    if kind == b"curv" and number == 0:
        return places
    if kind == b"curv" and number == 1:
        return np.asarray(places ** (struct.unpack_from(">H", data, offset + 12)[0] / 256))
    if kind == b"curv":
        table = np.frombuffer(data, ">u2", number, offset + 12) / 65535
        return np.interp(places, np.linspace(0, 1, number), table)
    if kind != b"para":
        return None
    names = _FORMS[number >> 16]
    p = dict(zip(names, (np.frombuffer(data, ">i4", len(names), offset + 12) / 65536).tolist(), strict=True))
    base = np.maximum(p.get("a", 1.0) * places + p.get("b", 0.0), 0.0)
    shift = p.get("e", 0.0) if "e" in p else (p.get("c", 0.0) if len(p) == 4 else 0.0)
    power = base ** p["g"] + shift
    if "d" not in p:
        return np.asarray(power)
    return np.where(places >= p["d"], power, p["c"] * places + p.get("f", 0.0))


def _name_primaries(data: bytes, tags: dict[bytes, int]) -> str:
    names = (b"rXYZ", b"gXYZ", b"bXYZ")
    if not all(name in tags for name in names):
        return ""
    found = [value / 65536 for name in names for value in struct.unpack_from(">3i", data, tags[name] + 8)]
    return next(
        (name for name, known in _PRIMARIES.items() if np.abs(np.subtract(found, known)).max() < _ALIKE), "its own"
    )
