"""Directions as a rendered sphere samples them: the metric of a fit, and the samples to fit.

The metric is the relative RMS error of the direct light of a sphere under an orthographic camera at +z and directional
lights on the upper hemisphere, all lights together, with radiance clipped at the 99.5th percentile of the reference.
"""

from dataclasses import dataclass

import numpy as np

from render.materials.model import half_knots
from render.shared.imaging.vectors import half_vectors

CLIP_PERCENTILE = 99.5
_VIEW = np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True)
class Samples:
    """Pairs of directions in the shading frame.

    Attributes:
        wi: (N, 3) unit vectors to the light.
        wo: (N, 3) unit vectors to the camera.
        weight: (N,) how much area of sphere image, over uniformly spread lights, a pair stands for.
    """

    wi: np.ndarray
    wo: np.ndarray
    weight: np.ndarray


def hemisphere_lights(count: int, rng: np.random.Generator) -> np.ndarray:
    """Return (count, 3) directions spread evenly over the hemisphere about +z, jittered by `rng`."""
    height = (np.arange(count) + rng.random(count)) / count
    azimuth = 2 * np.pi * (np.arange(count) * (np.sqrt(5) - 1) / 2 + rng.random())
    radius = np.sqrt(1 - height**2)
    return np.stack([radius * np.cos(azimuth), radius * np.sin(azimuth), height], 1)


