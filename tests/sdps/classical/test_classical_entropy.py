"""Entropy minimisation (AM07) on surfaces of few albedos."""

import numpy as np
import pytest
from classical_scenes import Scene, hills, lambertian, lights, patches

from render.shared.errors import InputError
from sdps.classical.common.front_end import prepare
from sdps.classical.common.gbr import Gbr
from sdps.classical.entropy import entropy, standard_form
from sdps.classical.plain import factorisation


def few_albedos(seed: int, count: int = 4, **options) -> Scene:
    rng = np.random.default_rng(seed)
    normals, mask = hills(64)
    gains = rng.uniform(0.5, 2.0, 24)
    return lambertian(
        normals, mask, lights(24, seed, 0.7), albedo=patches(mask, count, rng), intensities=gains, **options
    )


@pytest.mark.parametrize("front", ["none", "low-rank"])
def test_few_albedos(front):
    scene = few_albedos(0)
    normals, directions, intensities = scene.errors(entropy(scene.images, scene.mask, front=front))
    assert normals < 5.0 and directions < 5.0 and intensities < 0.05
    assert normals < 0.5 * scene.errors(factorisation(scene.images, scene.mask, front=front))[0]


def test_brightness_does_not_matter():
    scene = few_albedos(1, shadows=False)
    first = entropy(scene.images, scene.mask, front="none")
    second = entropy(1000.0 * scene.images, scene.mask, front="none")
    assert scene.errors(first)[0] < 3.0
    np.testing.assert_allclose(scene.errors(second), scene.errors(first), atol=0.2)
    assert second.notes.energy == pytest.approx(first.notes.energy, abs=0.05)


def test_standard_form_does_not_depend_on_the_start():
    scene = few_albedos(2)
    factors = prepare(scene.images, scene.mask, front="none").factors
    expected = factors.transform(standard_form(factors)).surface
    other = factors.transform(Gbr(0.7, -1.3, 2.5))
    np.testing.assert_allclose(other.transform(standard_form(other)).surface, expected, atol=1e-9)


def test_same_seed_same_answer():
    scene = few_albedos(3)
    estimates = [entropy(scene.images, scene.mask, front="none", samples=1000, starts=2, seed=seed) for seed in (5, 5)]
    np.testing.assert_array_equal(estimates[0].normals, estimates[1].normals)
    minima = estimates[0].notes.minima
    assert (np.diff(minima[:, 0]) >= 0.0).all()


@pytest.mark.parametrize("options", [{"starts": 0}, {"samples": 10}])
def test_options_out_of_range(options):
    scene = few_albedos(0)
    with pytest.raises(InputError):
        entropy(scene.images, scene.mask, **options)


def test_a_plane_is_refused():
    scene = few_albedos(0)
    plane = np.zeros_like(scene.normals)
    plane[scene.mask] = (0.0, 0.0, 1.0)
    flat = lambertian(plane, scene.mask, scene.lights, intensities=scene.intensities)
    with pytest.raises(InputError):
        entropy(flat.images, flat.mask)
