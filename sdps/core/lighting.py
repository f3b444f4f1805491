"""Light directions and intensities as classes (SDPS-Net, sec. 4.1), and back.

Azimuth and elevation are measured about the vertical axis, as in the paper's supplement and code:
azimuth is the angle of (x, z) from +z towards +x, elevation the angle above the horizontal plane,
both in (-90, 90) degrees for a light in front of the object. (The paper's phi is 90 - azimuth.)

Every function takes numpy arrays or torch tensors and returns the same kind.
"""

from dataclasses import dataclass
from types import ModuleType
from typing import Literal, TypeVar

import numpy as np
import torch

from render.shared.errors import InputError

Array = TypeVar("Array", np.ndarray, torch.Tensor)
ReadOut = Literal["centre", "expectation", "peak"]


def library(array: Array) -> ModuleType:
    """Return the module (numpy or torch) that computes on `array`; the names used here exist in both."""
    return torch if isinstance(array, torch.Tensor) else np


def azimuth_elevation(directions: Array) -> tuple[Array, Array]:
    """Return azimuth and elevation in degrees, each (...), of directions (..., 3) of any length."""
    xp = library(directions)
    x, y, z = directions[..., 0], directions[..., 1], directions[..., 2]
    return xp.rad2deg(xp.arctan2(x, z)), xp.rad2deg(xp.arctan2(y, xp.hypot(x, z)))


def harmonics(vectors: Array) -> Array:
    """Return the real spherical harmonics up to order two, (..., 9), at unit vectors (..., 3), of mean square 1.

    Order: 1; y, z, x; xy, yz, 3 z^2 - 1, xz, x^2 - y^2.
    """
    xp = library(vectors)
    x, y, z = vectors[..., 0], vectors[..., 1], vectors[..., 2]
    first, second = 3.0**0.5, 15.0**0.5
    low = xp.stack([x * 0.0 + 1.0, first * y, first * z, first * x], axis=-1)
    squares = 5.0**0.5 / 2 * (3.0 * z * z - 1.0), second / 2 * (x * x - y * y)
    high = xp.stack([second * x * y, second * y * z, squares[0], second * x * z, squares[1]], axis=-1)
    return xp.concatenate([low, high], axis=-1)


IRRADIANCE = (1.0, *(2.0 / 3.0,) * 3, *(1.0 / 4.0,) * 5)
"""Of each harmonic of light, what a Lambertian surface shows of it (Ramamoorthi & Hanrahan, SIGGRAPH 2001, eq. 8, over
pi): under light of harmonics L a normal n sees the irradiance sum(IRRADIANCE * L * harmonics(n)) / 4 of a lamp's."""


def unit_direction(azimuth: Array, elevation: Array) -> Array:
    """Return unit directions (..., 3) of azimuth and elevation in degrees, each (...)."""
    xp = library(azimuth)
    azimuth, elevation = xp.deg2rad(azimuth), xp.deg2rad(elevation)
    horizontal = xp.cos(elevation)
    return xp.stack([horizontal * xp.sin(azimuth), xp.sin(elevation), horizontal * xp.cos(azimuth)], axis=-1)


def bin_index(values: Array, low: float, high: float, count: int) -> Array:
    """Return the index (int64) of the bin, of `count` equal ones over [low, high), that holds each value.

    A value outside the range takes the nearest bin.
    """
    xp = library(values)
    index = xp.clip(xp.floor((values - low) / (high - low) * count), 0, count - 1)
    return index.long() if xp is torch else index.astype(np.int64)


def bin_centre(index: Array, low: float, high: float, count: int) -> Array:
    """Return the centre of each bin named by `index`, as float32."""
    index = index.float() if isinstance(index, torch.Tensor) else np.asarray(index, np.float32)
    return (index + 0.5) / count * (high - low) + low


