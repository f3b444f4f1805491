"""The network that joins two normals of every pixel into one, and tells the error to expect of it.

It sees what either witness says of itself and of the object, and what surrounds a pixel under both: where they agree,
which of them is integrable, where images are dark. Its answer is a mean of the two normals, weighted pixel by pixel,
moved to the side by less than they are apart: where both agree, nothing is changed. It begins as their plain mean.

Legend: B objects, H and W the sides of their boxes, multiples of 8.
"""

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from sdps.core.metrics import angle_degrees
from sdps.core.symmetry import Symmetry
from sdps.methods.fusion.evidence import Evidence
from sdps.models.blocks import LOG_USUAL, SLOPE, conv, deconv

MULTIPLE = 8
_MAPS, _NUMBERS = 20, 9
REACH = 96
"""Pixels around a pixel that its answer depends on, at most."""
_STILL, _FAINT, _DARK, _MATT = 0.3, 0.003, 0.03, 0.1  # added to degrees, residuals, albedo, gloss before the logarithm
_MOST = 90.0
_BESIDE = 0.5
"""How far the answer may lie beside both normals, as a share of what lies between them."""
_USUAL_DEGREES, _USUAL_RESIDUAL, _USUAL_IMAGES = 3.3, 0.03, 32.0  # inputs of such are 0


class Joined(NamedTuple):
    """The answer."""

    normals: Tensor  # (B, 3, H, W) float32 unit
    expected: Tensor  # (B, 1, H, W) distance to the true normals


class Inputs(NamedTuple):
    """Evidence as the network takes it."""

    network: Tensor  # (B, 3, H, W) normals
    refined: Tensor  # (B, 3, H, W)
    start: Tensor  # (B, 3, H, W)
    maps: Tensor  # (B, 11, H, W), what does not turn with the object; the last one is the mask
    numbers: Tensor  # (B, 9) of the object

    def turn(self, symmetry: Symmetry) -> "Inputs":
        """Return what the turned object would have shown."""
        network, refined, start = (symmetry.vectors(symmetry.images(each), dim=1) for each in self[:3])
        return Inputs(network, refined, start, symmetry.images(self.maps), self.numbers)


class Block(nn.Module):
    """Two convolutions beside what they are given."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.first, self.second = conv(width, width), nn.Conv2d(width, width, 3, padding=1)

    def forward(self, features: Tensor) -> Tensor:
        """Return features (B, C, H, W)."""
        return features + functional.leaky_relu(self.second(self.first(features)), SLOPE)


class FusionNet(nn.Module):
    """Weights two normals of every pixel.

    Args:
        width: Channels of a pixel.
    """

    WIDTH = 24

    def __init__(self, *, width: int = WIDTH) -> None:
        super().__init__()
        wide = 2 * width
        self.enter = nn.Conv2d(_MAPS, width, 1)
        self.told = nn.Linear(_NUMBERS, width)
        self.near = Block(width)
        self.smaller = nn.Sequential(conv(width, wide, stride=2), Block(wide))
        self.quarter = nn.Sequential(conv(wide, wide, stride=2), Block(wide))
        self.far = nn.Sequential(conv(wide, wide, stride=2), Block(wide), deconv(wide, wide))
        self.back = nn.Sequential(conv(2 * wide, wide), deconv(wide, wide))
        self.leave = nn.Sequential(conv(2 * wide, wide), deconv(wide, width))
        last = nn.Conv2d(width, 5, 1)
        self.out = nn.Sequential(conv(2 * width, width, kernel=1), conv(width, width, kernel=1), last)
        for parameter in last.parameters():  # the plain mean
            nn.init.zeros_(parameter)

    def forward(self, given: Inputs) -> Joined:
        """Return the joined normals and the distance to the true ones to expect."""
        mask = given.maps[:, -1:]
        seen = self.enter(torch.cat(given[:4], dim=1)) + self.told(given.numbers)[..., None, None]
        near = self.near(functional.leaky_relu(seen * mask, SLOPE))
        half = self.smaller(near)
        quarter = self.quarter(half)
        back = self.back(torch.cat([self.far(quarter), quarter], dim=1))
        found = self.out(torch.cat([self.leave(torch.cat([back, half], dim=1)), near], dim=1))
        share = torch.sigmoid(found[:, :1])
        mean = share * given.refined + (1.0 - share) * given.network
        apart = (given.refined - given.network).norm(dim=1, keepdim=True)
        normals = functional.normalize(mean + _BESIDE * apart * found[:, 1:4].tanh(), dim=1)
        return Joined(normals * mask, (found[:, 4:] + LOG_USUAL).exp())


def prepare(evidence: Evidence) -> Inputs:
    """Return evidence as the network takes it, B = 1, padded right and below."""
    return prepare_part(evidence, describe(evidence))


def prepare_part(own: Evidence, numbers: Tensor) -> Inputs:
    """Return the evidence of a part of an object as the network takes it, with the numbers (1, 9) of the whole."""
    inside, residual = own.mask, _log_residual(own.residual)
    maps = [
        *(_log_degrees(each) for each in (own.told, own.told_first, own.expected,
                                          angle_degrees(own.network, own.refined),
                                          angle_degrees(own.start, own.network))),
        residual, residual - float(numbers[0, 0]),
        np.log(own.albedo + _DARK), np.log(own.gloss + _MATT), own.used,
    ]  # fmt: skip
    stacked = np.stack([np.where(inside, each, 0.0) for each in maps] + [inside.astype(np.float32)])
    pictures = [each.transpose(2, 0, 1) for each in (own.network, own.refined, own.start)]
    padding = [(0, 0), *((0, -side % MULTIPLE) for side in inside.shape)]
    network, refined, start, rest = (
        torch.from_numpy(np.pad(each, padding).astype(np.float32))[None] for each in (*pictures, stacked)
    )
    return Inputs(network, refined, start, rest, numbers)


def describe(evidence: Evidence) -> Tensor:
    """Return what the network is given of the whole object, (1, 9); the misfit comes first."""
    inside, (images, spread, nearness, turned, lit) = evidence.mask, evidence.numbers
    moved = angle_degrees(evidence.network[inside], evidence.refined[inside])
    told = [_log_degrees(each).mean() for each in (evidence.told[inside], evidence.expected[inside], moved)]
    misfit = _log_residual(evidence.residual[inside].mean())
    numbers = [misfit, np.log(images / _USUAL_IMAGES), spread, 5.0 * nearness, _log_degrees(turned), lit, *told]
    return torch.from_numpy(np.array(numbers, np.float32))[None]


def _log_residual(residual: np.ndarray | float) -> np.ndarray:
    return np.log((residual + _FAINT) / _USUAL_RESIDUAL)


def _log_degrees(degrees: np.ndarray | float) -> np.ndarray:
    """Return degrees so that 3 of them are 0, and twice as many always make about the same difference."""
    return np.log((np.minimum(degrees, _MOST) + _STILL) / _USUAL_DEGREES)
