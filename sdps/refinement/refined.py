"""What refinement finds."""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, kw_only=True, eq=False)
class Refined:
    """What refinement found; frame: x right, y up, z to the camera.

    Attributes:
        normals: (H, W, 3) float32 unit, zero outside the mask.
        light_directions: (L, 3) float32 unit, from the surface to the light.
        intensities: (L, 3) float32, mean 1.
        albedo: (H, W, 3) float32, zero outside the mask, up to a common factor.
        strength: (H, W) float32, of the highlights, zero outside the mask.
        body: (4,) numbers b of the body (`sdps.refinement.reflectance`); 0 is Lambertian.
        amplitudes: (K,) of the lobes.
        sharpness: (K,) of the lobes.
        modes: (M,) numbers m of the modes; 0 adds nothing.
        nearness: (L,) float32, rho of the lamps (`sdps.core.geometry`); 0 where they are taken for distant.
        pixel_residual: (H, W) float32, mean robust difference, zero outside the mask.
        image_residual: (L,) float32, the same of each image.
    """

    normals: np.ndarray
    light_directions: np.ndarray
    intensities: np.ndarray
    albedo: np.ndarray
    strength: np.ndarray
    body: np.ndarray
    amplitudes: np.ndarray
    sharpness: np.ndarray
    modes: np.ndarray
    nearness: np.ndarray
    pixel_residual: np.ndarray
    image_residual: np.ndarray

    @property
    def grey_intensities(self) -> np.ndarray:
        """Intensities (L,): channels weighted by how much of them the object reflects, since dark ones tell little."""
        weights = self.albedo.reshape(-1, 3).sum(axis=0, dtype=np.float64)
        return (self.intensities @ (weights / weights.sum())).astype(np.float32)
