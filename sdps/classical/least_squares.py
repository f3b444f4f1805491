"""Calibrated least squares (Woodham 1980): Lambert's law solved per pixel under known lights."""

import numpy as np

from render.errors import InputError
from sdps.estimate import Estimate

_GREY = np.array([0.299, 0.587, 0.114])
"""Rec. 601 weights of R, G, B, as in the DiLiGenT benchmark's own baseline; blue is the noisiest channel there."""

_MIN_CONDITION = 1e-3
"""Smallest over largest singular value of the light matrix below which lights count as coplanar."""


def least_squares(
    images: np.ndarray,
    mask: np.ndarray,
    light_directions: np.ndarray,
    intensities: np.ndarray | None = None,
    *,
    shadow_threshold: float = 0.0,
) -> Estimate:
    """Solve i_k = rho max(n . l_k, 0) in the least-squares sense for every pixel of the mask.

    Args:
        images: (L, H, W, 3) or (L, H, W), linear radiance.
        mask: (H, W) bool.
        light_directions: (L, 3), unit, from the surface to the light.
        intensities: (L,) or (L, 3) known intensities; equal ones when absent.
        shadow_threshold: Observations below this share of the pixel's brightest are taken for shadows and
            dropped, as long as three remain (0: keep all; 0.05 to 0.1 is usual).

    Returns:
        Normals; the given lights; diagnostics `albedo` (H, W) float32, relative to a white Lambertian
        surface when the intensities are absolute.

    Raises:
        InputError: fewer than three images, coplanar lights, an empty mask, non-finite values, or sizes that differ.
    """
    images = np.asarray(images, np.float32)
    directions = np.asarray(light_directions, np.float64)
    gains = np.ones(len(images)) if intensities is None else np.asarray(intensities, np.float64)
    images = images[..., None] if images.ndim == 3 else images
    _check(images, mask, directions, gains, shadow_threshold)
    gains = gains[:, None] if gains.ndim == 1 else gains  # (L, 1 or 3)
    values = images[:, mask] / gains[:, None]  # (L, P, 1 or 3)
    grey = values @ (_GREY if values.shape[-1] == 3 else np.ones(1))  # (L, P)
    vectors = np.linalg.lstsq(directions, grey, rcond=None)[0].T  # (P, 3), albedo times normal
    if shadow_threshold > 0.0:
        vectors = _without_shadows(directions, grey, vectors, shadow_threshold)
    albedo = np.linalg.norm(vectors, axis=1)
    normals = np.zeros((*mask.shape, 3), np.float32)
    normals[mask] = np.where(albedo[:, None] > 0.0, vectors / np.maximum(albedo[:, None], 1e-12), [0.0, 0.0, 1.0])
    albedo_map = np.zeros(mask.shape, np.float32)
    albedo_map[mask] = albedo
    return Estimate(
        normals=normals,
        light_directions=directions.astype(np.float32),
        intensities=gains.mean(1).astype(np.float32),
        diagnostics={"albedo": albedo_map},
    )


def _without_shadows(
    directions: np.ndarray, grey: np.ndarray, vectors: np.ndarray, threshold: float
) -> np.ndarray:  # (P, 3)
    """Solve again with the lit observations only, where they still fix the normal."""
    lit = (grey >= threshold * grey.max(0)).astype(np.float64)  # (L, P)
    # Normal equations per pixel: a batch of 3x3 systems instead of a loop over ragged ones.
    matrices = np.einsum("lp,li,lj->pij", lit, directions, directions, optimize=True)
    targets = np.einsum("lp,li->pi", lit * grey, directions, optimize=True)
    eigenvalues = np.linalg.eigvalsh(matrices)
    solvable = (lit.sum(0) >= 3) & (eigenvalues[:, 0] > _MIN_CONDITION**2 * eigenvalues[:, 2])
    result = vectors.copy()
    result[solvable] = np.linalg.solve(matrices[solvable], targets[solvable][..., None])[..., 0]
    return result


def _check(images: np.ndarray, mask: np.ndarray, directions: np.ndarray, gains: np.ndarray, threshold: float) -> None:
    """Refuse what has no answer, in one line each."""
    count = len(images)
    if images.ndim != 4 or images.shape[1:3] != mask.shape:
        raise InputError(f"images of shape {images.shape} do not fit a mask of {mask.shape}; want (L, H, W, 3)")
    if directions.shape != (count, 3) or len(gains) != count:
        raise InputError(f"{count} images need {count} light directions and intensities, got {directions.shape}")
    if count < 3:
        raise InputError(f"least squares needs at least 3 images, got {count}")
    if not mask.any():
        raise InputError("the mask is empty; mark the object's pixels")
    if not (np.isfinite(images[:, mask]).all() and np.isfinite(directions).all() and np.isfinite(gains).all()):
        raise InputError("images, light directions or intensities hold NaN or infinite values; repair them first")
    if (gains <= 0.0).any():
        raise InputError("light intensities must be positive")
    if not 0.0 <= threshold < 1.0:
        raise InputError(f"shadow_threshold must be in [0, 1), got {threshold}")
    singular = np.linalg.svd(directions, compute_uv=False)
    if singular[2] < _MIN_CONDITION * singular[0]:
        raise InputError("the light directions are coplanar; least squares needs three that are not")
