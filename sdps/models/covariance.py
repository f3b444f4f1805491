"""Covariances of the directions that an image's light comes from, as the six numbers that make one.

A lamp's light comes from one direction, that of a room or of the sky from many: their mean, with the irradiance, says
what spherical harmonics of order one do, and their covariance what those of order two add (Ramamoorthi and Hanrahan,
SIGGRAPH 2001). A lamp's is zero.
"""

import torch
from torch import Tensor

_ROWS, _COLUMNS = torch.triu_indices(3, 3).tolist()
_PLACES = [[0, 1, 2], [1, 3, 4], [2, 4, 5]]
"""Which of the six numbers each element of a matrix is."""


def pack(matrices: Tensor) -> Tensor:
    """Return the six numbers (..., 6) of symmetric matrices (..., 3, 3): xx, xy, xz, yy, yz, zz."""
    return matrices[..., _ROWS, _COLUMNS]


def unpack(numbers: Tensor) -> Tensor:
    """Return the symmetric matrices (..., 3, 3) of which `pack` gives these numbers (..., 6)."""
    return numbers[..., _PLACES]


def turn(numbers: Tensor, rotations: Tensor) -> Tensor:
    """Return the numbers (N, Q, 6) of R C R^T, where `numbers` (N, Q, 6) are those of C and R is of (N, 3, 3)."""
    rows, columns = rotations[:, _ROWS], rotations[:, _COLUMNS]  # (N, 6, 3) each
    both = rows[..., None] * columns[..., None, :]  # (N, 6, 3, 3)
    once = pack(both + both.transpose(-1, -2))  # (N, 6, 6), what is on the diagonal twice
    once = once * once.new_tensor([0.5, 1.0, 1.0, 0.5, 1.0, 0.5])
    return numbers @ once.transpose(1, 2)
