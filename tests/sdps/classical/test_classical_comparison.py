"""Uncalibrated methods side by side on one shadowed Lambertian hill: figures of docs/studies/classical-methods.md."""

import classical_scenes as scenes
import numpy as np
import pytest
from scipy import optimize

from sdps.classical import registry
from sdps.classical.common.factorisation import Factors
from sdps.classical.common.front_end import prepare
from sdps.classical.common.gbr import Gbr
from sdps.core.metrics import angle_degrees

LIMITS = {"am07": 2.0, "sm10": 1.0, "pf14": 9.5}  # degrees of normals


@pytest.mark.slow
@pytest.mark.parametrize("name", LIMITS)
@pytest.mark.parametrize("lowest", [0.3, 0.7])
@pytest.mark.parametrize("albedos", [1, 4, 20])
def test_close_to_the_truth_where_the_factorisation_is_not(name, lowest, albedos):
    for seed in range(3):
        rng = np.random.default_rng(seed)
        normals, mask = scenes.hills(96)
        albedo = scenes.patches(mask, albedos, rng) if albedos > 1 else 0.7
        lights, gains = scenes.lights(24, seed, lowest), rng.uniform(0.2, 2.0, 24)
        scene = scenes.lambertian(normals, mask, lights, albedo=albedo, intensities=gains)
        error = scene.errors(registry.run(name, scene.images, mask))[0]
        assert error < LIMITS[name]
        assert error < 0.5 * scene.errors(registry.run("factorisation", scene.images, mask))[0]


def best_error(factors: Factors, truth: np.ndarray) -> float:
    """Return the error in degrees under the bas-relief transformation that is best for the true normals (P, 3)."""

    def error(parameters: np.ndarray) -> float:
        gbr = Gbr(parameters[0], parameters[1], float(np.exp(np.clip(parameters[2], -5.0, 5.0))))
        return float(angle_degrees(factors.transform(gbr).normals(), truth).mean())

    starts = ([0.0, 0.0, depth] for depth in (-0.7, 0.0, 0.7))
    return min(optimize.minimize(error, start, method="Nelder-Mead").fun for start in starts)


@pytest.mark.slow
@pytest.mark.parametrize(("shape", "lobe", "limits"), [
    (scenes.hills, 0.0, {"low-rank": 0.5, "diffuse": 0.1}),
    (scenes.sphere, 0.0, {"low-rank": 1.0, "diffuse": 0.1}),
    (scenes.hills, 0.2, {"diffuse": 0.5}),
    (scenes.sphere, 0.2, {"low-rank": 12.0, "diffuse": 0.5}),
    (scenes.hills, 0.4, {"low-rank": 8.0, "diffuse": 6.0}),
    (scenes.sphere, 0.4, {"low-rank": 14.0, "diffuse": 5.0}),
])  # fmt: skip
def test_front_ends_keep_shadows_and_highlights_out(shape, lobe, limits):
    normals, mask = shape(64)
    lights, gains = scenes.lights(48, 1, 0.3), np.random.default_rng(0).uniform(0.2, 2.0, 48)
    if lobe:
        scene = scenes.glossy(normals, mask, lights, roughness=lobe, intensities=gains)
    else:
        scene = scenes.lambertian(normals, mask, lights, intensities=gains)
    truth = normals[mask]
    plain = best_error(prepare(scene.images, mask, front="none").factors, truth)
    for front, limit in limits.items():
        found = best_error(prepare(scene.images, mask, front=front).factors, truth)
        assert found < limit and found < 0.8 * plain, (front, found, plain)
