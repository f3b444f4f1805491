"""CNN-PS: a densely connected network from one pixel's observation map to its normal (Ikehata, ECCV 2018).

An observation map is what one pixel showed under each light, laid out by where the light stood (sec. 3). A light's
direction (x, y, z) is projected along the view axis onto a square of 32 x 32 cells that holds the unit disc. The
pixel's grey values, divided by their maximum, go to the cells of their lights. A map neither depends on the number of
lights nor on their order, and since the view is the z axis, turning the lights and the normal about it gives another
valid pixel: training draws such rotations, and the test averages over them.

Legend: N pixels, Q lights.
"""

import math

import torch
from torch import Tensor, nn
from torch.nn import functional

from render.shared.errors import InputError
from sdps.models.base import NormalNetwork

MAP_SIDE = 32
"""w, the side of an observation map in cells."""

_GROWTH = 16
_BLACK = 1e-12
"""A pixel whose maximum is below is black: far under any radiance, yet its inverse's square is a float32."""


class CNNPS(NormalNetwork):
    """Regresses the normal of every pixel from its observation map (`observation_maps`).

    Layers and widths are those of the authors' code: two dense blocks of two convolutions, a transition that halves
    the map between them, two fully connected layers; no batch normalisation. 2,654,051 parameters, of which 2,621,568
    are the first fully connected layer. Weights start as in the authors' framework (Glorot uniform, zero biases).

    Args:
        dropout: Probability of dropping a value behind each convolution of a block, and behind the transition.
    """

    def __init__(self, *, dropout: float = 0.2) -> None:
        super().__init__()
        self.stem = nn.Conv2d(1, _GROWTH, 3, padding=1)  # 32 x 32
        self.first = _DenseBlock(16, dropout)
        self.transition = nn.Sequential(nn.ReLU(), nn.Conv2d(48, 48, 1), nn.Dropout(dropout), nn.AvgPool2d(2))
        self.second = _DenseBlock(48, dropout)  # 16 x 16
        self.last = nn.Sequential(nn.ReLU(), nn.Conv2d(80, 80, 1))
        self.hidden = nn.Linear(80 * (MAP_SIDE // 2) ** 2, 128)
        self.normal = nn.Linear(128, 3)
        for module in self.modules():
            if isinstance(module, nn.Conv2d | nn.Linear):
                nn.init.xavier_uniform_(module.weight)
                assert module.bias is not None
                nn.init.zeros_(module.bias)

    def forward(self, maps: Tensor) -> Tensor:
        """Return unit normals (N, 3), float32, of observation maps (N, 1, 32, 32); N may be 0."""
        assert maps.shape[1:] == (1, MAP_SIDE, MAP_SIDE), maps.shape
        feature = self.transition(self.first(self.stem(maps)))  # (N, 48, 16, 16)
        feature = self.last(self.second(feature))  # (N, 80, 16, 16)
        hidden = functional.relu(self.hidden(feature.flatten(1))).float()  # (N, 128)
        # Never under autocast: a normal rounded to bfloat16's 8 bits moves in steps of a fifth of a degree.
        with torch.autocast(hidden.device.type, enabled=False):
            return functional.normalize(self.normal(hidden), dim=1)


class _DenseBlock(nn.Module):
    """Two convolutions, each of which sees everything before it; adds 32 channels."""

    def __init__(self, inputs: int, dropout: float) -> None:
        super().__init__()
        self.layers = nn.ModuleList(
            nn.Sequential(nn.ReLU(), nn.Conv2d(inputs + added, _GROWTH, 3, padding=1), nn.Dropout(dropout))
            for added in (0, _GROWTH)
        )

    def forward(self, feature: Tensor) -> Tensor:
        for layer in self.layers:
            feature = torch.cat([layer(feature), feature], dim=1)
        return feature


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
