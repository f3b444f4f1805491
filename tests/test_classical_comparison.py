"""Uncalibrated methods side by side on one shadowed Lambertian hill: the figures of docs/classical.md."""

import classical_scenes as scenes
import numpy as np
import pytest

from sdps.classical import registry

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
