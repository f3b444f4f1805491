"""Sample points of the renderer: low-discrepancy in each pixel, random between pixels, the same for every run.

All functions take lanes and return lanes; seeds and counts are opaque, so that other values compile no other kernel.
"""

import numpy as np

from render.backend.arrays import opaque
from render.backend.jit import mi

# Powers of 1 / g with g^4 = g + 1, the three-dimensional additive recurrence of least discrepancy (Roberts 2018), times
# 2^32: integers wrap around exactly, so that a million samples are as well spread as the first.
_STEPS = (3518319155, 2882110345, 2360945575)
_ROUNDS = 8  # with Mitsuba's default, 4, the words of neighbouring lanes still correlate, by 0.5


def stream(seed: int, stage: int) -> "mi.UInt32":
    """Return an opaque 32-bit seed of its own for each (seed, stage)."""
    return opaque(mi.UInt32(int(np.random.SeedSequence([seed, stage]).generate_state(1)[0])))


def scramble(first: "mi.UInt32", second: "mi.UInt32") -> tuple:
    """Return two words for each pair of words, independent of those of any other pair (TEA: Zafar et al. 2010)."""
    return mi.sample_tea_32(first, second, _ROUNDS)


def pixel_position(pixel: "mi.UInt32", number: "mi.UInt32", seed: "mi.UInt32") -> "mi.Point2f":
    """Return sample `number` of a pixel in [0, 1)^2: a (0, 2)-sequence, scrambled by pixel (Kollig and Keller 2002).

    Every run of 2^k samples that starts at a multiple of 2^k is stratified in itself.
    """
    words = scramble(pixel, seed)
    return mi.Point2f(mi.radical_inverse_2(number, words[0]), mi.sobol_2(number, words[1]))


def bounce_variates(pixel: "mi.UInt32", number: "mi.UInt32", seed: "mi.UInt32") -> tuple:
    """Return three variates for the bounce of sample `number` of a pixel: a Kronecker sequence, rotated by pixel."""
    first, second = scramble(pixel, seed)
    third, _ = scramble(first, second)
    return tuple(
        uniform(shift + number * mi.UInt32(step)) for shift, step in zip((first, second, third), _STEPS, strict=True)
    )


def random_variates(sample: "mi.UInt32", seed: "mi.UInt32") -> tuple:
    """Return three independent variates per lane, for bounces beyond the first."""
    first, second = scramble(sample, seed)
    third, _ = scramble(first, second)
    return uniform(first), uniform(second), uniform(third)


def uniform(bits: "mi.UInt32") -> "mi.Float":
    """Map 32 bits to [0, 1) by the upper 24, which float32 holds exactly."""
    return mi.Float(bits >> 8) * 2.0**-24
