"""Importance sampling by half vectors: what packed families with a table over theta_h share.

Every material mixes a cosine lobe with a lobe of half vectors, whose distribution over theta_h is tabulated from the
material at the knots of the project's model (`model.half_knots`).
"""

from abc import ABC, abstractmethod
from typing import Any

import numpy as np

from render.backend.arrays import table
from render.backend.jit import dr, mi
from render.materials import highlight, model
from render.materials.model import Material

_KNOTS = model.HALF_KNOTS
_ENTRIES = _KNOTS + 1  # lobe probability, then the cumulative distribution at the knots of theta_h


class HalfVectorLobes(ABC):
    """The part of a packed family that is the same for all with half-vector lobes.

    A family adds `prepare` and `eval_at`. All methods work inside symbolic loops and calls, in the local shading frame
    (z is the normal), with `index` in [0, K).

    Args:
        names: Names of the K materials.
        materials: Materials, or coarse forms of them, that sampling and the share of narrow highlights are read from.

    Attributes:
        names: As given.
        lobes: Flat opaque Float, the sampling tables (see `lobe_distribution`).
        highlight: (K,) float64, share of light in a narrow highlight (see `narrow_share`).
    """

    def __init__(self, names: tuple[str, ...], materials: list[Material]) -> None:
        self.names = names
        self.lobes = table(np.stack([lobe_distribution(material) for material in materials]))
        self.highlight = np.array([narrow_share(material) for material in materials])

    def __len__(self) -> int:
        return len(self.names)

    @staticmethod
    @abstractmethod
    def prepare(wi: "mi.Vector3f", wo: "mi.Vector3f", active: "mi.Bool | bool" = True) -> Any:
        """Return what `eval_at` needs of unit vectors to the camera and to the light."""

    @abstractmethod
    def eval_at(self, index: "mi.UInt32", at: Any) -> "mi.Color3f":
        """Evaluate f cos(theta_o) of the materials `index` at what `prepare` returned."""

    def eval(
        self, index: "mi.UInt32", wi: "mi.Vector3f", wo: "mi.Vector3f", active: "mi.Bool | bool" = True
    ) -> "mi.Color3f":
        """Evaluate f cos(theta_o), zero where either direction is below the horizon.

        Args:
            index: Material numbers.
            wi: Unit vectors to the camera (or the previous vertex).
            wo: Unit vectors to the light, which carries the cosine.
            active: Lanes to evaluate.
        """
        return self.eval_at(index, self.prepare(wi, wo, active))

    def sample_lobe(
        self,
        index: "mi.UInt32",
        wi: "mi.Vector3f",
        sample1: "mi.Float",
        sample2: "mi.Point2f",
        active: "mi.Bool | bool" = True,
    ) -> "mi.Vector3f":
        """Draw `wo` from the material's mixture of a cosine lobe and a tabulated lobe of half vectors.

        Directions drawn below the horizon are returned as they are: `eval` and `pdf` are zero there.

        Args:
            index: Material numbers.
            wi: Unit vectors to the camera.
            sample1: Uniform variate, chooses the lobe.
            sample2: Two uniform variates, choose the direction.
            active: Lanes to sample.
        """
        active = mi.Bool(active)
        start = index * _ENTRIES
        probability = dr.gather(mi.Float, self.lobes, start, active)
        interval = dr.binary_search(
            0, _KNOTS - 2, lambda k: dr.gather(mi.Float, self.lobes, start + 2 + k, active) <= sample2.x
        )
        low = dr.gather(mi.Float, self.lobes, start + 1 + interval, active)
        high = dr.gather(mi.Float, self.lobes, start + 2 + interval, active)
        fraction = dr.clip((sample2.x - low) / dr.maximum(high - low, 1e-12), 0, 1)
        height = dr.lerp(_knot(interval), _knot(interval + 1), fraction)  # 1 - cos(theta_h)
        sine, cosine = dr.sincos(dr.two_pi * sample2.y)
        sin_h = dr.sqrt(dr.maximum(height * (2 - height), 0))
        half = mi.Vector3f(sin_h * cosine, sin_h * sine, 1 - height)
        reflected = dr.normalize(2 * dr.dot(wi, half) * half - wi)
        return dr.select(sample1 < probability, reflected, mi.warp.square_to_cosine_hemisphere(sample2))

    def pdf(
        self, index: "mi.UInt32", wi: "mi.Vector3f", wo: "mi.Vector3f", active: "mi.Bool | bool" = True
    ) -> "mi.Float":
        """Return the density per solid angle with which `sample_lobe` draws `wo`; zero below the horizon."""
        active = mi.Bool(active) & (wi.z > 0) & (wo.z > 0)
        half = dr.normalize(wi + wo)
        interval, _ = half_cell(dr.fma(half.x, half.x, half.y * half.y), half.z)
        start = index * _ENTRIES
        probability = dr.gather(mi.Float, self.lobes, start, active)
        low = dr.gather(mi.Float, self.lobes, start + 1 + interval, active)
        high = dr.gather(mi.Float, self.lobes, start + 2 + interval, active)
        area = dr.two_pi * (_knot(interval + 1) - _knot(interval))
        lobe = (high - low) / (area * 4 * dr.maximum(dr.dot(wi, half), 1e-8))
        return dr.select(active, dr.lerp(wo.z * dr.inv_pi, lobe, probability), 0)


