"""How much of a material's light comes from a highlight narrower than a pixel resolves; it decides the sampling."""

import numpy as np

NARROW = np.radians(2.5)  # a pixel of a curved object spans one to a few degrees of normals
_FLOOR_ANGLE = np.radians(60)


def share(theta_h: np.ndarray, luminance: np.ndarray) -> float:
    """Return the share of the reflected light whose half vector lies within `NARROW` of the normal.

    The highlight is what rises over the lowest value at moderate angles. Near the mirror direction reflected directions
    cover four times the solid angle of half vectors, so a profile f over theta_h reflects 8 pi f cos sin d(theta_h);
    the floor below it is taken for Lambertian.

    Args:
        theta_h: (N,) rising half-vector angles in radians, from 0.
        luminance: (N,) BRDF at small difference angles, 1/sr.

    Returns:
        A number in [0, 1]; 0.003 for a Lambertian one's neighbours without a peak, 0.9 for a mirror-like metal.
    """
    theta_h, luminance = np.asarray(theta_h, np.float64), np.asarray(luminance, np.float64)
    floor = luminance[theta_h < _FLOOR_ANGLE].min()
    fine = np.concatenate([[0.0], np.geomspace(1e-5, theta_h[-1], 4000)])
    density = np.maximum(np.interp(fine, theta_h, luminance) - floor, 0) * np.sin(fine) * np.cos(fine)
    energy = 8 * np.pi * np.concatenate([[0.0], np.cumsum((density[1:] + density[:-1]) / 2 * np.diff(fine))])
    return float(np.interp(NARROW, fine, energy) / max(energy[-1] + np.pi * floor, 1e-12))
