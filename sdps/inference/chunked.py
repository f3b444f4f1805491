"""Networks applied to a scene's images chunk by chunk, with the result of seeing them all at once.

Maximum and mean over the images are all that most networks share between them, so running ones suffice. Of every image
only a lighting network's local feature is kept: 64 kB, half of that in bfloat16; and, for normal networks that attend
to the lights of a pixel, 16 bytes per pixel.

Legend: L images, P pixels of the object, (h, w) the sides of what the network sees.
"""

from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional

from render.shared.progress import share, stage
from sdps.core.symmetry import Symmetry
from sdps.inference.turned_views import AnyView
from sdps.models.base import (
    KeepingNetwork,
    LightingNetwork,
    Lights,
    MeetingNetwork,
    NormalNetwork,
    TurningNetwork,
    divide,
)
from sdps.models.cnnps import predict_normals

Autocast = Callable[[], AbstractContextManager[Any]]
_GREY_VALUES = 2**26
"""Grey values kept at once for pixel networks (256 MiB); of more, the images are read again for further pixels."""
_READ_SHARE, _FUSED_SHARE, _SEEN_SHARE = 0.05, 0.4, 0.9
"""Parts of the time for normals until a network has read all images, has fused them, and has seen them one by one."""
_PIXELS = {"cpu": 64, "cuda": 2048}
"""Pixels a pixel network sees at once: what fits the caches of a CPU is twice as fast there as more."""


def lighting_prediction(
    network: LightingNetwork,
    view: AnyView,
    autocast: Autocast,
    context: Callable[[slice], Tensor] | None = None,
    seed: int = 0,
) -> Any:
    """Return a lighting network's prediction for all images, as its `forward` would.

    Args:
        network: In evaluation mode.
        view: Images of 128x128.
        autocast: Makes the context in which the network runs.
        context: Further channels (1, n, C, 128, 128) for the images of a slice.
        seed: For what a `MeetingNetwork` draws.
    """
    mask, local = view.mask, []
    for part, images in view:
        extra = None if context is None else context(part)
        with autocast():
            feature = network.encode(images, mask, extra)  # (1, n, F, 8, 8)
        stage("lights", part.stop, len(view))
        local.append(feature)
    if isinstance(network, MeetingNetwork):
        with autocast():
            return network.predict_many(torch.cat(local, dim=1), seed)
    shared = torch.cat([feature.amax(dim=1, keepdim=True) for feature in local], dim=1).amax(dim=1, keepdim=True)
    with autocast():
        predictions = [network.predict(feature, shared) for feature in local]
    return type(predictions[0])(*(torch.cat(parts, dim=1) for parts in zip(*predictions, strict=True)))


def normal_map(
    network: NormalNetwork,
    view: AnyView,
    lights: Lights | None,
    autocast: Autocast,
    symmetries: Sequence[Symmetry] = (),
) -> list[tuple[Tensor, Tensor | None]]:
    """Return a normal network's unit normals (1, 3, h, w), float32, and the errors it expects of them.

    Args:
        network: In evaluation mode.
        view: Images whose sides are multiples of `network.size_multiple`.
        lights: Of all images, (1, L, ...); None for networks that are not told the lights.
        autocast: Makes the context in which the network runs.
        symmetries: Of a `TurningNetwork`: an answer for each, of the feature turned so. Others give one.
    """
    brightness = None if network.division == "none" else _brightness(network, view, lights)
    mask = view.mask
    feature: Any = None
    kept: list[Any] = []
    begun = _READ_SHARE if isinstance(network, KeepingNetwork) else _SEEN_SHARE
    with share(0.0, begun):
        for part, images in view:
            some = None if lights is None else lights.part(part)
            seen = network.observe(images, mask, some, brightness)
            with autocast():
                if isinstance(network, KeepingNetwork):
                    kept.append(network.kept(seen))
                else:
                    feature = _maximum(feature, network.encode(seen))
            stage("normals", part.stop, len(view))
    if isinstance(network, KeepingNetwork):
        with autocast(), share(begun, begun := _FUSED_SHARE):
            feature = network.fused(kept)
        kept.clear()
    assert feature is not None  # a view has an image
    with share(begun, 1.0):
        return list(_answers(network, feature, autocast, symmetries))


def _answers(
    network: NormalNetwork, feature: Any, autocast: Autocast, symmetries: Sequence[Symmetry]
) -> Iterator[tuple[Tensor, Tensor | None]]:
    """Yield the normals of a feature; of a `TurningNetwork` one after the other, as each turned scene has them."""
    if not (isinstance(network, TurningNetwork) and symmetries):
        with autocast():
            yield network.regress_with_error(feature)
        return
    for number, symmetry in enumerate(symmetries):
        with autocast():
            yield network.regress_with_error(network.turned(feature, symmetry))
        stage("normals", number + 1, len(symmetries))


def _brightness(network: NormalNetwork, view: AnyView, lights: Lights | None) -> Tensor:
    """Return `network.brightness` of all images, (1, 1, 1, h, w)."""
    total: Tensor | None = None
    for part, images in view:
        if network.needs_lights:
            assert lights is not None
            images = divide(images, lights.intensities[:, part])
        found = network.brightness(images)
        if network.division == "max":
            total = _maximum(total, found)
        else:
            found = found * (images.shape[1] / len(view))
            total = found if total is None else total + found
    assert total is not None  # a view has an image
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


def _maximum(first: Tensor | None, second: Tensor) -> Tensor:
    return second if first is None else torch.maximum(first, second)
