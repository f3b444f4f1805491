"""Asking a lighting network about photographs whose lights are given, in whole or in part."""

import logging
from collections.abc import Callable
from pathlib import Path

import numpy as np

from render.shared.errors import InputError
from render.shared.imaging.vectors import unit
from sdps.core.estimate import Estimate
from sdps.core.intensities import grey, scale_to_mean
from sdps.inference.image_source import ImageSource
from sdps.inference.inference_config import InferenceConfig
from sdps.methods.given_lights import LightFit, carry_intensities, compare_lights, find_intensities, reduce_images
from sdps.methods.method import Method
from sdps.methods.runner import Runner
from sdps.models.registry import COMBINATIONS

_ASKED = ("sdps-frames", "sdps-plus", "sdps")
"""Combinations whose lighting network is asked, the first whose weights are there."""
_FEWEST = 3

_log = logging.getLogger(__name__)


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
