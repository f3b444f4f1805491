"""The reflectance of glTF 2.0's metallic-roughness materials (appendix B of its specification).

Unit n, l, v = (0, 0, 1) and h between l and v; alpha = roughness^2:

    f pi = (1 - F) (1 - metallic) base + pi F D V           F = f0 + (1 - f0) (1 - v . h)^5
    f0   = 0.04 (1 - metallic) + metallic base
    pi D = alpha^2 / ((n . h)^2 (alpha^2 - 1) + 1)^2                                                  Walter et al. 2007
    V    = 1 / (2 (n . l Lambda(n . v) + n . v Lambda(n . l))), Lambda(x) = sqrt(alpha^2 + (1 - alpha^2) x^2)

Radiance is f pi max(n . l, 0): under a light of intensity 1 a white matt surface that faces it is 1, as in the images.
"""

from typing import NamedTuple

import numpy as np

from sdps.refinement.reflectance import half_vectors

DIELECTRIC = 0.04
"""f0 of everything that is not a metal."""
_LEAST_COSINE = 1e-3


class Cosines(NamedTuple):
    """n . l and n . v, n . h, v . h, of shapes that broadcast; light and view are held above 0.001."""

    light: np.ndarray
    view: np.ndarray
    tilt: np.ndarray
    across: np.ndarray


def measure_cosines(normals: np.ndarray, directions: np.ndarray) -> Cosines:
    """Return the cosines of unit normals (..., 3) and lights (..., 3), which broadcast."""
    half = half_vectors(np.asarray(directions))
    light, tilt = (normals * directions).sum(axis=-1), (normals * half).sum(axis=-1)
    view = np.maximum(normals[..., 2], _LEAST_COSINE)
    return Cosines(np.maximum(light, _LEAST_COSINE), view, np.clip(tilt, 0.0, 1.0), half[..., 2])


def evaluate_fresnel(cosines: Cosines) -> np.ndarray:
    """Return (1 - v . h)^5."""
    return (1.0 - cosines.across) ** 5


def evaluate_highlight(cosines: Cosines, roughness: np.ndarray | float) -> np.ndarray:
    """Return pi D V, the highlight of a mirror's f0 = 1."""
    alpha = np.asarray(roughness) ** 2
    squared = alpha**2
    spread = squared / (cosines.tilt**2 * (squared - 1.0) + 1.0) ** 2
    hidden = [np.sqrt(squared + (1.0 - squared) * cosine**2) for cosine in (cosines.light, cosines.view)]
    return spread / (2.0 * (cosines.light * hidden[1] + cosines.view * hidden[0]))


def reflect_gltf(
    cosines: Cosines, base: np.ndarray, metallic: np.ndarray | float, roughness: np.ndarray | float
) -> np.ndarray:  # (..., 3)
    """Return f pi.

    Args:
        cosines: Of shape (...).
        base: (..., 3), linear base colour.
        metallic, roughness: (...), 0 to 1.
    """
    metallic = np.asarray(metallic)[..., None]
    f0 = DIELECTRIC * (1.0 - metallic) + metallic * base
    fresnel = f0 + (1.0 - f0) * evaluate_fresnel(cosines)[..., None]
    return (1.0 - fresnel) * (1.0 - metallic) * base + fresnel * evaluate_highlight(cosines, roughness)[..., None]


def shade_gltf(
    normals: np.ndarray, direction: np.ndarray, base: np.ndarray, metallic: np.ndarray | float,
    roughness: np.ndarray | float,
) -> np.ndarray:  # fmt: skip
    """Return the radiance (..., 3) of unit normals (..., 3) under a light (3,) of intensity 1; arguments as above."""
    reflected = reflect_gltf(measure_cosines(normals, direction), base, metallic, roughness)
    return reflected * np.clip(normals @ direction, 0.0, None)[..., None]
