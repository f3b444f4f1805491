"""Tables of an object's reflectance: `sdps.refinement.reflectance` evaluates them, the page only interpolates.

Reflectance depends on n . l, n . v and l . v alone (n unit normal, l to the light, v to the camera, h half way between
them). With n . l and n . v held above the least cosine, and p the larger of them, the axes are

    slant    acosh(1 / p)                           from 0 to that of the least cosine
    balance  (n . l - n . v) / (p - least)          from -1 to 1
    azimuth  (l . v - n . l n . v) / (sin sin)      cosine of the azimuth between l and v
    tilt     sqrt(1 - n . h)                        from 0 to 1
    across   l . v                                  from 0 to 1

which makes reflectance smooth between entries: where it has edges (balance 0, azimuth 0), there are entries. Terms of G
in the tilt have a table of their own, so no term may mix it with the other angles.
"""

from typing import Any

import numpy as np

from sdps.refinement.reflectance import (
    LEAST_COSINE,
    MOST_LOG_FACTOR,
    Angles,
    combine_cosines,
    evaluate_body,
    evaluate_lobes,
    evaluate_log_factor,
)

MATTE = (33, 25, 64)
"""Entries along azimuth, balance and slant; odd where 0 lies in the middle."""
GLOSSY = (17, 512)
"""Entries along across and tilt."""

_NUMBERS = ("body", "modes", "amplitudes", "sharpness")


def build_tables(lobes: dict[str, Any]) -> tuple[dict[str, Any], bytes]:
    """Return what the page has to know of the tables, and the tables.

    Args:
        lobes: `amplitudes`, `sharpness`, `body` and `modes` of an object.

    Returns:
        The description, and little-endian float32 values: (*MATTE, 2) of log D and of log G at tilt 0, then
        (*GLOSSY, 2) of S of strength 1 and of what the tilt adds to log G.
    """
    body, modes, amplitudes, sharpness = (np.array(lobes[name]) for name in _NUMBERS)
    angles = _list_matte_angles()
    matte = np.log(evaluate_body(angles, body)), evaluate_log_factor(angles, modes)
    across, tilt = np.meshgrid(*(np.linspace(0, 1, size) for size in GLOSSY), indexing="ij")
    nothing = np.zeros_like(tilt)
    angles = Angles(nothing, nothing, nothing, tilt**2, across)
    glossy = evaluate_lobes(angles, np.ones(1), amplitudes, sharpness), evaluate_log_factor(angles, modes)
    about = {"least": LEAST_COSINE, "limit": MOST_LOG_FACTOR, "matte": list(MATTE), "glossy": list(GLOSSY)}
    return about, b"".join(np.stack(pair, axis=-1).astype("<f4").tobytes() for pair in (matte, glossy))


def _list_matte_angles() -> Angles:  # (*MATTE)
    """Return the angles of the entries of the first table, at tilt 0."""
    ranges = (-1, 1), (-1, 1), (0, np.arccosh(1 / LEAST_COSINE))
    axes = [np.linspace(*ends, size) for ends, size in zip(ranges, MATTE, strict=True)]
    azimuth, balance, slant = np.meshgrid(*axes, indexing="ij")
    more = 1 / np.cosh(slant)
    less = LEAST_COSINE + (more - LEAST_COSINE) * (1 - np.abs(balance))
    light, view = np.where(balance > 0, more, less), np.where(balance > 0, less, more)
    across = light * view + azimuth * np.sqrt(np.maximum((1 - light**2) * (1 - view**2), 0))
    return combine_cosines(light, view, across, np.zeros_like(slant))
