"""Tests of handedness that need nothing but the data: do normals leave the silhouette, and do lights fit the shading?

The frame is x right, y up, z to the camera; image row 0 is the top. Flipped axes are the commonest and quietest
fault of photometric-stereo data, because n . l does not change when both are flipped.
"""

import numpy as np
from scipy import ndimage

from render.shared.seeds import spread_evenly

_PIXELS = 2000
_LEAST_BORDER = 20  # pixels of silhouette below which nothing is said
_MARGIN = 0.1  # lead in correlation another sign must have to be reported


def silhouette_fit(normals: np.ndarray, mask: np.ndarray) -> tuple[float, float] | None:
    """Compare normals along the silhouette with the outward direction.

    Args:
        normals: (H, W, 3), unit in the mask.
        mask: (H, W) bool.

    Returns:
        Mean of n_x and of n_y times the outward direction, positive in the right frame and near 1 where the surface
        turns away; None where the silhouette inside the image is too short to tell.
    """
    height, width = mask.shape
    border = mask & ~ndimage.binary_erosion(mask, iterations=2, border_value=1)
    border[[0, 1, height - 2, height - 1], :] = False  # cut off by the frame there, so no silhouette
    border[:, [0, 1, width - 2, width - 1]] = False
    if border.sum() < _LEAST_BORDER:
        return None
    blurred: np.ndarray = ndimage.gaussian_filter(mask.astype(np.float64), 2.0)
    rows, columns = np.gradient(blurred)
    outward = np.stack([-columns[border], rows[border]], axis=-1)
    outward /= np.maximum(np.linalg.norm(outward, axis=-1, keepdims=True), 1e-9)
    found = normals[border][:, :2]
    scale = np.maximum((np.abs(found) * np.abs(outward)).sum(0), 1e-9)
    x, y = (found * outward).sum(0) / scale
    return float(x), float(y)


def shading_fit(images: np.ndarray, normals: np.ndarray, mask: np.ndarray, lights: np.ndarray) -> dict[str, float]:
    """Correlate the images with max(n . l, 0), for the lights as given and with x, y or both negated.

    Args:
        images: (L, H, W, 3), linear, per unit light intensity.
        normals: (H, W, 3).
        mask: (H, W) bool.
        lights: (L, 3).

    Returns:
        Pearson correlations by the axes negated: `""`, `"x"`, `"y"`, `"xy"`. Each pixel is divided by its mean over
        the lights, which removes the albedo.
    """
    rows, columns = np.nonzero(mask)
    chosen = spread_evenly(range(len(rows)), _PIXELS)
    rows, columns = rows[chosen], columns[chosen]
    grey = np.asarray(images[:, rows, columns], np.float64).mean(-1)  # (L, P)
    grey = grey / np.maximum(grey.mean(0), 1e-9)
    fits = {}
    for axes, signs in {"": (1, 1, 1), "x": (-1, 1, 1), "y": (1, -1, 1), "xy": (-1, -1, 1)}.items():
        shading = np.maximum((np.asarray(lights, np.float64) * signs) @ normals[rows, columns].T.astype(np.float64), 0)
        pair = grey - grey.mean(), shading - shading.mean()
        spread = np.sqrt((pair[0] ** 2).sum() * (pair[1] ** 2).sum())
        fits[axes] = float((pair[0] * pair[1]).sum() / spread) if spread > 0 else 0.0
    return fits


def find_faults(images: np.ndarray, normals: np.ndarray, mask: np.ndarray, lights: np.ndarray) -> list[str]:
    """Say in words which axis looks flipped, of the normals (silhouette) and of the lights against them (shading)."""
    found = []
    outline = silhouette_fit(normals, mask)
    for axis, value in zip("xy", outline or (), strict=False):
        if value < -_MARGIN:
            found.append(f"normals point into the object along the silhouette in {axis} ({value:.2f})")
    fits = shading_fit(images, normals, mask, lights)
    best = max(fits, key=fits.__getitem__)
    if fits[best] > fits[""] + _MARGIN:
        found.append(
            f"lights fit the shading better with {' and '.join(best)} negated ({fits[best]:.2f} against {fits['']:.2f})"
        )
    return found
