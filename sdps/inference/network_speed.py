"""How fast networks are on this machine: they are run on a small object and timed.

Networks differ in how much they gain from a processor. Held to AVX2, a convolution takes 3.6 times as long as with
AVX-512 and its bfloat16, `frames`, which is mostly small products of matrices, 1.5 times; so no layer tells for all.
"""

import time
from collections.abc import Callable
from typing import TypeVar

import numpy as np
import torch

from sdps.core.precision import Arithmetic
from sdps.inference.estimator import Estimator
from sdps.models.base import FusionNetwork, LightingNetwork, Lights

_Network = TypeVar("_Network", FusionNetwork, LightingNetwork)
_See = Callable[[_Network, Arithmetic, int], Callable[[], object]]
_SIDE, _MOST = 40, 24  # pixels, and images, of the object that is looked at
_LIT = 4  # images whose lights are found
_ROUNDS = 3
_told: dict[tuple[object, ...], float] = {}  # seconds by what was timed: a network's kind and size, and how it computes


def time_normals(estimator: Estimator, images: int) -> float:
    """Return how many times as long as its `inference_seconds` says a network takes here to find normals.

    Args:
        estimator: With a normal model; 1 is returned where it finds no normals of many images at once.
        images: How many it will see.
    """
    network = None if estimator.normals is None else estimator.normals.network
    if not isinstance(network, FusionNetwork):
        return 1.0
    count = min(images, _MOST)
    seconds = _look_up(network, estimator.arithmetic, count, _see_normals)
    return seconds / network.inference_seconds(count, _SIDE**2, _SIDE**2, 1)


def time_lights(estimator: Estimator) -> float:
    """Return the seconds that a network takes here to find the light of one image, once; 0 without one."""
    network = None if estimator.lighting is None else estimator.lighting.network
    if not isinstance(network, LightingNetwork):
        return 0.0
    return _look_up(network, estimator.arithmetic, _LIT, _see_lights) / _LIT


def _look_up(network: _Network, chosen: Arithmetic, images: int, see: _See[_Network]) -> float:
    """Return the seconds that a network takes, timed once in the life of this process."""
    size = sum(parameter.numel() for parameter in network.parameters())
    key = type(network), size, chosen.precision, chosen.device, images, torch.get_num_threads()
    if key not in _told:
        with torch.inference_mode():
            _told[key] = time_usual(see(network, chosen, images))
    return _told[key]


def _see_normals(network: FusionNetwork, chosen: Arithmetic, images: int) -> Callable[[], object]:
    """Return what finds the normals of noise once."""
    draw = torch.Generator().manual_seed(0)  # what others draw stays as it was
    seen = torch.rand(1, images, 3, _SIDE, _SIDE, generator=draw).to(chosen.device)
    mask = torch.ones(1, 1, _SIDE, _SIDE, device=chosen.device)
    towards = torch.rand(1, images, 3, generator=draw) + torch.tensor([-0.5, -0.5, 0.5])
    towards = torch.nn.functional.normalize(towards, dim=-1).to(chosen.device)
    lights = Lights(towards, torch.ones(1, images, device=chosen.device))

    def find() -> None:
        observed = network.observe(seen, mask, lights if network.needs_lights else None)
        with chosen.autocast():
            float(network(observed).sum())

    return find


def _see_lights(network: LightingNetwork, chosen: Arithmetic, images: int) -> Callable[[], object]:
    """Return what finds the lights of noise once."""
    seen = torch.rand(1, images, 3, 128, 128, generator=torch.Generator().manual_seed(0)).to(chosen.device)
    mask = torch.ones(1, 1, 128, 128, device=chosen.device)

    def find() -> None:
        with chosen.autocast():
            network(seen, mask)

    return find


def time_usual(action: Callable[[], object]) -> float:
    """Return the seconds that an action takes: the median of a few, after kernels were made at the first."""
    took = []
    for _ in range(1 + _ROUNDS):
        began = time.perf_counter()
        action()
        took.append(time.perf_counter() - began)
    return float(np.median(took[1:]))
