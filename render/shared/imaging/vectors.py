"""Vectors as numpy arrays whose last axis is x, y, z."""

import numpy as np


def unit(vectors: np.ndarray) -> np.ndarray:
    """Return vectors (..., 3) at length 1, of the same type; a zero vector stays zero."""
    return vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-12)


def half_vectors(lights: np.ndarray) -> np.ndarray:
    """Return the unit half vectors (..., 3) of unit directions (..., 3) and a camera along +z."""
    return unit(lights + np.array([0.0, 0.0, 1.0]))


def spiral(count: int, lowest: float = -1.0) -> np.ndarray:
    """Return directions (count, 3) evenly spread in solid angle from +z down to z = `lowest`.

    A spiral of equal steps in z and golden angles (Vogel 1979; Swinbank & Purser 2006).
    """
    z = 1.0 - (1.0 - lowest) * (np.arange(count) + 0.5) / count
    angle, flat = np.arange(count) * np.pi * (3.0 - np.sqrt(5.0)), np.sqrt(1.0 - z * z)
    return np.stack([flat * np.cos(angle), flat * np.sin(angle), z], axis=-1)
