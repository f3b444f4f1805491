"""Networks applied to a scene's images chunk by chunk, with the result of seeing them all at once.

Of every image only a lighting network's local feature is kept, 64 kB, half of that in bfloat16, and what a normal
network asks for: `kept_bytes` per pixel.

Legend: L images, P pixels of the object, (h, w) the sides of what the network sees.
"""

from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional

from render.shared.progress import repeat, share, stage
from sdps.core.symmetry import Symmetry
from sdps.inference.image_source import View
from sdps.inference.turned_views import AnyView, TurnedView, turn_lights
from sdps.models.base import FusionNetwork, LightingNetwork, Lights, Placement, divide
from sdps.models.cnnps import predict_normals

Autocast = Callable[[], AbstractContextManager[Any]]
_GREY_VALUES = 2**26
"""Grey values kept at once for pixel networks (256 MiB); of more, the images are read again for further pixels."""
_READ_SHARE, _AGGREGATED_SHARE, _SEEN_SHARE = 0.05, 0.4, 0.9
"""Parts of the time for normals until a network has read all images, has aggregated them, and has seen each."""
_PIXELS = {"cpu": 64, "cuda": 2048}
"""Pixels a pixel network sees at once: what fits the caches of a CPU is twice as fast there as more."""


def lighting_prediction(
    network: LightingNetwork,
    view: AnyView,
    autocast: Autocast,
    seed: int = 0,
) -> Any:
    """Return a lighting network's prediction for all images, as its `forward` would.

    Args:
        network: In evaluation mode.
        view: Images of 128x128.
        autocast: Makes the context in which the network runs.
        seed: For networks that draw something.
    """
    mask, local = view.mask, []
    for part, images in view:
        with autocast():
            local.append(network.encode(images, mask))  # (1, n, F, 8, 8)
        stage("lights", part.stop, len(view))
    with autocast():
        return network.predict_parts(local, seed)


def normal_map(
    network: FusionNetwork, view: View, lights: Lights | None, autocast: Autocast, symmetries: Sequence[Symmetry]
) -> list[tuple[Tensor, Tensor | None]]:
    """Return unit normals (1, 3, h, w), float32, of every turned view, and the errors to expect of them.

    Args:
        network: In evaluation mode.
        view: Images whose sides are multiples of `network.size_multiple`.
        lights: Of all images, (1, L, ...); None for networks that are not given them.
        autocast: Makes the context in which the network runs.
        symmetries: How the view is turned.
    """
    found = []
    if network.equivariant:  # the images are seen once
        feature = _feature(network, view, lights, autocast)
        with share(_AGGREGATED_SHARE, 1.0):
            for number, symmetry in enumerate(symmetries):
                with autocast():
                    found.append(network.regress_with_error(network.turn(feature, symmetry)))
                stage("normals", number + 1, len(symmetries))
        return found
    for number, symmetry in enumerate(symmetries):
        with repeat(number, len(symmetries)):
            feature = _feature(network, TurnedView(view, symmetry), turn_lights(symmetry, lights), autocast)
            with autocast():
                found.append(network.regress_with_error(feature))
    return found


def _feature(network: FusionNetwork, view: AnyView, lights: Lights | None, autocast: Autocast) -> Any:
    """Return the feature of all images."""
    brightness = _brightness(network, view, lights) if network.normalised else None
    placed = view.placed if isinstance(view, View | TurnedView) and network.sees_places else None
    placement = None if placed is None else Placement(*placed)
    mask = view.mask
    accumulated: Any = None
    read = _READ_SHARE if network.kept_bytes else _SEEN_SHARE
    with share(0.0, read):
        for part, images in view:
            some = None if lights is None else lights.select(part)
            seen = network.observe(images, mask, some, brightness, placement)
            with autocast():
                accumulated = network.accumulate(accumulated, seen)
            stage("normals", part.stop, len(view))
    with autocast(), share(read, _AGGREGATED_SHARE if network.kept_bytes else 1.0):
        return network.aggregate(accumulated)


def _brightness(network: FusionNetwork, view: AnyView, lights: Lights | None) -> Tensor:
    """Return `network.brightness` of all images, (1, 1, 1, h, w)."""
    total = torch.zeros(())
    for part, images in view:
        if network.needs_lights:
            assert lights is not None
            images = divide(images, lights.intensities[:, part])
        total = total + network.brightness(images) * (images.shape[1] / len(view))
    return total


def pixel_normal_map(
    network: nn.Module, view: AnyView, lights: Lights, autocast: Autocast, *, rotations: int
) -> Tensor:
    """Return CNN-PS's unit normals (1, 3, h, w), float32, zero outside the mask.

    Args:
        network: In evaluation mode.
        view: Images.
        lights: Of all images, (1, L, ...).
        autocast: Makes the context in which the network runs.
        rotations: Rotations about the view axis that are averaged.
    """
    inside = view.mask[0, 0] > 0.5  # (h, w)
    places = inside.flatten().nonzero()[:, 0]  # (P,)
    normals = torch.zeros(inside.numel(), 3, device=places.device)
    for some in places.split(max(1, _GREY_VALUES // len(view))):
        grey = torch.empty(len(some), len(view), device=places.device)
        for part, images in view:
            pixels = divide(images, lights.intensities[:, part])[0].flatten(2)[..., some]  # (n, 3, p)
            grey[:, part] = pixels.mean(dim=1).T
        count = _PIXELS.get(places.device.type, 512)
        for start in range(0, len(some), count):
            values = grey[start : start + count]
            valid = torch.ones_like(values, dtype=torch.bool)
            with autocast():
                found = predict_normals(network, values, lights.directions[0], valid, rotations=rotations)
            normals[some[start : start + count]] = found
        stage("normals", int(some[-1]) + 1, inside.numel())
    return normals.T.unflatten(1, inside.shape)[None]


def pad_to(multiple: int) -> Callable[[Tensor, Tensor], tuple[Tensor, Tensor]]:
    """Return what pads images and mask, below and right, with black to sides that are multiples of a number."""

    def fit(images: Tensor, mask: Tensor) -> tuple[Tensor, Tensor]:
        height, width = mask.shape[-2:]
        border = (0, -width % multiple, 0, -height % multiple)
        return functional.pad(images, border), functional.pad(mask, border)

    return fit
