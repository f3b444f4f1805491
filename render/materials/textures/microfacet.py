"""The reflectance model that textures drive: base colour, roughness and metallic, as PBR maps hold them.

    f = (1 - m) (F_d DG + c T_d(i) T_d(o) / (pi mean T_d)) + m (F_c DG + F_ms T_s(i) T_s(o) / (pi mean T_s))

with DG the GGX distribution and the height-correlated Smith term (Walter et al. 2007; Heitz 2014), F Schlick's Fresnel
term from 0.04 (dielectric) or the base colour c (metal). T_d = 1 - E_d is what the dielectric's coat lets through to a
diffuse base (Kelemen and Szirmay-Kalos 2001), T_s = 1 - E_s what single scattering loses at F = 1, given back as in
Kulla and Conty (2017). So a white material reflects all light, at any roughness and metallic, and none reflects
more; it is reciprocal. This module is the slow, plain numpy form; `render.materials.kernels.textures.gloss` evaluates
the same in a kernel.
"""

from functools import cache

import numpy as np

DIELECTRIC = 0.04  # reflectance of a dielectric of index 1.5 along the normal
ROUGHEST, SMOOTHEST = 1.0, 0.1
"""Range of the roughness; a smoother map counts as `SMOOTHEST`, so that no highlight is narrower than a degree."""
COSINES, ROUGHNESSES = 32, 24  # knots of the tables, uniform


@cache
def tables() -> tuple[np.ndarray, np.ndarray]:
    """Return what is not reflected, T_d and T_s, at the knots, and their means over the hemisphere.

    Returns:
        (R, C, 2) over roughness in [SMOOTHEST, ROUGHEST] and cosine in [0, 1]; (R, 2) means, 2 int T(c) c dc.
    """
    roughness = np.linspace(SMOOTHEST, ROUGHEST, ROUGHNESSES)
    cosine = np.maximum(np.linspace(0, 1, COSINES), 1e-3)
    lost = np.stack([1 - _albedo(cosine, value) for value in roughness])  # (R, C, 2)
    return lost, _mean(lost)


def _mean(values: np.ndarray) -> np.ndarray:
    """Integrate 2 T(c) c dc of the piecewise linear T, (R, C, 2), exactly: (R, 2)."""
    knots = np.linspace(0, 1, COSINES)
    low, high = values[:, :-1], values[:, 1:]
    a, step = knots[:-1, None], knots[1] - knots[0]
    return (step * (a * (low + high) + step * (low + 2 * high) / 3)).sum(1)


def evaluate(
    base: np.ndarray, roughness: np.ndarray, metallic: np.ndarray, wi: np.ndarray, wo: np.ndarray
) -> np.ndarray:
    """Evaluate the BRDF.

    Args:
        base: (N, 3) linear base colour in [0, 1].
        roughness: (N,) in [0, 1]; the width alpha of the GGX distribution is its square.
        metallic: (N,) in [0, 1].
        wi: (N, 3) unit vectors from the surface to the light, in the shading frame (z is the normal).
        wo: (N, 3) unit vectors to the camera.

    Returns:
        (N, 3) linear RGB in 1/sr, without the cosine; zero where either vector is below the horizon.
    """
    rough = np.clip(roughness, SMOOTHEST, ROUGHEST)
    metal = np.asarray(metallic, np.float64)[:, None]
    ci, co = wi[:, 2], wo[:, 2]
    above = (ci > 0) & (co > 0)
    ci, co = np.maximum(ci, 1e-6), np.maximum(co, 1e-6)
    half = wi + wo
    half /= np.maximum(np.linalg.norm(half, axis=1, keepdims=True), 1e-12)
    single = (distribution(half[:, 2], rough**2) * smith(ci, co, rough**2))[:, None]
    zero = (1 - metal) * DIELECTRIC + metal * base
    fresnel = zero + (1 - zero) * (1 - np.clip((wi * half).sum(1), 0, 1)[:, None]) ** 5
    lost, mean = _interpolate_loss(ci, rough) * _interpolate_loss(co, rough), _mean_lost(rough)
    diffuse = base * (lost[:, :1] / mean[:, :1])
    again = multiple_scattering(base, mean[:, 1:]) * lost[:, 1:] / mean[:, 1:]
    value = single * fresnel + ((1 - metal) * diffuse + metal * again) / np.pi
    return np.where(above[:, None], value, 0.0)


