"""Analytic scenes for the classical methods: smooth surfaces, isotropic reflectance, no renderer."""

from dataclasses import dataclass

import numpy as np
from sdps_scenes import hemisphere_lights, sphere_normals

from sdps.core.estimate import Estimate
from sdps.core.metrics import direction_mae, intensity_error, normal_mae


@dataclass(frozen=True, eq=False)
class Scene:
    """Images with their truth.

    Attributes:
        images: (L, H, W, 3) float32.
        mask: (H, W) bool.
        normals: (H, W, 3) float32, zero outside the mask.
        lights: (L, 3) float32.
        intensities: (L,) float64.
    """

    images: np.ndarray
    mask: np.ndarray
    normals: np.ndarray
    lights: np.ndarray
    intensities: np.ndarray

    def errors(self, estimate: Estimate) -> tuple[float, float, float]:
        """Return normal MAE and direction MAE in degrees, and the intensity error."""
        return (
            normal_mae(estimate.normals, self.normals, self.mask),
            direction_mae(estimate.light_directions, self.lights),
            intensity_error(estimate.intensities, self.intensities),
        )


def hills(size: int = 96) -> tuple[np.ndarray, np.ndarray]:
    """Return normals (S, S, 3) float32 and mask (S, S) of a smooth asymmetric hill on a disc; analytic slopes."""
    axis = (np.arange(size) + 0.5) / size * 2.0 - 1.0
    x, y = np.meshgrid(axis, -axis)
    bump = 0.35 * np.exp(-((x - 0.2) ** 2 + y**2) / 0.15)
    slope_x = bump * -2.0 * (x - 0.2) / 0.15 - 0.5 * np.sin(2.0 * x + 1.0) * np.sin(2.5 * y) - x
    slope_y = bump * -2.0 * y / 0.15 + 0.625 * np.cos(2.0 * x + 1.0) * np.cos(2.5 * y) - y
    normals = np.stack([-slope_x, -slope_y, np.ones_like(x)], axis=-1)
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    mask = x**2 + y**2 < 0.8
    return (normals * mask[..., None]).astype(np.float32), mask


def patches(mask: np.ndarray, count: int, rng: np.random.Generator) -> np.ndarray:  # (H, W, 3)
    """Return an albedo map of `count` random colours in irregular patches (Voronoi cells)."""
    rows, columns = np.nonzero(mask)
    seeds = rng.choice(len(rows), 3 * count, replace=False)
    grid = np.stack(np.indices(mask.shape), axis=-1)
    distance = ((grid[:, :, None] - np.stack([rows[seeds], columns[seeds]], axis=-1)) ** 2).sum(-1)
    return rng.uniform(0.2, 1.0, (count, 3))[distance.argmin(-1) % count]


def lambertian(
    normals: np.ndarray,
    mask: np.ndarray,
    lights: np.ndarray,
    *,
    albedo: np.ndarray | float = 0.7,
    intensities: np.ndarray | None = None,
    shadows: bool = True,
) -> Scene:
    """Shade by Lambert's law; without `shadows`, negative shading stays, so that the images are exactly of rank 3."""
    gains = np.ones(len(lights)) if intensities is None else np.asarray(intensities)
    shading = np.einsum("hwc,lc->lhw", normals.astype(np.float64), lights)
    shading = np.maximum(shading, 0.0) if shadows else shading
    images = shading[..., None] * gains[:, None, None, None] * np.broadcast_to(albedo, (*mask.shape, 3))
    return Scene(images * mask[..., None], mask, normals, lights, gains)


def glossy(
    normals: np.ndarray,
    mask: np.ndarray,
    lights: np.ndarray,
    *,
    diffuse: float = 0.4,
    specular: float = 0.5,
    roughness: float = 0.2,
    intensities: np.ndarray | None = None,
) -> Scene:
    """Shade with a diffuse part and a Beckmann lobe of the half vector, seen along z; no cast shadows."""
    gains = np.ones(len(lights)) if intensities is None else np.asarray(intensities)
    view = np.array([0.0, 0.0, 1.0])
    half = lights + view
    half /= np.linalg.norm(half, axis=-1, keepdims=True)
    cos_light = np.maximum(np.einsum("hwc,lc->lhw", normals, lights), 0.0)
    cos_half = np.clip(np.einsum("hwc,lc->lhw", normals, half), 1e-3, 1.0)
    lobe = np.exp((1.0 - cos_half**-2) / roughness**2) / (roughness**2 * cos_half**4)
    images = cos_light * (diffuse + specular * lobe / 4.0) * gains[:, None, None]
    return Scene((np.repeat(images[..., None], 3, axis=-1) * mask[..., None]), mask, normals, lights, gains)


def glossy_shape(name: str, size: int, count: int, *, uneven: bool = False, **options: float) -> Scene:
    """Return a glossy `sphere` or `hills` under `count` lights, of intensities from 0.2 to 2 if `uneven`."""
    normals, mask = sphere(size) if name == "sphere" else hills(size)
    gains = np.random.default_rng([3, 1]).uniform(0.2, 2.0, count) if uneven else None
    return glossy(normals, mask, lights(count, 3), intensities=gains, **options)


def sphere(size: int = 96) -> tuple[np.ndarray, np.ndarray]:
    """Return normals and mask of a sphere."""
    return sphere_normals(size, 0.9)


def lights(count: int, seed: int = 0, lowest: float = 0.3) -> np.ndarray:  # (count, 3)
    """Return random directions with z above `lowest`."""
    return hemisphere_lights(count, np.random.default_rng(seed), lowest)