def sphere_normals(resolution: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the (resolution, resolution) mask of a sphere that fills the image, and its (N, 3) normals."""
    centres = (2 * np.arange(resolution) + 1) / resolution - 1
    x, y = np.meshgrid(centres, -centres)
    mask = x**2 + y**2 < 1
    return mask, np.stack([x[mask], y[mask], np.sqrt(1 - x[mask] ** 2 - y[mask] ** 2)], 1)


def shading_frame(normals: np.ndarray, lights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return light and view direction, each (N, 3), in the frame of each normal (isotropic: any tangent does)."""
    helper = np.where(np.abs(normals[:, 2:3]) < 0.9, _VIEW, np.array([1.0, 0.0, 0.0]))
    tangent = np.cross(helper, normals)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    axes = np.stack([tangent, np.cross(normals, tangent), normals], 1)  # (N, 3, 3)
    return np.einsum("nij,nj->ni", axes, np.broadcast_to(lights, normals.shape)), axes[:, :, 2]


def sphere_image(resolution: int, lights: np.ndarray) -> Samples:
    """Return the lit pixels of a sphere under each of the (L, 3) `lights`, one after the other."""
    _, normals = sphere_normals(resolution)
    pairs = [shading_frame(normals, light) for light in lights]
    wi, wo = (np.concatenate(side) for side in zip(*pairs, strict=True))
    lit = wi[:, 2] > 0
    return Samples(wi[lit], wo[lit], np.ones(lit.sum()))


def sphere_error(fit: np.ndarray, reference: np.ndarray, samples: Samples) -> float:
    """Return rms(fit - reference) / rms(reference) of radiance, both clipped at the reference's 99.5th percentile.

    Args:
        fit: (N, 3) BRDF at the samples.
        reference: (N, 3) BRDF at the samples.
        samples: From `sphere_image`.
    """
    cosine = samples.wi[:, 2:3]
    limit = np.percentile(reference * cosine, CLIP_PERCENTILE)
    target = np.minimum(reference * cosine, limit)
    return float(np.sqrt(((np.minimum(fit * cosine, limit) - target) ** 2).sum() / (target**2).sum()))


def radiance_limit(brdf: np.ndarray, samples: Samples) -> float:
    """Return the clipping level of `sphere_error` estimated from weighted samples; brdf is (N, 3)."""
    radiance = (brdf * samples.wi[:, 2:3]).ravel()
    order = np.argsort(radiance)
    mass = np.cumsum(np.repeat(samples.weight, 3)[order])
    return float(radiance[order][np.searchsorted(mass, CLIP_PERCENTILE / 100 * mass[-1])])


def fitting_samples(count: int, rng: np.random.Generator) -> Samples:
    """Draw pairs for a fit: four in five as the pixels of spheres under lights from above, the others from everywhere.

    A sphere lit from its viewer's side has theta_d < 45 degrees; the fifth with both directions anywhere above the
    horizon, at a total weight of a seventh, ties down what only other shapes and interreflections meet.
    """
    above, everywhere = _sphere_pairs(count * 4 // 5, rng), _hemisphere_pairs(count // 5, rng)
    factor = 0.15 * above.weight.sum() / everywhere.weight.sum()
    wi, wo = (np.concatenate([getattr(above, side), getattr(everywhere, side)]) for side in ("wi", "wo"))
    weight = np.concatenate([above.weight, factor * everywhere.weight])
    keep = (wi[:, 2] > 1e-3) & (wo[:, 2] > 1e-3)
    return Samples(wi[keep], wo[keep], weight[keep])


def _sphere_pairs(count: int, rng: np.random.Generator) -> Samples:
    """Draw lights over the upper hemisphere; half of the normals as pixels are, half by theta_h about the half vector.

    The halves are weighted by the balance heuristic (Veach & Guibas 1995): a sum over the samples is a sum over images,
    with enough samples inside a peak that covers a few pixels.
    """
    lights = hemisphere_lights(count, rng)
    half = half_vectors(lights)
    normals = np.where((np.arange(count) % 2 == 0)[:, None], _disk(count, rng), _about(half, rng))
    wi, wo = shading_frame(normals, lights)
    pixel = np.maximum(normals[:, 2], 0) / np.pi
    return Samples(wi, wo, 2 * pixel / np.maximum(pixel + _density_about(half, normals), 1e-12))


def _hemisphere_pairs(count: int, rng: np.random.Generator) -> Samples:
    """Draw pairs uniform in projected solid angle, half of `wo` by theta_h, weighted as in `_sphere_pairs`."""
    normal = np.broadcast_to(_VIEW, (count, 3))
    wi = _disk(count, rng)
    half = _about(normal, rng)
    reflected = 2 * (wi * half).sum(1, keepdims=True) * half - wi
    wo = np.where((np.arange(count) % 2 == 0)[:, None], _disk(count, rng), reflected)
    half = wi + wo
    half /= np.linalg.norm(half, axis=1, keepdims=True)
    cosine = np.maximum(wo[:, 2], 0) / np.pi
    lobe = _density_about(normal, half) / (4 * np.maximum((wi * half).sum(1), 1e-6))
    return Samples(wi, wo, 2 * cosine / np.maximum(cosine + lobe, 1e-12))


def _disk(count: int, rng: np.random.Generator) -> np.ndarray:
    """Draw (count, 3) unit vectors of which the projection on the plane is uniform in the unit disk."""
    radius, azimuth = np.sqrt(rng.random(count)), 2 * np.pi * rng.random(count)
    return np.stack([radius * np.cos(azimuth), radius * np.sin(azimuth), np.sqrt(1 - radius**2)], 1)


def _about(axis: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Draw a unit vector about each `axis` (N, 3), with 1 - cos(angle) uniform inside a cell of the model's theta_h."""
    knots = half_knots()
    index = rng.integers(len(knots) - 1, size=len(axis))
    height = knots[index] + np.diff(knots)[index] * rng.random(len(axis))
    tangent = np.cross(axis, np.array([0.0, 1.0, 0.0]))
    short = np.linalg.norm(tangent, axis=1, keepdims=True) < 1e-6
    tangent = np.where(short, np.array([1.0, 0.0, 0.0]), tangent)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    azimuth, sine = 2 * np.pi * rng.random(len(axis)), np.sqrt(np.maximum(height * (2 - height), 0))
    side = np.cos(azimuth)[:, None] * tangent + np.sin(azimuth)[:, None] * np.cross(axis, tangent)
    return (1 - height)[:, None] * axis + sine[:, None] * side


def _density_about(axis: np.ndarray, vector: np.ndarray) -> np.ndarray:
    """Return the density per solid angle of `_about` at `vector` (N, 3); the chord keeps small angles exact."""
    knots = half_knots()
    height = 0.5 * ((vector - axis) ** 2).sum(1)  # 1 - cos(angle)
    cell = np.clip(np.searchsorted(knots, height, side="right") - 1, 0, len(knots) - 2)
    return np.where(height <= 1, 1 / ((len(knots) - 1) * 2 * np.pi * np.diff(knots)[cell]), 0)
