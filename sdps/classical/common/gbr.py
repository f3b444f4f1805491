"""The generalised bas-relief ambiguity (Belhumeur, Kriegman & Yuille, IJCV 1999).

What integrability leaves open: surfaces B (P x 3, albedo times normal, one row per pixel) and lights S (3 x L) explain
the images I = B S as well as B G and G^-1 S, with

    G = [1 0 0; 0 1 0; mu nu lambda].
"""

from dataclasses import dataclass

import numpy as np

from render.shared.errors import InputError


@dataclass(frozen=True)
class Gbr:
    """One member of the group.

    Attributes:
        mu: Slant along x.
        nu: Slant along y.
        lam: Depth scale, not 0; negative ones turn convex into concave.

    Raises:
        InputError: parameters that are not finite, or a depth scale of 0.
    """

    mu: float = 0.0
    nu: float = 0.0
    lam: float = 1.0

    def __post_init__(self) -> None:
        if not np.isfinite([self.mu, self.nu, self.lam]).all() or self.lam == 0.0:
            raise InputError(f"a bas-relief transformation needs finite mu, nu and lambda other than 0, got {self}")

    @property
    def matrix(self) -> np.ndarray:
        """G, (3, 3) float64."""
        return np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [self.mu, self.nu, self.lam]])

    @property
    def inverse(self) -> "Gbr":
        """The transformation that undoes this one."""
        return Gbr(-self.mu / self.lam, -self.nu / self.lam, 1.0 / self.lam)

    def then(self, other: "Gbr") -> "Gbr":
        """Return this one followed by `other`: (B G) G'."""
        return Gbr(self.mu + self.lam * other.mu, self.nu + self.lam * other.nu, self.lam * other.lam)

    def surface(self, vectors: np.ndarray) -> np.ndarray:  # (P, 3)
        """Return B G of pseudo-normals B (P, 3)."""
        return vectors @ self.matrix

    def lights(self, vectors: np.ndarray) -> np.ndarray:  # (3, L)
        """Return G^-1 S of pseudo-lights S (3, L)."""
        return self.inverse.matrix @ vectors

    def apply(self, surface: np.ndarray, lights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return (B G, G^-1 S)."""
        return self.surface(surface), self.lights(lights)
