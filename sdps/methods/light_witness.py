"""What networks see of the light: whether it is one lamp at a time, and whether lights that are given are right."""

import logging
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch

from render.shared.errors import InputError
from render.shared.imaging.vectors import unit
from sdps.core.estimate import Estimate
from sdps.core.intensities import grey, scale_to_mean
from sdps.inference.image_source import ImageSource
from sdps.inference.inference_config import InferenceConfig
from sdps.methods.given_lights import (
    LightFit,
    carry_intensities,
    compare_lights,
    find_intensities,
    read_small,
    reduce_images,
)
from sdps.methods.method import Method
from sdps.methods.runner import Runner, load_once
from sdps.models.anylight import AnyLightNet
from sdps.models.base import Observations
from sdps.models.registry import COMBINATIONS

_ASKED = ("sdps-frames", "sdps-plus", "sdps")
"""Combinations whose lighting network is asked, the first whose weights are there."""
_FEWEST = 3
ANY_LIGHT = "anylight"
"""The model that is told nothing of the light, and tells what it was like."""
DIRECT = 0.5
"""Directness from which on images count as lit by one lamp each."""
_LOOKED, _SIDE = 16, 128
"""Images that are looked at, spread over all, and their longer side: what the network was trained with."""

_log = logging.getLogger(__name__)


@torch.inference_mode()
def see_directness(images: ImageSource, mask: np.ndarray, find: Callable[[str], Path]) -> float | None:
    """Return how far light comes from one direction in each image, the median of some: 1 one lamp, 0 all sides alike.

    Args:
        images: (L, H, W, 3) linear radiance, an array or what reads it a few images at a time.
        mask: (H, W) bool, not empty.
        find: Gives the weights file of a name, or raises InputError.

    Returns:
        None where no weights are there.
    """
    try:
        network = load_once(find(ANY_LIGHT)).network
    except InputError:
        return None
    assert isinstance(network, AnyLightNet)
    numbers = np.unique(np.linspace(0, len(images) - 1, _LOOKED).round().astype(int)).tolist()
    read, share = read_small(images, mask, numbers, _SIDE)
    device = next(network.parameters()).device
    small = torch.from_numpy(read / np.maximum(share, 0.5)[..., None]).permute(0, 3, 1, 2)[None]  # (1, Q, 3, h, w)
    inside = torch.from_numpy((share > 0.5).astype(np.float32))[None, None]  # (1, 1, h, w)
    seen = Observations(small.to(device), mask=inside.to(device))
    return float(network.directness(seen).median())


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
