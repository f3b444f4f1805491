"""WT13 and what it stands on: the diffuse part of glossy images, and highlights that tell the bas-relief apart."""

import logging
from functools import partial

import classical_scenes as scenes
import numpy as np
import pytest

from render.shared.errors import InputError
from sdps.classical.common.bas_relief_search import minimise_over_bas_reliefs
from sdps.classical.common.front_end import conclude, prepare
from sdps.classical.common.gbr import Gbr
from sdps.classical.common.separation import diffuse_factors, diffuse_surface
from sdps.classical.plain import equal_intensity, factorisation
from sdps.classical.reflectance_symmetry import reflectance_symmetry, symmetry_energy
from sdps.core.metrics import angle_degrees

SIZE = 48
glossy = partial(scenes.glossy_shape, size=SIZE, count=60)


def noisy(scene: scenes.Scene) -> np.ndarray:
    rng = np.random.default_rng(0)
    noise = rng.standard_normal((2, *scene.images.shape))
    return np.maximum(scene.images * (1.0 + 0.02 * noise[0]) + 0.003 * noise[1], 0.0)


@pytest.mark.parametrize("name", ["sphere", "hills"])
def test_the_diffuse_part_of_glossy_images_is_exact_up_to_a_linear_map(name):
    scene = glossy(name, uneven=True)
    factors = diffuse_factors(scene.images[:, scene.mask].mean(-1).T)
    truth = scene.lights * scene.intensities[:, None]
    linear = np.linalg.lstsq(factors.lights.T, truth, rcond=None)[0]
    assert angle_degrees(factors.lights.T @ linear, truth).mean() < 1.0
    assert angle_degrees(factors.surface @ np.linalg.inv(linear.T), scene.normals[scene.mask]).mean() < 1.0


def test_few_pixels_find_the_lights_and_all_pixels_follow():
    scene = glossy("sphere")
    profiles = scene.images[:, scene.mask].mean(-1).T
    some, every = diffuse_factors(profiles, samples=400), diffuse_factors(profiles)
    whole = np.abs(every.surface @ every.lights).mean()
    assert np.abs(some.surface @ some.lights - every.surface @ every.lights).mean() < 0.03 * whole
    known = diffuse_surface(profiles, scene.lights.astype(float))
    assert angle_degrees(known, scene.normals[scene.mask]).mean() < 0.5


def test_the_search_finds_a_far_minimum_and_survives_holes():
    truth = Gbr(1.3, -0.8, 2.1)

    def energy(gbr: Gbr) -> float:
        if gbr.mu < -2.0:
            return float("nan")
        return (gbr.mu - truth.mu) ** 2 + (gbr.nu - truth.nu) ** 2 + np.log(gbr.lam / truth.lam) ** 2

    found, lowest = minimise_over_bas_reliefs(energy, [Gbr()])
    np.testing.assert_allclose([found.mu, found.nu, found.lam], [truth.mu, truth.nu, truth.lam], atol=0.01)
    assert lowest < 1e-4


@pytest.mark.parametrize("name", ["sphere", "hills"])
def test_the_energy_is_lowest_at_the_truth(name):
    scene = glossy(name)
    prepared = prepare(scene.images, scene.mask, front="diffuse")
    right = equal_intensity(prepared.factors)  # the truth here: the lights are equal
    energy = symmetry_energy(prepared, np.arange(1000), np.arange(20), 0.0)
    assert energy(right) < 0.05
    for wrong in (Gbr(0.3, 0.0, 1.0), Gbr(0.0, -0.3, 1.0), Gbr(0.0, 0.0, 1.5), Gbr(0.0, 0.0, 0.66)):
        assert energy(right.then(wrong)) > 4.0 * energy(right)


@pytest.mark.parametrize(
    ("name", "uneven"),
    [
        pytest.param("sphere", False, marks=pytest.mark.slow),
        pytest.param("hills", False, marks=pytest.mark.slow),
        pytest.param("sphere", True, marks=pytest.mark.slow),
        ("hills", True),
    ],
)
def test_far_better_than_the_factorisation(name, uneven):
    scene = glossy(name, uneven=uneven)
    plain = scene.errors(factorisation(scene.images, scene.mask, front="none"))
    found = reflectance_symmetry(scene.images, scene.mask)
    normal, direction, intensity = scene.errors(found)
    assert normal < min(2.5, 0.25 * plain[0])
    assert direction < min(2.5, 0.25 * plain[1])
    assert intensity < 0.03
    assert found.notes.highlights
    assert found.notes.energy <= found.notes.equal_energy


@pytest.mark.slow
def test_highlights_beat_equal_intensities_when_lights_are_uneven():
    scene = glossy("hills", uneven=True)
    prepared = prepare(scene.images, scene.mask, front="diffuse")
    equal = scene.errors(conclude(prepared, equal_intensity(prepared.factors)))
    assert equal[0] > 3.0
    assert scene.errors(reflectance_symmetry(scene.images, scene.mask))[0] < 0.4 * equal[0]


@pytest.mark.slow
def test_intensities_that_rise_with_height_are_no_trap():
    normals, mask = scenes.hills(SIZE)
    lights = scenes.lights(60, 3)
    scene = scenes.glossy(normals, mask, lights, intensities=0.2 + 1.8 * (lights[:, 2] - 0.3) / 0.7)
    assert scene.errors(reflectance_symmetry(scene.images, mask))[0] < 3.0


@pytest.mark.slow
def test_noise_is_survived():
    scene = glossy("hills", uneven=True)
    assert scene.errors(reflectance_symmetry(noisy(scene), scene.mask))[0] < 4.0


def test_a_diffuse_object_falls_back_with_a_warning(caplog):
    normals, mask = scenes.hills(SIZE)
    scene = scenes.lambertian(normals, mask, scenes.lights(30))
    with caplog.at_level(logging.WARNING):
        found = reflectance_symmetry(scene.images, mask)
    assert "no highlights" in caplog.text
    assert not found.notes.highlights
    assert scene.errors(found)[0] < 1.5


def test_seeded():
    scene = glossy("sphere", count=20)
    first, second = (reflectance_symmetry(scene.images, scene.mask, samples=300, seed=1) for _ in range(2))
    np.testing.assert_array_equal(first.normals, second.normals)


def test_a_cylinder_in_shadow_is_refused():
    x, y = np.meshgrid(*2 * [np.linspace(-1.0, 1.0, SIZE)])
    normals = np.stack([x, np.zeros_like(x), np.sqrt(1.0 - x**2)], axis=-1)
    scene = scenes.lambertian(normals, (abs(x) < 0.85) & (abs(y) < 0.8), scenes.lights(40, 1))
    for front in ("diffuse", "low-rank"):
        with pytest.raises(InputError, match=r"fewer than three dimensions|along one direction"):
            prepare(scene.images, scene.mask, front=front)


def test_bad_input():
    scene = glossy("sphere", count=8)
    with pytest.raises(InputError, match="at least 6 images"):
        reflectance_symmetry(scene.images[:5], scene.mask)
    with pytest.raises(InputError, match="mask is empty"):
        reflectance_symmetry(scene.images, np.zeros_like(scene.mask))
    with pytest.raises(InputError, match="samples"):
        reflectance_symmetry(scene.images, scene.mask, samples=10)
    flat = np.zeros((8, SIZE, SIZE, 3)) + scene.lights[:, 2][:, None, None, None]
    with pytest.raises(InputError, match="fewer than three dimensions"):
        reflectance_symmetry(flat, scene.mask)