def lobe_distribution(material: Material) -> np.ndarray:
    """Return the (33,) sampling table: probability of the half-vector lobe, then its distribution at the 32 knots.

    The lobe is the luminance of T at small theta_d over its floor at moderate theta_h, constant per solid angle inside
    a cell; its probability is its share of an estimate of the albedo, and zero for a material without a highlight.
    """
    luminance = _profile(material)
    height = model.half_knots()
    floor = luminance[height < 0.5].min()
    excess = np.maximum(luminance - floor, 0)
    mass = (excess[:-1] + excess[1:]) / 2 * (np.diff(height) - np.diff(height**2) / 2)  # over cos(theta_h) d(cos)
    lobe = 8 * np.pi * mass.sum()
    probability = lobe / max(lobe + np.pi * floor, 1e-12)
    if probability < 0.01:
        return np.concatenate([[0.0], np.linspace(0, 1, len(height))])
    return np.concatenate([[min(probability, 0.9)], [0.0], np.cumsum(mass) / mass.sum()])


def narrow_share(material: Material) -> float:
    """Return the share of its light that a narrow highlight reflects (see `highlight.share`)."""
    return highlight.share(np.arccos(1 - model.half_knots()), _profile(material))


def half_cell(sin2_h: "mi.Float", cos_h: "mi.Float") -> tuple:
    """Return the cell and fraction of theta_h; its sine is what float32 keeps exact near zero."""
    root = dr.sqrt(dr.sqrt(dr.minimum(sin2_h / (1 + dr.maximum(cos_h, 0)), 1)))
    return cell(2 * root / (1 + root), _KNOTS)


def cell(coordinate: "mi.Float", knots: int) -> tuple:
    """Return the cell of `coordinate` in [0, 1] among uniform knots, and the fraction inside it."""
    position = dr.clip(coordinate, 0, 1) * (knots - 1)
    index = dr.minimum(mi.UInt32(position), knots - 2)
    return index, position - mi.Float(index)


def _profile(material: Material) -> np.ndarray:
    """Return the luminance of T at small theta_d, (32,) over theta_h."""
    return model.LUMINANCE @ material.bivariate[:, :, :4].mean(2)


def _knot(index: "mi.UInt32") -> "mi.Float":
    """Return 1 - cos(theta_h) at a knot, as `model.half_knots`."""
    x = mi.Float(index) / (_KNOTS - 1)
    root = x / (2 - x)
    return dr.square(dr.square(root))
