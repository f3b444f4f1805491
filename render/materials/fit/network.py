"""Evaluating the Neural-BRDF networks (Sztrajman et al. 2021), the data that the library is fitted to.

Six inputs (the half vector at azimuth zero and the difference vector, both of Rusinkiewicz 1998), two hidden layers of
21 rectified units, three outputs y with f = max(exp(y) - 1, 0), the linear RGB BRDF in 1/sr without the cosine.
"""

from collections.abc import Callable
from pathlib import Path

import numpy as np

from render.shared.errors import InputError, unknown

Brdf = Callable[[np.ndarray, np.ndarray], np.ndarray]
_LAYERS = (("fc1", (6, 21)), ("b1", (21,)), ("fc2", (21, 21)), ("b2", (21,)), ("fc3", (21, 3)), ("b3", (3,)))


def half_difference(wi: np.ndarray, wo: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the half vector turned to azimuth zero and the difference vector, each (N, 3), of unit (N, 3) vectors."""
    half = wi + wo
    half = half / np.linalg.norm(half, axis=1, keepdims=True)
    sine, cosine = np.hypot(half[:, 0], half[:, 1]), half[:, 2]
    azimuth = np.arctan2(half[:, 1], half[:, 0])
    turned_x = np.cos(azimuth) * wi[:, 0] + np.sin(azimuth) * wi[:, 1]
    turned_y = np.cos(azimuth) * wi[:, 1] - np.sin(azimuth) * wi[:, 0]
    difference = np.stack([cosine * turned_x - sine * wi[:, 2], turned_y, sine * turned_x + cosine * wi[:, 2]], 1)
    return np.stack([sine, np.zeros_like(sine), cosine], 1), difference


class NetworkFile:
    """The weights of many networks in one `.npz`, keys `<database>__<name>__<layer>`.

    Args:
        path: The file.
        database: Prefix to read, `merl` for the MERL materials.

    Raises:
        InputError: not an npz file, no network of this database, or a layer missing or of the wrong shape.
    """

    def __init__(self, path: str | Path, database: str = "merl") -> None:
        try:
            with np.load(path) as archive:
                self._weights = {key: archive[key] for key in archive if key.startswith(f"{database}__")}
        except (OSError, ValueError) as error:
            raise InputError(f"{path}: cannot be read as a .npz of network weights ({error})") from error
        self._prefix, self.names = database, sorted({key.split("__")[1] for key in self._weights})
        if not self.names:
            raise InputError(f"{path}: holds no network named {database}__<name>__fc1")
        for name in self.names:
            for layer, shape in _LAYERS:
                found = self._weights.get(f"{database}__{name}__{layer}")
                if found is None or found.shape != shape:
                    raise InputError(f"{path}: layer {database}__{name}__{layer} of shape {shape} is missing")

    def brdf(self, name: str) -> Brdf:
        """Return a function of (N, 3) `wi`, `wo` giving the (N, 3) BRDF, averaged over exchanging them.

        The networks are only nearly reciprocal; exchanging the vectors negates the difference vector's tangential part.

        Raises:
            InputError: no such network.
        """
        if name not in self.names:
            raise unknown("material", name, self.names)
        fc1, b1, fc2, b2, fc3, b3 = (
            self._weights[f"{self._prefix}__{name}__{layer}"].astype(np.float64) for layer, _ in _LAYERS
        )

        def evaluate(wi: np.ndarray, wo: np.ndarray) -> np.ndarray:
            half, difference = half_difference(wi, wo)
            total = np.zeros((len(half), 3))
            for exchange in (np.array([1, 1, 1]), np.array([-1, -1, 1])):
                hidden = np.maximum(np.hstack([half, difference * exchange]) @ fc1 + b1, 0)
                hidden = np.maximum(hidden @ fc2 + b2, 0)
                total += np.maximum(np.expm1(hidden @ fc3 + b3), 0)
            return total / 2

        return evaluate
