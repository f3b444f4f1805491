"""The losses of lights and normals (SDPS-Net, eqs. 2 and 3, and others).

All are means over equal shares (images of a scene, scenes of a batch), so that the mean of the losses of equal parts of
a batch is the loss of the whole: parts may be accumulated, or spread over processes.
"""

from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor
from torch.nn import functional


def class_loss(logits: Tensor, target: Tensor) -> Tensor:
    """Return the mean cross-entropy in nats of logits (B, Q, K) and true classes (B, Q) int64."""
    return functional.cross_entropy(logits.float().flatten(0, 1), target.flatten())


def soft_class_loss(logits: Tensor, target: Tensor) -> Tensor:
    """Return the mean cross-entropy in nats of logits (B, Q, K) and true class probabilities (B, Q, K)."""
    return functional.cross_entropy(logits.float().flatten(0, 1), target.flatten(0, 1))


def mean_over_object(values: Tensor, mask: Tensor) -> Tensor:  # (B,)
    """Return each scene's mean of values (B, 1, H, W) over its object; 0 where the mask (B, 1, H, W) is empty."""
    return (values * mask).sum(dim=(1, 2, 3)) / mask.sum(dim=(1, 2, 3)).clamp(min=1.0)


def faithful_normal_loss(normals: Tensor, truth: Tensor) -> Tensor:
    """Return the mean of 1 - cos over ALL pixels, as the authors' code does.

    The background's truth is a zero vector: each of its pixels adds a constant 1 and no gradient, so the
    value of a scene is `f * masked_normal_loss + (1 - f)` with foreground share f, and gradients shrink by f.

    Args:
        normals: (B, 3, H, W) unit estimates.
        truth: (B, 3, H, W) unit normals, zero outside the object.
    """
    return (1.0 - (normals * truth).sum(dim=1)).mean()


def masked_normal_loss(normals: Tensor, truth: Tensor, mask: Tensor) -> Tensor:
    """Return the mean over scenes of the mean of 1 - cos over the object's pixels.

    Args:
        normals: (B, 3, H, W) unit estimates.
        truth: (B, 3, H, W) unit normals.
        mask: (B, 1, H, W), 0 or 1; a scene without object pixels adds zero.
    """
    cosine = (normals * truth).sum(dim=1, keepdim=True)  # (B, 1, H, W)
    return mean_over_object(1.0 - cosine, mask).mean()


_CHORD_FLOOR = 0.02


def chord_normal_loss(normals: Tensor, truth: Tensor, mask: Tensor) -> Tensor:
    """Return the mean over scenes of the mean distance |n - truth| over the object's pixels, smooth near zero.

    It grows with the angle as the mean angular error does, not with its square as 1 - cos: hopeless pixels do not
    outweigh all others.

    Args:
        normals: (B, 3, H, W) unit estimates.
        truth: (B, 3, H, W) unit normals.
        mask: (B, 1, H, W), 0 or 1; a scene without object pixels adds zero.
    """
    squares = (normals - truth).square().sum(dim=1, keepdim=True)  # (B, 1, H, W)
    distances = (squares + _CHORD_FLOOR**2).sqrt() - _CHORD_FLOOR
    return mean_over_object(distances, mask).mean()


def expected_distance_loss(expected: Tensor, distances: Tensor) -> Tensor:
    """Return how badly each expected distance describes that made: the negative log-likelihood of an exponential one.

    It is least on average where the expected distance, positive, is the mean of those that occur. Any shape.
    """
    return distances / expected + expected.log()


def expected_error_loss(expected: Tensor, normals: Tensor, truth: Tensor, mask: Tensor) -> Tensor:
    """Return the mean over scenes of `expected_distance_loss` over the object's pixels; normals learn nothing by it.

    Args:
        expected: (B, 1, H, W) expected distances |n - truth|, positive.
        normals: (B, 3, H, W) unit estimates.
        truth: (B, 3, H, W) unit normals.
        mask: (B, 1, H, W), 0 or 1; a scene without object pixels adds zero.
    """
    distances = (normals.detach() - truth).norm(dim=1, keepdim=True)
    return mean_over_object(expected_distance_loss(expected, distances), mask).mean()


def normal_gradient_loss(normals: Tensor, truth: Tensor, mask: Tensor) -> Tensor:
    """Return the mean over scenes of the mean error of the step from a pixel to its neighbour, |x| + |y| + |z|.

    Only pairs of pixels that both lie on the object count.

    Args:
        normals: (B, 3, H, W) unit estimates.
        truth: (B, 3, H, W) unit normals.
        mask: (B, 1, H, W), 0 or 1; a scene without pairs adds zero.
    """
    error = (normals - truth) * mask  # of (B, 3, H, W), whose steps are the errors of the steps
    sums, pairs = torch.zeros_like(mask[:, 0, 0, 0]), torch.zeros_like(mask[:, 0, 0, 0])
    for axis in (2, 3):
        both = mask.narrow(axis, 1, mask.shape[axis] - 1) * mask.narrow(axis, 0, mask.shape[axis] - 1)
        sums = sums + (error.diff(dim=axis).abs() * both).sum(dim=(1, 2, 3))
        pairs = pairs + both.sum(dim=(1, 2, 3))
    return (sums / pairs.clamp(min=1.0)).mean()


@dataclass(frozen=True)
class NormalCriterion:
    """The loss of a normal network, as a run's configuration chooses it.

    Attributes:
        kind: 1 - cos, over the object (`masked`) or all pixels (`faithful`); or the distance of the vectors (`chord`).
        gradient_weight: Weight of `normal_gradient_loss`.
        lighting_weight: Weight of the loss of lights, for networks that learn them too.
        expected_weight: Weight of the loss of the expected error, for networks that predict it.
    """

    kind: Literal["masked", "faithful", "chord"] = "masked"
    gradient_weight: float = 0.0
    lighting_weight: float = 0.1
    expected_weight: float = 0.02

    def __call__(self, normals: Tensor, truth: Tensor, mask: Tensor) -> tuple[Tensor, dict[str, Tensor]]:
        """Return the loss of estimated normals alone, and its named parts.

        Args:
            normals: (B, 3, H, W) unit estimates.
            truth: (B, 3, H, W) unit normals.
            mask: (B, 1, H, W), 0 or 1.
        """
        masked = masked_normal_loss(normals, truth, mask)
        loss, terms = masked, {"masked_loss": masked}
        if self.kind == "chord":
            loss = chord_normal_loss(normals, truth, mask)
        elif self.kind == "faithful":
            loss = faithful_normal_loss(normals, truth)
        if self.gradient_weight:
            terms["gradient_loss"] = normal_gradient_loss(normals, truth, mask)
            loss = loss + self.gradient_weight * terms["gradient_loss"]
        return loss, terms
