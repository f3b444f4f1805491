"""What networks see of the light: whether it is one lamp at a time, and whether lights that are given are right."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from render.shared.errors import InputError
from render.shared.imaging.vectors import unit
from render.shared.seeds import spread_evenly
from sdps.core.estimate import Estimate
from sdps.core.intensities import grey, scale_to_mean
from sdps.inference.image_source import ImageSource
from sdps.inference.inference_config import InferenceConfig
from sdps.methods.flat_things import covers_frame
from sdps.methods.given_lights import (
    LightFit,
    carry_intensities,
    compare_lights,
    find_intensities,
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
ROOM = 0.2
"""Variance of the directions of a picture's light, summed over the three axes, from which on it did not come from a
single lamp. With 8 images a network estimates 0.16 or less for rendered lamps, 0.25 or more for surroundings
(docs/studies/stray-light.md)."""


def is_lit_by_lamps(
    images: ImageSource, mask: np.ndarray, find: Callable[[str], Path], config: InferenceConfig | None = None
) -> bool:
    """Return whether one lamp at a time lit the images, or nothing speaks against it.

    A network estimates how far the directions of a picture's light spread; those of a lamp do not. It was never trained
    on flat things, so an object that covers the frame counts as lit by lamps.

    Args:
        images, mask, find, config: As for `see_lights`.

    Raises:
        InputError: no weights for any light.
    """
    return covers_frame(mask) or measure_spread(images, mask, find, config) < ROOM


def measure_spread(
    images: ImageSource, mask: np.ndarray, find: Callable[[str], Path], config: InferenceConfig | None = None
) -> float:
    """Return how far the directions of a picture's light spread, as a network estimates it: their variance, summed over
    the three axes and averaged over the pictures, from about 0 (a lamp) to 1. Weights that know only lamps give 0.

    Args:
        images, mask, find, config: As for `see_lights`.

    Raises:
        InputError: no weights for any light.
    """
    numbers = spread_evenly(range(len(images)), _LOOKED)
    read, share = read_small(images, mask, numbers, INPUT_SIZE)
    inside = share > (0.5 if (share > 0.5).any() else 0.0)
    small = np.where(inside[..., None], read / np.maximum(share, 1e-6)[..., None], np.float32(0.0))
    seen = _ask(ANY_LIGHT, small, inside, find, replace(config or InferenceConfig(), stray_light=False))
    if seen.light_covariance is None:
        return 0.0
    return float(np.trace(seen.light_covariance, axis1=1, axis2=2).mean())


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
        try:
            find(COMBINATIONS[name].lighting)
        except InputError:
            continue
        return _ask(name, images, mask, find, config)
    return None


def _ask(
    name: str, images: ImageSource, mask: np.ndarray, find: Callable[[str], Path], config: InferenceConfig | None
) -> Estimate:
    """Return the lights that the lighting network of a combination finds."""
    pair = COMBINATIONS[name]
    method = Method(name=pair.lighting, lighting=pair.lighting, light_views=pair.light_views)
    return Runner(method, find, config).estimate(images, mask, None, None)


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
