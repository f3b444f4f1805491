"""LC18: normals by half-vector symmetry, with and without known lights."""

import logging
from functools import partial

import classical_scenes as scenes
import numpy as np
import pytest

from render.shared.errors import InputError
from sdps.classical.common.isotropy import asymmetries, azimuths, intensity_corrections, log_values
from sdps.classical.half_vector import half_vector
from sdps.classical.least_squares import least_squares
from sdps.classical.plain import factorisation
from sdps.core.metrics import angle_degrees

SIZE = 40
glossy = partial(scenes.glossy_shape, size=SIZE, count=100)


def profiles(scene: scenes.Scene) -> np.ndarray:
    return scene.images[:, scene.mask].mean(-1).T


def test_the_asymmetry_is_lowest_at_the_true_normals():
    scene = glossy("hills")
    values, truth = log_values(profiles(scene), np.ones(100)), scene.normals[scene.mask].astype(float)
    lights = scene.lights.astype(float)
    right = asymmetries(values, truth, lights)
    assert right.mean() < 0.1
    for offset in ([0.15, 0.0, 0.0], [0.0, -0.15, 0.0], [-0.1, 0.1, 0.0]):
        moved = truth + offset
        moved /= np.linalg.norm(moved, axis=1, keepdims=True)
        assert asymmetries(values, moved, lights).mean() > 1.5 * right.mean()


def test_azimuths_of_mirror_symmetry():
    scene = glossy("sphere")
    truth = scene.normals[scene.mask]
    steep = truth[:, 2] < 0.9
    found = azimuths(log_values(profiles(scene), np.ones(100)), scene.lights.astype(float))
    true = np.arctan2(truth[:, 1], truth[:, 0])
    apart = np.degrees(np.abs((found - true + np.pi / 2) % np.pi - np.pi / 2))
    assert np.median(apart[steep]) < 6.0


def test_intensities_are_read_off_the_neighbours_in_theta_h():
    scene = glossy("sphere")
    wrong = np.random.default_rng(0).uniform(0.8, 1.25, 100)
    found = intensity_corrections(
        log_values(profiles(scene), wrong), scene.normals[scene.mask].astype(float), scene.lights.astype(float)
    )
    left = np.log(found * wrong)
    assert left.std() < 0.6 * np.log(wrong).std()


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
    found = half_vector(scene.images, scene.mask)
    normal, direction, intensity = scene.errors(found)
    assert normal < min(3.0, 0.25 * plain[0])
    assert direction < min(2.5, 0.25 * plain[1])
    assert intensity < 0.03
    assert found.notes.highlights


def test_known_lights_and_a_wide_lobe_beat_least_squares():
    scene = glossy("hills", uneven=True, roughness=0.35)
    known = {"light_directions": scene.lights, "intensities": scene.intensities}
    found = half_vector(scene.images, scene.mask, **known)
    plain = least_squares(scene.images, scene.mask, scene.lights, scene.intensities)
    assert scene.errors(found)[0] < min(1.5, 0.25 * scene.errors(plain)[0])
    np.testing.assert_allclose(found.light_directions, scene.lights, atol=1e-6)
    np.testing.assert_allclose(found.intensities, scene.intensities / scene.intensities.mean(), rtol=1e-6)


def test_the_solution_of_some_pixels_is_carried_to_all():
    scene = glossy("sphere", roughness=0.35)
    found = half_vector(scene.images, scene.mask, light_directions=scene.lights, samples=300, updates=0)
    assert found.notes.solved == 300
    assert scene.errors(found)[0] < 2.0
    assert angle_degrees(found.normals[scene.mask], scene.normals[scene.mask]).max() < 20.0
    assert (found.normals[~scene.mask] == 0.0).all()


def test_a_diffuse_object_falls_back_with_a_warning(caplog):
    normals, mask = scenes.sphere(SIZE)
    scene = scenes.lambertian(normals, mask, scenes.lights(60))
    with caplog.at_level(logging.WARNING):
        found = half_vector(scene.images, mask)
    assert "equal light intensities" in caplog.text
    assert not found.notes.highlights
    assert scene.errors(found)[0] < 2.0


def test_few_images_draw_a_warning_and_fewer_an_error(caplog):
    scene = glossy("sphere", count=20)
    with caplog.at_level(logging.WARNING):
        found = half_vector(scene.images, scene.mask, samples=200)
    assert "wants 50 images" in caplog.text
    assert np.isfinite(found.normals).all()
    with pytest.raises(InputError, match="at least 10 images"):
        half_vector(scene.images[:9], scene.mask)


def test_bad_lights():
    scene = glossy("sphere", count=60)
    with pytest.raises(InputError, match="60 images need"):
        half_vector(scene.images, scene.mask, light_directions=scene.lights[:-1])
    with pytest.raises(InputError, match="positive"):
        half_vector(scene.images, scene.mask, light_directions=scene.lights, intensities=np.zeros(60))
    with pytest.raises(InputError, match="without light_directions"):
        half_vector(scene.images, scene.mask, intensities=np.ones(60))
    with pytest.raises(InputError, match="samples"):
        half_vector(scene.images, scene.mask, samples=1)


def test_samples_below_zero_count_as_black():
    below = np.random.default_rng(0).uniform(-0.2, 1.0, (5, 7))
    np.testing.assert_array_equal(log_values(below, np.ones(7)), log_values(below.clip(0.0), np.ones(7)))
