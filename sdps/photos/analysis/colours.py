"""Was a photograph taken in light of another colour? Told apart from gloss, which changes colours as well.

Legend: L images, P sampled pixels of the object.
"""

import numpy as np

CAST = 0.11
"""Least change of a channel's share that is believed, as a logarithm."""

STEADY = 2.0
"""Least ratio of a change to its spread over the pixels, the distance of their quartiles."""

STEADY_TO_WHITE = 5.0
"""The same of a change from the paint's colour towards white, as gloss brings about."""

CAST_BESIDE_WHITE, STEADY_BESIDE_WHITE = 0.09, 0.5
"""The same of the part of a change that a white gloss cannot bring about."""

_FEW = 20
_BRIGHT = 0.3  # of the image's bright parts' level
_DARKEST = 0.02  # of full scale; below, noise and the files' steps colour a pixel
_COLOURED = 0.15  # length of the paint's colour, as logarithms, from which on a highlight's white is another colour


def colour_casts(observations: np.ndarray, saturation: float) -> np.ndarray:  # (L,)
    """Measure how far every image's light differs in colour from the others'.

    Each pixel is compared with itself in the other images, so that paint does not matter. A lamp of another colour
    changes all pixels alike; gloss, white on coloured plastic, changes those it falls on. So a change counts where it
    is large against its spread over the pixels. Gloss moves a pixel's colour along the line from its paint to white,
    and no further: changes within that line must be very steady, and what is left next to it needs less.

    Args:
        observations: (L, P, 3) float32, linear, not negative.
        saturation: Value from which on a channel is not to be trusted.

    Returns:
        Largest change of a channel's share, 0.2 for 20 %; 0 where none is believed.
    """
    grey = observations.mean(-1)
    level = np.percentile(grey, 95, axis=1, keepdims=True)
    floor = _DARKEST * min(1.0, float(np.median(level))) if np.isinf(saturation) else _DARKEST
    good = (grey > np.maximum(_BRIGHT * level, floor)) & (observations < saturation).all(-1)
    colours = np.log(np.maximum(observations, 1e-6 * max(floor, 1e-6)))
    colours -= colours.mean(-1, keepdims=True)
    paint = _middle(colours, good)  # (P, 3)
    good &= good.sum(0) >= 3
    length = np.linalg.norm(paint, axis=-1, keepdims=True)
    white = paint / np.maximum(length, 1e-6) * np.sqrt(np.minimum(length / _COLOURED, 1))
    found = np.zeros(len(observations))
    gloss = np.zeros(len(observations), bool)
    changes = np.full((2, 2, len(observations), 3), np.nan)  # whole or without white; median or spread
    for number, chosen in enumerate(good):
        if chosen.sum() < _FEW:
            continue
        change = (colours[number] - paint)[chosen]
        rest = change - white[chosen] * (change * white[chosen]).sum(-1, keepdims=True)
        for row, values in zip(changes, (change, rest), strict=True):
            low, row[0, number], high = np.percentile(values, (25, 50, 75), axis=0)
            row[1, number] = high - low
        own, middle = np.median(paint[chosen], axis=0), changes[0, 0, number]
        gloss[number] = own @ middle < 0 and np.linalg.norm(middle) < np.linalg.norm(own)
    known = np.isfinite(changes).all((0, 1, 3))
    if known.sum() < 2:
        return found
    changes[:, 0] -= np.median(changes[:, 0, known], axis=1)[:, None]
    changes[0, 1, gloss] *= STEADY_TO_WHITE / STEADY
    limits = ((CAST, STEADY), (CAST_BESIDE_WHITE, STEADY_BESIDE_WHITE))
    for (middle, width), (least, steady) in zip(changes, limits, strict=True):
        cast = known & (np.abs(middle) > np.maximum(least, steady * width)).any(1)
        found[cast] = np.maximum(found[cast], np.abs(np.expm1(middle[cast])).max(1))
    return found


def _middle(colours: np.ndarray, good: np.ndarray) -> np.ndarray:  # (P, 3)
    """Return the median of (L, P, 3) over the images that are good, 0 where none is."""
    ordered = np.sort(np.where(good[..., None], colours, np.inf), axis=0)
    middle = np.maximum(good.sum(0) - 1, 0) // 2
    median = np.take_along_axis(ordered, middle[None, :, None], axis=0)[0]
    return np.where(np.isfinite(median), median, 0.0)