@dataclass(frozen=True, kw_only=True)
class LightClasses:
    """The discretised lighting space.

    Attributes:
        directions: K_d, number of azimuth classes and of elevation classes (36: 5 degrees each).
        intensities: K_e, number of intensity classes.
        low, high: Range of relative intensities that the classes cover.
    """

    directions: int = 36
    intensities: int = 20
    low: float = 0.2
    high: float = 2.0

    def __post_init__(self) -> None:
        if self.directions < 2 or self.intensities < 2:
            raise InputError(f"light classes: need at least 2 of each, got {self.directions} and {self.intensities}")
        if not 0.0 < self.low < self.high:
            raise InputError(f"light classes: intensities need 0 < low < high, got {self.low} and {self.high}")

    def encode(self, directions: Array, intensities: Array) -> tuple[Array, Array, Array]:
        """Return azimuth, elevation and intensity classes, each (...) int64, of (..., 3) and (...)."""
        azimuth, elevation = azimuth_elevation(directions)
        angles, _, strengths = self._spans()
        return bin_index(azimuth, *angles), bin_index(elevation, *angles), bin_index(intensities, *strengths)

    def encode_soft(
        self, directions: torch.Tensor, intensities: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Return class probabilities (..., K) whose expectation is the exact azimuth, elevation and intensity.

        Each value shares its weight between the two nearest class centres; beyond the outermost centre it has one.

        Args:
            directions: (..., 3), of any length.
            intensities: (...).
        """
        values = (*azimuth_elevation(directions), intensities)
        azimuth, elevation, intensity = (
            _share_weights(part, *span) for part, span in zip(values, self._spans(), strict=True)
        )
        return azimuth, elevation, intensity

    def _spans(self) -> tuple[tuple[float, float, int], ...]:
        """Return low, high and count of the bins of azimuth, elevation and intensity."""
        angles = (-90.0, 90.0, self.directions)
        return angles, angles, (self.low, self.high, self.intensities)

    def decode(self, azimuth: Array, elevation: Array, intensity: Array) -> tuple[Array, Array]:
        """Return the unit direction (..., 3) and intensity (...) at the centre of each class."""
        pairs = zip((azimuth, elevation, intensity), self._spans(), strict=True)
        azimuth, elevation, intensity = (bin_centre(part, *span) for part, span in pairs)
        return unit_direction(azimuth, elevation), intensity

    def read_out(
        self,
        azimuth: torch.Tensor,  # (..., K_d)
        elevation: torch.Tensor,  # (..., K_d)
        intensity: torch.Tensor,  # (..., K_e)
        how: ReadOut = "centre",
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Turn class logits into unit directions (..., 3) and intensities (...), float32.

        `centre` (argmax) is the paper's, the middle of the most probable class; `expectation` (soft-argmax) the mean
        over the softmax, which has no quantisation floor; `peak` (parabolic) the top of the parabola through the
        log-probabilities of the most probable class and its two neighbours.
        """
        logits = [values.float() for values in (azimuth, elevation, intensity)]
        if how == "centre":
            return self.decode(*(values.argmax(-1) for values in logits))
        read = _expectation if how == "expectation" else _peak
        pairs = zip(logits, self._spans(), strict=True)
        azimuth, elevation, intensity = (read(values, *span) for values, span in pairs)
        return unit_direction(azimuth, elevation), intensity


def _share_weights(values: torch.Tensor, low: float, high: float, count: int) -> torch.Tensor:
    """Return (..., K) weights of the bin centres around each of values (...)."""
    position = ((values - low) / (high - low) * count - 0.5).clamp(0.0, count - 1.0)
    centres = torch.arange(count, device=values.device, dtype=position.dtype)
    return (1.0 - (position[..., None] - centres).abs()).clamp(min=0.0)


def _expectation(logits: torch.Tensor, low: float, high: float, count: int) -> torch.Tensor:
    """Return the mean bin centre (...) under the softmax of logits (..., K)."""
    centres = bin_centre(torch.arange(count, device=logits.device), low, high, count)
    # Not a matrix product: autocast would round that to bfloat16, whose steps near 80 are half a degree.
    return (logits.softmax(-1) * centres).sum(-1)


def _peak(logits: torch.Tensor, low: float, high: float, count: int) -> torch.Tensor:
    """Return the top (...) of the parabola through the largest of logits (..., K) and its neighbours."""
    best = logits.argmax(-1, keepdim=True)
    inner = best.clamp(1, count - 2)
    left, middle, right = (logits.gather(-1, inner + step).squeeze(-1) for step in (-1, 0, 1))
    best, curvature = best.squeeze(-1), 2.0 * middle - left - right
    # At the border, and on a plateau, there is no parabola with a top: the class centre stays.
    usable = (best == inner.squeeze(-1)) & (curvature > 1e-6)
    offset = torch.where(usable, 0.5 * (right - left) / curvature.clamp(min=1e-6), torch.zeros_like(middle))
    return bin_centre(best + offset.clamp(-0.5, 0.5), low, high, count)
