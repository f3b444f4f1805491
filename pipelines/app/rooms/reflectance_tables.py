"""Tables of an object's reflectance: `sdps.refinement.reflectance` evaluates them, the page only interpolates.

Seen from (0, 0, 1), reflectance depends on n . l, n . v and l . v alone. With p and q the larger and the smaller of n . l
and n . v, both held above the least cosine, places along the axes are

    slant    acosh(1 / p)                                                               from 0 to that of the least cosine
    balance  (n . l - n . v) / (p - least)                                              from -1 to 1
    azimuth  (l . v - n . l n . v) / (sin sin)                                          cosine of that between l and v
    tilt     sqrt(1 - n . h)
    across   l . v

so that reflectance is smooth between entries: where it has edges (l as steep as v, l opposite to v) there are entries.
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
"""Entries over azimuth, balance and slant."""
GLOSSY = (17, 512)
"""Entries over across, from 0 to 1, and tilt, from 0 to 1."""


def build_tables(lobes: dict[str, Any]) -> tuple[dict[str, Any], bytes]:
    """Return what the page has to know of the tables, and the tables.

    Args:
        lobes: `amplitudes`, `sharpness`, `body` and `modes` of an object.

    Returns:
        The description, and little-endian float32 values: (*MATTE, 2) of log D and of log G at tilt 0, then
        (*GLOSSY, 2) of S of strength 1 and of what the tilt adds to log G.
    """
    body, modes, amplitudes, sharpness = (np.array(lobes[name]) for name in ("body", "modes", "amplitudes", "sharpness"))
    around = _matte_angles()
    matte = np.stack([evaluate_body(around, body), evaluate_log_factor(around, modes)], axis=-1)
    tilts, across = (part.reshape(1, -1) for part in np.meshgrid(*(np.linspace(0, 1, size) for size in GLOSSY[::-1])))
    nothing = np.zeros_like(tilts)
    above = Angles(nothing, nothing, nothing, tilts**2, across)
    lobes_of_one = evaluate_lobes(above, np.ones(1), amplitudes, sharpness)
    glossy = np.stack([lobes_of_one, evaluate_log_factor(above, modes)], axis=-1)
    matte[..., 0] = np.log(matte[..., 0])
    about = {"least": LEAST_COSINE, "limit": MOST_LOG_FACTOR, "matte": list(MATTE), "glossy": list(GLOSSY)}
    return about, b"".join(part.astype("<f4").tobytes() for part in (matte, glossy))


def _matte_angles() -> Angles:
    """Return the angles of the entries of the first table, at tilt 0; (1, entries)."""
    azimuth, balance, slant = (
        axis.reshape(1, -1)
        for axis in np.meshgrid(
            np.linspace(-1, 1, MATTE[0]), np.linspace(-1, 1, MATTE[1]),
            np.linspace(0, np.arccosh(1 / LEAST_COSINE), MATTE[2]), indexing="ij",
        )
    )  # fmt: skip
    more = 1 / np.cosh(slant)
    less = LEAST_COSINE + (more - LEAST_COSINE) * (1 - np.abs(balance))
    light, view = np.where(balance > 0, more, less), np.where(balance > 0, less, more)
    across = light * view + azimuth * np.sqrt(np.maximum((1 - light**2) * (1 - view**2), 0))
    return combine_cosines(light, view, across, np.zeros_like(slant))