def distribution(cosine: np.ndarray, alpha: np.ndarray) -> np.ndarray:
    """Return GGX's density D of half vectors at cos(theta_h)."""
    square = alpha**2
    return square / (np.pi * (cosine**2 * (square - 1) + 1) ** 2)


def smith(ci: np.ndarray, co: np.ndarray, alpha: np.ndarray | float) -> np.ndarray:
    """Return G / (4 ci co), height-correlated (Heitz 2014, eq. 99)."""
    square = alpha**2
    first, second = (np.sqrt(square + (1 - square) * c**2) for c in (ci, co))
    return 0.5 / (co * first + ci * second)


def multiple_scattering(base: np.ndarray, mean: np.ndarray) -> np.ndarray:
    """Return the colour of light scattered more than once (Kulla and Conty 2017), with mean = 1 - E_avg."""
    average = base + (1 - base) / 21  # of Schlick's term, over the hemisphere
    return average**2 * (1 - mean) / (1 - average * mean)


def _interpolate_loss(cosine: np.ndarray, roughness: np.ndarray) -> np.ndarray:
    """Interpolate `tables()[0]`; (N, 2)."""
    lost, _ = tables()
    row, a = _cell((roughness - SMOOTHEST) / (ROUGHEST - SMOOTHEST), ROUGHNESSES)
    column, b = _cell(cosine, COSINES)
    low, high = ((1 - b) * lost[row + k, column] + b * lost[row + k, column + 1] for k in (0, 1))
    return (1 - a) * low + a * high


def _mean_lost(roughness: np.ndarray) -> np.ndarray:
    row, a = _cell((roughness - SMOOTHEST) / (ROUGHEST - SMOOTHEST), ROUGHNESSES)
    _, mean = tables()
    return (1 - a) * mean[row] + a * mean[row + 1]


def _cell(coordinate: np.ndarray, knots: int) -> tuple[np.ndarray, np.ndarray]:
    position = np.clip(coordinate, 0, 1) * (knots - 1)
    index = np.minimum(position.astype(int), knots - 2)
    return index, (position - index)[:, None]


def _albedo(cosine: np.ndarray, roughness: float, count: int = 48) -> np.ndarray:
    """Return E_d and E_s, (C, 2): the mean of F G2 / G1 over a grid of visible half vectors (Heitz 2018)."""
    alpha = roughness**2
    u, v = ((grid.ravel() + 0.5) / count for grid in np.meshgrid(np.arange(count), np.arange(count)))
    found = []
    for c in cosine:
        wi = np.array([np.sqrt(1 - c * c), 0.0, c])
        half = _visible_half(wi, alpha, u, v)
        towards = np.clip(half @ wi, 0, 1)
        co = 2 * towards * half[:, 2] - c
        lit = np.maximum(co, 1e-9)
        passed = 2 * lit * smith(np.full_like(lit, c), lit, alpha) * (c + np.sqrt(alpha**2 + (1 - alpha**2) * c * c))
        passed = np.where(co > 0, passed, 0)
        schlick = (1 - towards) ** 5
        found.append([(passed * (DIELECTRIC + (1 - DIELECTRIC) * schlick)).mean(), passed.mean()])
    return np.array(found)


def _visible_half(wi: np.ndarray, alpha: float, u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Return (N, 3) half vectors drawn in proportion to what `wi` sees of them (Dupuy and Benyoub 2023)."""
    stretched = wi * [alpha, alpha, 1]
    stretched /= np.linalg.norm(stretched)
    z = (1 - v) * (1 + stretched[2]) - stretched[2]
    sine = np.sqrt(np.clip(1 - z * z, 0, 1))
    drawn = np.stack([sine * np.cos(2 * np.pi * u), sine * np.sin(2 * np.pi * u), z], 1) + stretched
    drawn *= [alpha, alpha, 1]
    return drawn / np.linalg.norm(drawn, axis=1, keepdims=True)
