"""How far a pixel's reflectance is from isotropy: the energies of `half_vector`, and what follows from them.

Under a distant light and an orthographic camera theta_d is half the angle of light and view, whatever the normal, and
theta_h the angle of normal and half vector. An isotropic BRDF with half-vector symmetry depends on these two alone.
"""

import numpy as np

from render.shared.imaging.vectors import half_vectors

_LIT = 0.08
"""Smallest n . l of a sample whose reflectance counts."""

_FLOOR = 0.03
"""Added to all samples before the logarithm, over the typical value of the pixel; keeps shadows and noise in bounds."""

_CAP = 0.5
"""Difference of log reflectance at which a pair counts as an outlier and costs no more."""

_WIDTH_H, _WIDTH_D = np.radians(5.0), np.radians(10.0)
"""Differences of theta_h and theta_d over which two samples are still compared."""

_CHUNK = 5000


def asymmetry(values: np.ndarray, normals: np.ndarray, lights: np.ndarray) -> np.ndarray:  # (P,)
    """Return how far each pixel's reflectance is from a smooth function of theta_h and theta_d, 0 to 1.

    The samples are sorted by theta_h; those one and two places apart are compared, the more the closer they are in
    theta_h and theta_d. Light where the normal leaves no light counts as an outlier.

    Args:
        values: (P, L) log of the samples over light intensity and typical value, from `log_values`.
        normals: (P, 3) unit.
        lights: (L, 3) unit directions.
    """
    half = half_vectors(lights)
    theta_d = np.arccos(np.clip(half[:, 2], -1.0, 1.0)).astype(np.float32)  # (L,): the camera is along z
    shading = (normals @ lights.T).astype(np.float32)
    theta_h = np.arccos(np.clip(normals @ half.T, -1.0, 1.0)).astype(np.float32)
    lit = shading > _LIT
    order = np.argsort(theta_h, axis=1)
    # Half the floor, as a typical sample has n . l of about a half: diffuse reflectance stays constant at low n . l.
    reflectance = np.take_along_axis(values - np.log(np.maximum(shading, _LIT) + 0.5 * _FLOOR), order, axis=1)
    weight = np.take_along_axis(np.where(lit, shading, 0.0), order, axis=1)
    theta_h, theta_d = np.take_along_axis(theta_h, order, axis=1), theta_d[order]
    lost = np.where(lit, 0.0, np.clip(values - np.log(4.0 * _LIT), 0.0, 1.0)).sum(1)
    total, norm = lost.copy(), lost.copy()
    for lag in (1, 2):
        near = ((theta_h[:, lag:] - theta_h[:, :-lag]) / _WIDTH_H) ** 2
        near += ((theta_d[:, lag:] - theta_d[:, :-lag]) / _WIDTH_D) ** 2
        pair = np.exp(-near) * np.minimum(weight[:, lag:], weight[:, :-lag])
        step = np.minimum(((reflectance[:, lag:] - reflectance[:, :-lag]) / _CAP) ** 2, 1.0)
        total += (pair * step).sum(1)
        norm += pair.sum(1)
    return np.where(norm > 1.0, total / np.maximum(norm, 1e-6), 1.0)


def log_values(profiles: np.ndarray, intensities: np.ndarray) -> np.ndarray:  # (P, L) float32
    """Return log samples over intensity and the pixel's typical value."""
    values = np.maximum(profiles / intensities, 0.0).astype(np.float32)  # a dark frame leaves noise around 0
    values /= np.maximum(np.median(values, axis=1, keepdims=True), 1e-3 * values.max() + 1e-12)
    return np.log(values + np.float32(_FLOOR))


def asymmetries(values: np.ndarray, normals: np.ndarray, lights: np.ndarray) -> np.ndarray:  # (P,)
    """Return `asymmetry` of any number of pixels, in flat memory."""
    chunks = range(0, len(values), _CHUNK)
    return np.concatenate([asymmetry(values[i : i + _CHUNK], normals[i : i + _CHUNK], lights) for i in chunks])


def intensity_corrections(values: np.ndarray, normals: np.ndarray, lights: np.ndarray) -> np.ndarray:  # (L,)
    """Return the factor per image by which its samples exceed their neighbours in theta_h; the mean log is 0."""
    half = half_vectors(lights)
    shading = normals @ lights.T
    order = np.argsort(-(normals @ half.T), axis=1)
    reflectance = np.take_along_axis(values - np.log(np.maximum(shading, _LIT) + 0.5 * _FLOOR), order, axis=1)
    excess = np.full(values.shape, np.nan)
    middle = reflectance[:, 1:-1] - 0.5 * (reflectance[:, :-2] + reflectance[:, 2:])
    np.put_along_axis(excess, order[:, 1:-1], middle, axis=1)
    excess[shading < 3.0 * _LIT] = np.nan
    enough = np.isfinite(excess).sum(0) >= 20
    logs = np.zeros(len(lights))
    logs[enough] = np.nanmedian(excess[:, enough], axis=0)
    return np.exp(logs - logs.mean())


def azimuths(values: np.ndarray, lights: np.ndarray) -> np.ndarray:  # (P',)
    """Return the direction of the plane of normal and view, up to 180 degrees, about which a profile is symmetric.

    Both the profile and its mirror image are smoothed by the same kernel over the lights, and compared where there are
    lights on both sides.
    """
    cosines = np.clip(lights @ lights.T, -1.0, 1.0)
    spacing = float(np.median(np.arccos(np.sort(cosines, axis=1)[:, -2])))
    width = max(spacing, np.radians(2.0))

    def kernel(targets: np.ndarray) -> np.ndarray:
        return np.exp(-(np.arccos(np.clip(targets @ lights.T, -1.0, 1.0)) ** 2) / (2.0 * width**2))

    plain = kernel(lights)
    plain /= plain.sum(1, keepdims=True)
    angles = np.radians(np.arange(0.0, 180.0, 3.0))
    costs = np.empty((len(angles), len(values)), np.float32)
    for index, angle in enumerate(angles):
        across = np.array([-np.sin(angle), np.cos(angle), 0.0])
        mirrored = kernel(lights - 2.0 * np.outer(lights @ across, across))
        cover = mirrored.sum(1)
        difference = values @ (plain - mirrored / np.maximum(cover, 1e-6)[:, None]).T.astype(np.float32)
        trust = np.minimum(cover, 1.0).astype(np.float32) * (np.abs(lights @ across) > width)
        costs[index] = (difference**2 @ trust) / max(float(trust.sum()), 1e-6)
    return angles[costs.argmin(0)]
