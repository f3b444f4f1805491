"""Priors: normals and highlights are smooth, normals are those of a surface, lights stay near the start as a whole."""

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import normalize

_STEEPEST = 0.1
"""Least n_z when slopes are computed."""
_ROUND = 1e-6
_STRETCH_FREE, _SHIFT_FREE = 0.1, 0.02
"""What the lights as a whole may stretch (logarithm) and shift without a penalty."""


class Neighbours(NamedTuple):
    """Which pixels of a mask lie next to each other.

    Attributes:
        pairs: (E, 2) pixels with a common side.
        cells: (C, 4) pixels of 2x2 squares: above left, above right, below left, below right.
    """

    pairs: Tensor
    cells: Tensor


def find_neighbours(mask: np.ndarray) -> Neighbours:
    """Return the neighbours among the true pixels of a mask (H, W), numbered row by row."""
    number = np.full(mask.shape, -1, np.int64)
    number[mask] = np.arange(mask.sum())
    across = np.stack([number[:, :-1], number[:, 1:]], axis=-1).reshape(-1, 2)
    down = np.stack([number[:-1], number[1:]], axis=-1).reshape(-1, 2)
    squares = np.stack([number[:-1, :-1], number[:-1, 1:], number[1:, :-1], number[1:, 1:]], axis=-1).reshape(-1, 4)
    pairs = np.concatenate([across, down])
    return Neighbours(*(torch.from_numpy(part[(part >= 0).all(axis=1)]) for part in (pairs, squares)))


def measure_roughness(values: Tensor, near: Neighbours) -> Tensor:
    """Return the mean length of the difference between neighbours, of normals (P, 3) or numbers (P,)."""
    if not len(near.pairs):
        return values.new_zeros(())
    gap = values[near.pairs[:, 0]] - values[near.pairs[:, 1]]  # (E, ...)
    return (gap**2).reshape(len(gap), -1).sum(dim=1).add(_ROUND).sqrt().mean()


def measure_curl(normals: Tensor, near: Neighbours, sights: Tensor | None = None) -> Tensor:
    """Return how far normals are from being those of a surface: the mean of |curl of the slopes| n_z^2 over cells.

    Args:
        normals: (P, 3) unit.
        near: Neighbours among the pixels.
        sights: (P, 3) v' of a perspective camera, n . v' taking the place of n_z; None: orthographic.
    """
    if not len(near.cells):
        return normals.new_zeros(())
    facing = normals[:, 2] if sights is None else (normals * sights).sum(dim=1)
    depth = facing.clamp_min(_STEEPEST)
    slopes = -normals[:, :2] / depth[:, None]  # dz/dx, dz/dy
    above_left, above_right, below_left, below_right = slopes[near.cells].unbind(dim=1)
    # Rows run down and y runs up.
    along_y = (above_left + above_right - below_left - below_right)[:, 0] / 2
    along_x = (above_right + below_right - above_left - below_left)[:, 1] / 2
    least = depth[near.cells].amin(dim=1)
    return (((along_y - along_x) * least**2) ** 2 + _ROUND).sqrt().mean()


def measure_drift(directions: Tensor, start: Tensor) -> tuple[Tensor, Tensor]:
    """Return how far the lights (L, 3) as a whole have left the start: their spread, and where they point on average.

    Bas-relief transforms stretch and shift all lights alike, and photographs of a matte object hardly resist them.
    """
    unit_length = normalize(directions, dim=-1)
    ratio = _variance(unit_length) / _variance(start)
    stretch = ((0.5 * ratio.log()).abs() - _STRETCH_FREE).clamp_min(0.0)
    shift = ((unit_length - start).mean(dim=0).norm() - _SHIFT_FREE).clamp_min(0.0)
    return stretch**2, shift**2


def _variance(directions: Tensor) -> Tensor:
    return (directions - directions.mean(dim=0)).pow(2).sum(dim=1).mean().clamp_min(1e-8)
