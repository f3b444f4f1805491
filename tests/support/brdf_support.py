"""Pairs of directions for the tests of packed BRDFs."""

import numpy as np

from render.backend.jit import mi


def directions(count: int = 4000) -> tuple[np.ndarray, np.ndarray]:
    """Return pairs of float32 directions, half of them within a degree of mirror reflection, some below the horizon."""
    rng = np.random.default_rng(11)
    wi, wo = rng.normal(size=(2, count, 3))
    wi[:, 2] = np.abs(wi[:, 2])
    wi /= np.linalg.norm(wi, axis=1, keepdims=True)
    near = np.arange(count) % 2 == 0
    wo[near] = wi[near] * [-1, -1, 1] + rng.normal(scale=0.01, size=(near.sum(), 3))
    wo /= np.linalg.norm(wo, axis=1, keepdims=True)
    return wi.astype(np.float32), wo.astype(np.float32)


def vector(values: np.ndarray) -> "mi.Vector3f":
    return mi.Vector3f(np.ascontiguousarray(values.T))
