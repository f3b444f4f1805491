"""The reflectance of refinement: its text, number by number; NumPy and torch; no modes."""

import math
from types import SimpleNamespace

import numpy as np
import torch
from sdps_scenes import hemisphere_lights

from sdps.classical.common.outlines import unit_normals
from sdps.refinement.reflectance import LEAST_COSINE, MODES, evaluate_factor, measure_angles, mode_terms, shade

RNG = np.random.default_rng(0)
NORMALS, LIGHTS = (unit_normals(hemisphere_lights(count, RNG).astype(np.float64)) for count in (30, 8))
SURFACE = {
    "albedo": RNG.uniform(0.2, 1.0, (30, 3)), "strength": RNG.uniform(0.1, 1.0, 30),
    "body": np.array([0.1, -0.2, 0.05, 0.3]), "amplitudes": np.array([0.5, 1.0]), "sharpness": np.array([20.0, 200.0]),
    "modes": np.array([0.1, -0.2, 0.2, 0.1, -0.3, 0.05]),
}  # fmt: skip


def write_out(n: np.ndarray, light: np.ndarray, rho: float, s: float) -> float:
    """Return the radiance of one channel of one pixel as the module's text says, in plain numbers."""
    b, a, kappa, m = list(SURFACE.values())[2:]
    h = light + np.array([0.0, 0.0, 1.0])
    h = h / math.sqrt(h @ h)
    nl, nv = max(n @ light, LEAST_COSINE), max(n[2], LEAST_COSINE)
    x, y, w, t = 1 - nl, 1 - nv, 1 - light[2], 1 - n @ h
    o = (light[2] - nl * nv) / (max(nl, nv) if light[2] > nl * nv else 1)
    body = math.exp(b[0] * (x + y) + b[1] * x * y + b[2] * (x * x + y * y) + b[3] * o)
    gloss = s * sum(a[k] * math.exp(-kappa[k] * t) for k in range(2)) / (light @ h) ** 2
    terms = [(x + y) * o, w * o, (x + y) * x * y, (x + y) * (x - y) ** 2, t * t, math.sqrt(t)]
    log = min(max(sum(one * term for one, term in zip(m, terms, strict=True)), -0.7), 0.7)
    return (rho * body + gloss) * math.exp(log) * max(n @ light, 0.0)


def test_radiance_is_what_the_text_says() -> None:
    found = shade(NORMALS, LIGHTS, SimpleNamespace(**SURFACE))
    expected = [
        [[write_out(n, light, rho, s) for light in LIGHTS] for rho in albedo]
        for n, albedo, s in zip(NORMALS, SURFACE["albedo"], SURFACE["strength"], strict=True)
    ]
    np.testing.assert_allclose(found, expected, rtol=1e-9)


def test_tensors_and_arrays_reflect_alike() -> None:
    surface = SimpleNamespace(**{name: torch.from_numpy(value) for name, value in SURFACE.items()})
    found = shade(torch.from_numpy(NORMALS), torch.from_numpy(LIGHTS), surface)
    np.testing.assert_allclose(found.numpy(), shade(NORMALS, LIGHTS, SimpleNamespace(**SURFACE)), rtol=1e-12)


def test_nothing_is_added_without_modes_and_where_light_and_camera_face_the_surface() -> None:
    assert (evaluate_factor(measure_angles(NORMALS, LIGHTS), np.zeros(MODES)) == 1.0).all()
    facing = np.array([[0.0, 0.0, 1.0]])
    assert max(abs(float(term[0, 0])) for term in mode_terms(measure_angles(facing, facing))) < 1e-3
