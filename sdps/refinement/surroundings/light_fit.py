"""Each image's light and each pixel's albedo in closed form, given normals.

    E_pic = sum_k L_ick b_pk,    b_p = (B_p0 .. B_p8,  x B_p0 .. x B_p3,  y B_p0 .. y B_p3,  z B_p0 .. z B_p3)
    I_pic = a_pc E_pic

Pixel p, image i, channel c; B what the pixel sees of each harmonic (`hidden`), (x, y, z) where it lies, in the object's
radii from its middle. Lamps and windows of a room are not far away, so harmonics up to order one may change over the
object at an even rate. Light and albedo are least squares, with each observation weighted by how well it fits (Cauchy).
"""

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from render.shared.errors import InputError
from sdps.refinement.surroundings.hidden import visible_harmonics

CHANGING = 4
"""Harmonics that change over the object: those up to order one."""
TERMS = 9 + 3 * CHANGING
_SCALE = 0.1
"""Residual, over the pixel's brightness, above which an observation is believed less."""
_FAINT = 0.2
"""Share of the mean radiance that is added to a pixel's brightness: darker ones count less."""
_RIDGES = (0.0, *(1e-4,) * 3, *(4e-4,) * 5, *(1e-2,) * 3 * CHANGING)
"""Of the terms of light, in terms of what the first one explains."""
_LEAST_ALBEDO = 1e-4
_ROUNDS = 30


class Pixels(NamedTuple):
    """Pixels under all images, and what does not depend on their normals.

    Attributes:
        images: (P, L, 3) float32, each image over its mean.
        usable: (P, L, 1) float32, 0 for observations that are ignored, else 1.
        brightness: (P, 1, 1), what residuals are measured against.
        places: (P, 3), in the object's radii from its middle.
        hidden: (P, 9, 3), C of `hidden`.
    """

    images: Tensor
    usable: Tensor
    brightness: Tensor
    places: Tensor
    hidden: Tensor

    @property
    def values(self) -> float:
        """How many there are."""
        return float(self.images.numel())


class Fit(NamedTuple):
    """What explains the pixels, and how well.

    Attributes:
        light: (L, 3, `TERMS`).
        albedo: (P, 3).
        trust: (P, L, 3), weight of each observation.
        residual: (P, L, 3), over the brightness.
    """

    light: Tensor
    albedo: Tensor
    trust: Tensor
    residual: Tensor


def gather(values: np.ndarray, full: np.ndarray, levels: np.ndarray, places: np.ndarray, hidden: Tensor) -> Pixels:
    """Return pixels as they are fitted.

    Args:
        values: (P, L, 3) float32 radiance; divided in place.
        full: (L, 3), radiance at which a channel is clipped.
        levels: (L,), what each image is divided by.
        places: (P, 3).
        hidden: (P, 9, 3).

    Raises:
        InputError: an image that is black.
    """
    if not (levels > 0.0).all():
        raise InputError("refinement: the object is black in an image; leave that out")
    usable = torch.from_numpy(~(values >= full).any(axis=2, keepdims=True)).float()
    values /= levels[:, None]
    images = torch.from_numpy(values)
    brightness = images.mean(dim=(1, 2), keepdim=True) + _FAINT  # the mean over all pixels is 1
    return Pixels(images, usable, brightness, torch.from_numpy(places.astype(np.float32)), hidden)


def spread(normals: Tensor, pixels: Pixels) -> Tensor:
    """Return b, (P, `TERMS`), of unit normals (P, 3); differentiable."""
    seen = visible_harmonics(normals, pixels.hidden)
    return torch.cat([seen, *(seen[:, :CHANGING] * pixels.places[:, k : k + 1] for k in range(3))], dim=1)


def fit(pixels: Pixels, normals: Tensor) -> Fit:
    """Return light and albedo that explain the images best, given normals (P, 3)."""
    basis, found = spread(normals, pixels), start_fit(pixels)
    for _ in range(_ROUNDS):
        found = update(pixels, basis, found, fit_light(pixels, basis, found))
    return found


def start_fit(pixels: Pixels) -> Fit:
    """Return what is believed before anything is known of the light."""
    trust = (pixels.usable / pixels.brightness**2).expand_as(pixels.images)
    light = pixels.images.new_zeros(pixels.images.shape[1], 3, TERMS)
    return Fit(light, pixels.images.mean(dim=1).clamp_min(_LEAST_ALBEDO), trust, torch.zeros(0))


def update(pixels: Pixels, basis: Tensor, found: Fit, light: Tensor) -> Fit:
    """Return the albedo that fits best under light (L, 3, `TERMS`), with residuals and trust."""
    shading = (basis @ light.flatten(0, 1).T).view_as(pixels.images)
    weighted = found.trust * shading
    albedo = (weighted * pixels.images).sum(dim=1) / (weighted * shading).sum(dim=1).clamp_min(1e-6)
    albedo = albedo.clamp_min(_LEAST_ALBEDO)
    residual = shading.mul_(albedo[:, None]).neg_().add_(pixels.images).div_(pixels.brightness)
    trust = (pixels.usable / pixels.brightness**2) / (1.0 + (residual / _SCALE) ** 2)
    return Fit(light, albedo, trust, residual)


def fit_light(pixels: Pixels, basis: Tensor, found: Fit) -> Tensor:
    """Return the light (L, 3, `TERMS`) that fits best, given albedo and trust."""
    pairs = (basis[:, :, None] * basis[:, None]).flatten(1)  # (P, TERMS^2)
    ridge, light = torch.diag(basis.new_tensor(_RIDGES)), []
    for channel in range(3):
        albedo = found.albedo[:, channel : channel + 1]
        weights = found.trust[:, :, channel] * albedo  # (P, L)
        moments = ((weights * albedo).T @ pairs).unflatten(1, (TERMS, TERMS))
        right = (weights * pixels.images[:, :, channel]).T @ basis  # (L, TERMS)
        size = moments[:, :1, :1].clamp_min(1e-9)
        light.append(torch.linalg.solve(moments + size * ridge + 1e-9 * torch.eye(TERMS), right))
    return _take_out_albedo(torch.stack(light, dim=1))


def _take_out_albedo(light: Tensor) -> Tensor:
    """Return light (L, 3, `TERMS`) without the change over the object that all images share: that is the albedo's."""
    even, changing = light[..., :9], light[..., 9:].unflatten(-1, (3, CHANGING))
    low = even[..., None, :CHANGING]
    shared = (changing * low).sum(dim=(0, 1, 3), keepdim=True) / low.square().sum().clamp_min(1e-9)
    return torch.cat([even, (changing - shared * low).flatten(-2)], dim=-1)


def measure_misfit(pixels: Pixels, found: Fit) -> float:
    """Return the robust mean square of the residuals; an observation that does not fit at all counts little more than
    one that is off by 0.1 of the pixel's brightness.
    """
    errors = (found.residual / _SCALE).square_().log1p_().mul_(pixels.usable)
    return float(_SCALE**2 * errors.sum() / (3.0 * pixels.usable.sum()).clamp_min(1.0))


def slope(pixels: Pixels, found: Fit) -> Tensor:
    """Return the derivative of half the mean misfit, over the square of its scale, with respect to b, (P, `TERMS`)."""
    change = found.trust * found.residual * pixels.brightness * found.albedo[:, None]
    return change.flatten(1) @ found.light.flatten(0, 1) / (-pixels.values * _SCALE**2)
