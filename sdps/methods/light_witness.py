"""What networks see of the light: whether it is one lamp at a time, and whether lights that are given are right."""

import logging
from collections.abc import Callable
from pathlib import Path

import numpy as np

from render.shared.errors import InputError
from render.shared.imaging.vectors import unit
from render.shared.seeds import spread_evenly
from sdps.core.estimate import Estimate
from sdps.core.intensities import grey, scale_to_mean
from sdps.inference.image_source import ImageSource
from sdps.inference.inference_config import InferenceConfig
from sdps.inference.stray_light import find_shadow
from sdps.methods.flat_things import covers_frame
from sdps.methods.given_lights import (
    LightFit,
    carry_intensities,
    compare_lights,
    find_intensities,
    measure_misfit,
    read_small,
    reduce_images,
)
from sdps.methods.method import Method
from sdps.methods.runner import Runner
from sdps.models.lcnet import INPUT_SIZE
from sdps.models.registry import COMBINATIONS

_ASKED = ("sdps-frames", "sdps-plus", "sdps")
"""Combinations whose lighting network is asked, the first whose weights are there."""
_FEWEST = 3
ANY_LIGHT = "anylight"
"""The combination that assumes nothing of the light."""
_LOOKED = 16
"""Images that are looked at, spread over all."""
_SHADOW = 0.1
"""A pixel is in shadow where it has less than this share of its bright values."""
_IN_SHADOW, _DOUBT, _MISFIT = 0.04, 5.0, 0.1
"""Share of the object in shadow, mean error to expect of the lights in degrees, and what Lambert's law leaves
unexplained, from which on the witnesses speak for lamps, and against them (docs/studies/stray-light.md)."""

_log = logging.getLogger(__name__)


def is_lit_by_lamps(
    images: ImageSource, mask: np.ndarray, find: Callable[[str], Path], config: InferenceConfig | None = None
) -> bool:
    """Return whether one lamp at a time lit the images, or nothing speaks against it.

    Three witnesses must agree that none did: next to nothing is in shadow, where a lamp leaves part of any round
    object; the network that finds lamps expects to be far off; and a matte surface under what it finds does not explain
    the images. What covers the frame tells nothing: flat things have no shadows under a lamp either.

    Args:
        images, mask, find, config: As for `see_lights`.
    """
    if covers_frame(mask):
        return True
    numbers = spread_evenly(range(len(images)), _LOOKED)
    read, share = read_small(images, mask, numbers, INPUT_SIZE)
    inside = share > (0.5 if (share > 0.5).any() else 0.0)
    small = np.where(inside[..., None], read / np.maximum(share, 1e-6)[..., None], np.float32(0.0))
    if find_shadow(small[:, inside].mean(-1), _SHADOW).mean() >= _IN_SHADOW:
        return True
    seen = see_lights(small, inside, find, config)
    if seen is None or seen.expected_light_error is None or float(seen.expected_light_error.mean()) < _DOUBT:
        return True
    strengths = scale_to_mean(grey(seen.intensities.astype(np.float64)))
    return measure_misfit(reduce_images(small, inside), seen.light_directions.astype(np.float64), strengths) < _MISFIT


def see_lights(
    images: ImageSource, mask: np.ndarray, find: Callable[[str], Path], config: InferenceConfig | None = None
) -> Estimate | None:
    """Return the lights a network finds in images, as if none were given; None where no weights are there.

    Args:
        images: (L, H, W, 3) linear radiance, an array or what reads it a few images at a time.
        mask: (H, W) bool.
        find: Gives the weights file of a name, or raises InputError.
        config: How networks are used.
    """
    for name in _ASKED:
        pair = COMBINATIONS[name]
        try:
            find(pair.lighting)
        except InputError:
            continue
        method = Method(name=pair.lighting, lighting=pair.lighting, light_views=pair.light_views)
        return Runner(method, find, config).estimate(images, mask, None, None)
    return None


def question_lights(
    images: ImageSource,
    mask: np.ndarray,
    directions: np.ndarray,
    intensities: np.ndarray | None,
    seen: Estimate | None,
    files: tuple[str, ...] = (),
) -> tuple[np.ndarray, LightFit | None]:
    """Look whether given lights are those of the images, and find the intensities where these are not given.

    Args:
        images, mask: As for `see_lights`.
        directions: (L, 3), as given, of any length but zero.
        intensities: (L,) or (L, 3), or None.
        seen: What a network finds, which intensities start from; without it they start equal.
        files: (L,) names of the images; without them only intensities are found.

    Returns:
        The intensities, those given or those found, and how the lights fit; None where nothing can be said.
    """
    directions = unit(np.asarray(directions, np.float64))
    reduced = reduce_images(images, mask)
    if intensities is None:
        start = np.ones(len(images))
        if seen is not None:
            start = carry_intensities(directions, seen.light_directions, seen.intensities)
        intensities = find_intensities(reduced, directions, start)
    if seen is None or len(files) < _FEWEST:
        return intensities, None
    relative = scale_to_mean(grey(np.asarray(intensities, np.float64)))
    return intensities, compare_lights(reduced, files, directions, relative, seen.light_directions)
