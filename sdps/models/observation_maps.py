"""Observation maps: what one pixel showed under each light, laid out by where the light stood (CNN-PS, sec. 3).

A light's direction (x, y, z) is projected along the view axis onto a square of 32 x 32 cells that holds the unit disc;
the pixel's grey values, divided by their maximum, go to the cells of their lights. A map neither depends on the number
of lights nor on their order, and since the view is the z axis, turning the lights and the normal about it gives another
valid pixel: training draws such rotations, and the test averages over them.

Legend: N pixels, Q lights.
"""

import math
from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from render.shared.errors import InputError
from sdps.models.cnnps import MAP_SIDE

_BLACK = 1e-12
"""A pixel whose maximum is below is black: far under any radiance, yet its inverse's square is a float32."""


def observation_maps(values: Tensor, directions: Tensor, valid: Tensor) -> Tensor:
    """Return the observation maps (N, 1, 32, 32), float32 in [0, 1], of N pixels; a black pixel's map is zero.

    Cell (floor(31 (x + 1) / 2), floor(31 (y + 1) / 2)) belongs to the lights of direction (x, y, z), empty cells are
    zero. Lights that share a cell give it their mean: the authors' code keeps the last one, but estimated lights are
    the centres of a few classes, so that many lights land in one cell and all but one would be lost. Negative values,
    which noise brings and no sensor, count as zero: against the maximum of a dark pixel they would be enormous.

    Args:
        values: (N, Q) grey radiance, divided by the light intensities; any overall scale.
        directions: (N, Q, 3), or (Q, 3) for all pixels, unit, from the surface to the light.
        valid: (N, Q) bool, the lights to use; the values of others are not looked at.

    Raises:
        InputError: no lights, or shapes that do not belong together.
    """
    _check_shapes(values, directions, valid)
    values = torch.where(valid, values.float(), 0.0).clamp(min=0.0)  # (N, Q)
    values = values / values.amax(dim=1, keepdim=True).clamp(min=_BLACK)
    position = (0.5 * (directions[..., :2].float() + 1.0) * (MAP_SIDE - 1)).long().clamp(0, MAP_SIDE - 1)
    cell = (position[..., 0] * MAP_SIDE + position[..., 1]).expand(values.shape)  # (N, Q)
    sums, counts = (
        torch.zeros(len(values), MAP_SIDE**2, device=values.device).scatter_add(1, cell, part)
        for part in (values, valid.float())
    )
    return (sums / counts.clamp(min=1.0)).view(-1, 1, MAP_SIDE, MAP_SIDE)


def rotate_about_view(vectors: Tensor, angle: float | Tensor) -> Tensor:
    """Turn vectors (..., 3) by `angle` radians about the view axis z, from x towards y.

    Args:
        vectors: (..., 3).
        angle: A number, or a tensor that broadcasts to (...).
    """
    angle = torch.as_tensor(angle, dtype=vectors.dtype, device=vectors.device)
    cosine, sine = angle.cos(), angle.sin()
    x, y, z = vectors.unbind(-1)
    return torch.stack([cosine * x - sine * y, sine * x + cosine * y, z], dim=-1)


def predict_normals(
    network: nn.Module, values: Tensor, directions: Tensor, valid: Tensor, *, rotations: int = 10
) -> Tensor:
    """Return unit normals (N, 3), float32: the mean over rotations of the lights, each estimate turned back.

    The result turns with the lights for turns by multiples of 360 / `rotations` degrees. Pixels that are black under
    all of their lights get (0, 0, 1), towards the camera; so do those whose estimates cancel.

    Args:
        network: Maps (N, 1, 32, 32) to normals (N, 3); in evaluation mode.
        values, directions, valid: See `observation_maps`.
        rotations: K, evenly spaced over the circle.
    """
    if rotations < 1:
        raise InputError(f"rotations must be at least 1, got {rotations}")
    total = torch.zeros(len(values), 3, device=values.device)
    for step in range(rotations):
        angle = 2.0 * math.pi * step / rotations
        maps = observation_maps(values, rotate_about_view(directions, angle), valid)
        total = total + rotate_about_view(network(maps).float(), -angle)
    lit = torch.where(valid, values, 0.0).amax(dim=1, keepdim=True) > _BLACK
    known = lit & (total.norm(dim=1, keepdim=True) > 1e-6)
    return torch.where(known, functional.normalize(total, dim=1), total.new_tensor([0.0, 0.0, 1.0]))


