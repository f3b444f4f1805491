"""The two stages' losses (SDPS-Net, eqs. 2 and 3).

All are means over equal shares (images of a scene, scenes of a batch), so that the mean of the losses of equal parts of
a batch is the loss of the whole: parts may be accumulated, or spread over processes.
"""

from torch import Tensor
from torch.nn import functional


def class_loss(logits: Tensor, target: Tensor) -> Tensor:
    """Return the mean cross-entropy in nats of logits (B, Q, K) and true classes (B, Q) int64."""
    return functional.cross_entropy(logits.float().flatten(0, 1), target.flatten())


def soft_class_loss(logits: Tensor, target: Tensor) -> Tensor:
    """Return the mean cross-entropy in nats of logits (B, Q, K) and true class probabilities (B, Q, K)."""
    return functional.cross_entropy(logits.float().flatten(0, 1), target.flatten(0, 1))


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
    sums = ((1.0 - cosine) * mask).sum(dim=(1, 2, 3))  # (B,)
    return (sums / mask.sum(dim=(1, 2, 3)).clamp(min=1.0)).mean()
