"""Smooth random fields in space as sums of plane waves.

The spectral representation of a Gaussian random field (Shinozuka and Jan 1972): one matrix product and one
sine per point and wave, with exact derivatives, no lattice and so no grid artefacts.
"""

from dataclasses import dataclass, replace

import numpy as np


@dataclass(frozen=True)
class Waves:
    """The field f(p) = sum_k weight_k sin(vector_k . p + phase_k).

    Attributes:
        vectors: Wave vectors in radians per unit length, (K, 3) float32.
        phases: Phases in radians, (K, 1) float32.
        weights: Amplitudes, (C, K) float32: C = 1 for a scalar field, 3 for a vector field.
    """

    vectors: np.ndarray
    phases: np.ndarray
    weights: np.ndarray

    def __call__(self, points: np.ndarray) -> np.ndarray:
        """Evaluate at `points` (3, N); returns (N,) for a scalar field and (3, N) for a vector field."""
        values = self.weights @ np.sin(self.vectors @ points + self.phases)
        return values[0] if len(self.weights) == 1 else values

    def with_derivatives(self, points: np.ndarray, tangents: list[np.ndarray]) -> tuple[np.ndarray, list[np.ndarray]]:
        """Evaluate at `points` (3, N), with the derivative along each of `tangents` (3, N), as (C, N) arrays."""
        angles = self.vectors @ points + self.phases  # (K, N)
        cosines = np.cos(angles)
        return self.weights @ np.sin(angles), [self.weights @ (cosines * (self.vectors @ way)) for way in tangents]

    def stretch(self, direction: np.ndarray, factor: float) -> "Waves":
        """Turn lumps into ridges along the unit vector `direction`: wave vectors lean away from it by `factor`.

        Wave numbers stay, and with them the spacing across the ridges.
        """
        direction = np.asarray(direction, dtype=np.float32)
        along = (self.vectors @ direction)[:, None] * direction  # (K, 3)
        leaning = self.vectors - np.float32(1 - 1 / factor) * along
        keep = np.linalg.norm(self.vectors, axis=1) / np.linalg.norm(leaning, axis=1)
        return replace(self, vectors=leaning * keep[:, None])


def scalar_waves(rng: np.random.Generator, low: float, high: float, count: int = 24, slope: float = 1.0) -> Waves:
    """Draw a scalar field of unit variance.

    Args:
        rng: Source of randomness.
        low: Smallest wave number in radians per unit length.
        high: Largest wave number; wave numbers are log-uniform in between.
        count: Number of waves K.
        slope: Amplitudes fall off as wave number to the power of `-slope`.
    """
    vectors, phases, numbers = _draw(rng, low, high, count)
    weights = numbers**-slope
    weights = weights / np.sqrt((weights**2).sum() / 2)
    return Waves(vectors, phases, weights[None].astype(np.float32))


def vector_waves(rng: np.random.Generator, low: float, high: float, count: int = 16, slope: float = 1.0) -> Waves:
    """Draw a divergence-free vector field of unit mean square length (each amplitude is normal to its wave vector)."""
    vectors, phases, numbers = _draw(rng, low, high, count)
    amplitudes = np.cross(rng.normal(size=(count, 3)), vectors)
    amplitudes *= (numbers**-slope / np.linalg.norm(amplitudes, axis=1))[:, None]
    amplitudes /= np.sqrt((amplitudes**2).sum() / 2)
    return Waves(vectors, phases, np.ascontiguousarray(amplitudes.T, dtype=np.float32))


def _draw(rng: np.random.Generator, low: float, high: float, count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Draw wave vectors (K, 3), phases (K, 1) and wave numbers (K,), isotropic in direction."""
    # Stratified wave numbers: a handful of waves must not all land at one end of the band.
    numbers = low * (high / low) ** ((np.arange(count) + rng.random(count)) / count)
    directions = rng.normal(size=(count, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    vectors = (directions * numbers[:, None]).astype(np.float32)
    return vectors, rng.uniform(0, 2 * np.pi, (count, 1)).astype(np.float32), numbers