@torch.no_grad()
def estimate_normals(
    network: nn.Module,
    images: np.ndarray,  # (Q, H, W, 3)
    mask: np.ndarray,  # (H, W)
    directions: np.ndarray,  # (Q, 3)
    *,
    rotations: int = 10,
    chunk: int | None = None,
    progress: Callable[[int], object] | None = None,
) -> np.ndarray:
    """Return normals (H, W, 3), float32, unit inside the mask and zero outside, with CNN-PS on the network's device.

    Beside the images themselves, memory depends on `chunk` only: about 1 MiB per pixel of it. The network's work does
    not depend on the number of lights.

    Args:
        network: A `CNNPS`; put into evaluation mode for the call.
        images: (Q, H, W, 3) float, linear radiance divided by the light intensities; any overall scale.
        mask: (H, W) bool.
        directions: (Q, 3) float, from the surface to the light; need not be of unit length.
        rotations: K, the rotations about the view axis that are averaged.
        chunk: Pixels in work at once; by default 64 on a CPU, whose caches then hold the network's features (twice as
            fast as 512), and 2048 elsewhere.
        progress: Called with the number of pixels done after each chunk, such as a bar's `update`.

    Raises:
        InputError: no lights, shapes that do not belong together, a direction without length, values that are not
            finite inside the mask.
    """
    lights = _check_scene(images, mask, directions)
    device = next(network.parameters()).device
    chunk = (64 if device.type == "cpu" else 2048) if chunk is None else chunk
    if chunk < 1:
        raise InputError(f"chunk must be at least 1 pixel, got {chunk}")
    told = torch.from_numpy(lights).to(device)
    normals = np.zeros((*mask.shape, 3), np.float32)
    rows, columns = np.nonzero(mask)
    training = network.training
    network.eval()
    try:
        for start in range(0, len(rows), chunk):
            place = rows[start : start + chunk], columns[start : start + chunk]
            grey = images[:, *place].mean(axis=-1, dtype=np.float32).T  # (N, Q)
            if not np.isfinite(grey).all():
                raise InputError("the images hold NaN or infinite values inside the mask; repair them first")
            values = torch.from_numpy(np.ascontiguousarray(grey)).to(device)
            valid = torch.ones_like(values, dtype=torch.bool)
            normals[place] = predict_normals(network, values, told, valid, rotations=rotations).cpu().numpy()
            if progress is not None:
                progress(len(grey))
    finally:
        network.train(training)
    return normals


def _check_shapes(values: Tensor, directions: Tensor, valid: Tensor) -> None:
    """Refuse tensors that do not describe the same pixels and lights."""
    if values.ndim != 2 or not values.shape[1]:
        raise InputError(f"observation maps need values (N, Q) of Q >= 1 lights, got {tuple(values.shape)}")
    pixels, lights = values.shape
    if tuple(directions.shape) not in ((lights, 3), (pixels, lights, 3)):
        raise InputError(
            f"values of {pixels} pixels under {lights} lights need directions of shape ({lights}, 3) or "
            f"({pixels}, {lights}, 3), got {tuple(directions.shape)}"
        )
    if valid.shape != values.shape or valid.dtype != torch.bool:
        raise InputError(f"valid must be bool of shape ({pixels}, {lights}), got {valid.dtype} {tuple(valid.shape)}")


def _check_scene(images: np.ndarray, mask: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Refuse unusable input in one line; return the directions (Q, 3) float32 at unit length."""
    if images.ndim != 4 or images.shape[-1] != 3 or not len(images):
        raise InputError(f"images must be (Q, H, W, 3) of Q >= 1 lights, got {images.shape}")
    if mask.shape != images.shape[1:3] or mask.dtype != np.bool_:
        raise InputError(f"the mask must be bool of shape {images.shape[1:3]}, got {mask.dtype} of {mask.shape}")
    if np.shape(directions) != (len(images), 3):
        raise InputError(
            f"{len(images)} images need light directions of shape ({len(images)}, 3), got {np.shape(directions)}"
        )
    directions = np.asarray(directions, np.float64)
    lengths = np.linalg.norm(directions, axis=1, keepdims=True)
    if not (np.isfinite(lengths) & (lengths > 0.0)).all():
        raise InputError("a light direction is zero or not finite; give unit vectors from the surface to the light")
    return (directions / lengths).astype(np.float32)
