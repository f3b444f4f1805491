"""The reflectance of refinement, defined once; every function takes NumPy arrays or torch tensors (differentiable).

Pixel p, light i, channel c; n unit normal, l unit direction to the light, v = (0, 0, 1), h = (l + v) / |l + v|:

    f_pic = (rho_pc D_pi + S_pi) G_pi                                                   radiance is f max(n . l, 0)
    D_pi  = exp(b . (x + y,  x y,  x^2 + y^2,  o))                                      body; 1 is Lambertian
    S_pi  = s_p sum_k a_k exp(-kappa_k t_pi) / (l_i . h_i)^2                            spherical Gaussians
    G_pi  = exp(m . ((x + y) o,  (1 - l . v) o,  (x + y) x y,  (x + y) (x - y)^2,  t^2,  sqrt(t)))
    x = 1 - n . l,  y = 1 - n . v,  t = 1 - n . h
    o = (l . v - n . l n . v) / (max(n . l, n . v) if positive, else 1)                 towards the light, and away

n . l and n . v are held above 0.02 in x, y and o. o is the term of Oren and Nayar (1994) as Fujii writes it:
cos(azimuth between l and v) sin sin / max(cos, cos). G, between exp(-0.7) and exp(0.7), is what real materials add: its
terms were chosen one by one, each explaining most of what those before it leave of the 100 materials fitted to MERL.

`fused` compiles rho D + S and its gradient, and is tested against this module; the page of `sdps app` interpolates
tables that are evaluated here. A new term of the body changes `body_terms` and `fused`; a new term of G changes
`mode_terms` and assets/reflectance_modes.yaml, which `lab/studies/reflectance_modes.py` measures.
"""

from typing import Any, NamedTuple

import numpy as np
import torch

LOBES = 8
"""Spherical Gaussians of an object."""
LEAST_COSINE = 0.02
"""Cosines in x, y and o are held above it."""
MOST_LOG_FACTOR = 0.7
"""Largest absolute logarithm of G."""
Array = Any
"""A NumPy array or a torch tensor; all arguments of a call are of one kind."""


class Angles(NamedTuple):
    """x, y, o, t and l . v of the module's text; shapes that broadcast to (P, L)."""

    x: Array
    y: Array
    o: Array
    t: Array
    across: Array


def body_terms(angles: Angles) -> list[Array]:
    """Return what the numbers b of the body are multiplied with."""
    x, y, o, *_ = angles
    return [x + y, x * y, x**2 + y**2, o]


def mode_terms(angles: Angles) -> list[Array]:
    """Return what the numbers m of the modes are multiplied with."""
    x, y, o, t, across = angles
    s = x + y
    return [s * o, (1.0 - across) * o, s * x * y, s * (x - y) ** 2, t**2, t**0.5]


SHAPES, MODES = (len(terms(Angles(0.0, 0.0, 0.0, 0.0, 0.0))) for terms in (body_terms, mode_terms))
"""How many terms the body and the modes have."""


def measure_angles(normals: Array, directions: Array) -> Angles:
    """Return the angles of unit normals (P, 3) and lights (L, 3); y is (P, 1), l . v (L,), the others (P, L).

    Lights (P, L, 3) are those of each pixel; l . v is then (P, L).
    """
    xp, half = _library(normals), half_vectors(directions)
    if directions.ndim == 2:
        tilt, light = normals @ half.T, normals @ directions.T
    else:
        tilt, light = ((vectors @ normals[..., None])[..., 0] for vectors in (half, directions))
    return combine_cosines(light, normals[:, 2:], directions[..., 2], xp.clip(1.0 - tilt, 0.0, None))


def combine_cosines(light: Array, view: Array, across: Array, tilt: Array) -> Angles:
    """Return the angles of the cosines n . l, n . v and l . v, and t."""
    xp = _library(light)
    light, view = xp.clip(light, LEAST_COSINE, None), xp.clip(view, LEAST_COSINE, None)
    gap = across - light * view
    opposed = gap / xp.where(gap > 0.0, xp.maximum(light, view), 1.0)
    return Angles(1.0 - light, 1.0 - view, opposed, tilt, across)


def half_vectors(directions: Array) -> Array:  # (..., 3)
    """Return the unit vectors half way between lights (..., 3) and the camera."""
    xp = _library(directions)
    summed = xp.stack([directions[..., 0], directions[..., 1], directions[..., 2] + 1.0], -1)
    return summed / xp.clip(xp.linalg.norm(summed, None, -1, True), 1e-12, None)


def evaluate_body(angles: Angles, body: Array) -> Array:  # (P, L)
    """Return D."""
    xp = _library(angles.x)
    return xp.exp(xp.tensordot(body, xp.stack(body_terms(angles)), 1))


def evaluate_lobes(angles: Angles, strength: Array, amplitudes: Array, sharpness: Array) -> Array:  # (P, L)
    """Return S."""
    xp = _library(angles.t)
    lobes = (amplitudes[:, None, None] * xp.exp(-sharpness[:, None, None] * angles.t)).sum(0)
    # The denominator of a microfacet highlight, 4 n.l n.v, is 4 (l.h)^2 where n = h; and 2 (l.h)^2 = 1 + l.v.
    return strength[:, None] * lobes * (2.0 / (1.0 + angles.across))


def evaluate_log_factor(angles: Angles, modes: Array) -> Array:  # (P, L)
    """Return the logarithm of G before it is bounded."""
    return _library(angles.t).stack(mode_terms(angles), -1) @ modes


def evaluate_factor(angles: Angles, modes: Array) -> Array:  # (P, L)
    """Return G."""
    xp = _library(angles.t)
    return xp.exp(xp.clip(evaluate_log_factor(angles, modes), -MOST_LOG_FACTOR, MOST_LOG_FACTOR))


def reflect(angles: Angles, surface: Any) -> Array:  # (P, 3, L)
    """Return rho D + S; the surface has albedo (P, 3), strength (P,), body (4,), amplitudes (K,) and sharpness (K,)."""
    specular = evaluate_lobes(angles, surface.strength, surface.amplitudes, surface.sharpness)
    return surface.albedo[..., None] * evaluate_body(angles, surface.body)[:, None] + specular[:, None]


def shade(normals: Array, directions: Array, surface: Any) -> Array:  # (P, 3, L)
    """Return the radiance of unit normals (P, 3) under lights (L, 3) or (P, L, 3), those of each pixel, of intensity 1.

    The surface has modes (M,) too.
    """
    angles = measure_angles(normals, directions)
    cosines = normals @ directions.T if directions.ndim == 2 else (directions @ normals[..., None])[..., 0]
    lit = _library(normals).clip(cosines, 0.0, None) * evaluate_factor(angles, surface.modes)
    return reflect(angles, surface) * lit[:, None]


def _library(array: Array) -> Any:
    """Return the module whose functions take an array."""
    return torch if isinstance(array, torch.Tensor) else np
