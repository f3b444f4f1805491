"""The two stages' losses (SDPS-Net, eqs. 2 and 3)."""

from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional

from sdps.models.lcnet import LightingLogits


class LightingLoss(NamedTuple):
    """Cross-entropies in nats, each a mean over all images of the batch; `total` is their sum."""

    total: Tensor
    azimuth: Tensor
    elevation: Tensor
    intensity: Tensor


def lighting_loss(logits: LightingLogits, classes: tuple[Tensor, Tensor, Tensor]) -> LightingLoss:
    """Return the stage-1 loss.

    Args:
        logits: (B, Q, K) per kind of class.
        classes: True azimuth, elevation and intensity classes, each (B, Q) int64.
    """
    terms = [
        functional.cross_entropy(values.float().flatten(0, 1), target.flatten())
        for values, target in zip(logits, classes, strict=True)
    ]
    return LightingLoss(torch.stack(terms).sum(), *terms)


def faithful_normal_loss(normals: Tensor, truth: Tensor) -> Tensor:
    """Return the mean of 1 - cos over ALL pixels, as the authors' code does.

    The background's truth is a zero vector: each of its pixels adds a constant 1 and no gradient, so the
    value is `f * masked_normal_loss + (1 - f)` with foreground share f, and gradients shrink by f.

    Args:
        normals: (B, 3, H, W) unit estimates.
        truth: (B, 3, H, W) unit normals, zero outside the object.
    """
    return (1.0 - (normals * truth).sum(dim=1)).mean()


def masked_normal_loss(normals: Tensor, truth: Tensor, mask: Tensor) -> Tensor:
    """Return the mean of 1 - cos over the object's pixels; `mask` is (B, 1, H, W), 0 or 1."""
    cosine = (normals * truth).sum(dim=1, keepdim=True)  # (B, 1, H, W)
    return ((1.0 - cosine) * mask).sum() / mask.sum().clamp(min=1.0)
