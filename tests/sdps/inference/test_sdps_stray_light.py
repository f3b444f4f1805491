"""Stray light is found where the object is in shadow, taken off, and invented nowhere."""

import numpy as np
import pytest
from sdps_scenes import hemisphere_lights, shade, sphere_normals

from sdps.inference.image_source import survey
from sdps.inference.stray_light import remove_stray_light, stray_light


@pytest.fixture(scope="module")
def sphere() -> tuple[np.ndarray, np.ndarray]:
    """A matte sphere under 24 lights of unequal strength, all sides of it in shadow at times."""
    rng = np.random.default_rng(0)
    normals, mask = sphere_normals(64, radius=0.9)
    images = shade(normals, hemisphere_lights(24, rng)) * rng.uniform(0.2, 2.0, (24, 1, 1, 1)).astype(np.float32)
    return images.astype(np.float32), mask


def test_rendered_images_have_none(sphere: tuple) -> None:
    images, mask = sphere
    assert not stray_light(images[:, mask]).any()
    np.testing.assert_array_equal(remove_stray_light(images, np.zeros((24, 3), np.float32)), images)


def test_the_veil_of_every_image_and_channel_is_found(sphere: tuple) -> None:
    images, mask = sphere
    rng = np.random.default_rng(1)
    veil = rng.uniform(0.002, 0.006, (24, 3)).astype(np.float32)
    noisy = images + veil[:, None, None] + rng.normal(0.0, 0.0005, images.shape).astype(np.float32)
    found = stray_light(noisy[:, mask])
    np.testing.assert_allclose(found, veil, atol=0.001)
    scene = survey(noisy, mask, None, stray=True)
    shown = scene.read(0, 24)
    dark = mask & (images.max(-1) == 0.0)
    assert np.abs(shown[dark]).mean() < 0.0002
    lit = mask & (images.min(-1) > 0.1)
    np.testing.assert_allclose(shown[lit], images[lit], atol=0.005)
    np.testing.assert_array_equal(scene.stray, found)


def test_an_object_without_shadows_keeps_what_it_shows(sphere: tuple) -> None:
    normals, mask = sphere_normals(64, radius=0.9)
    mask &= normals[..., 2] > 0.8  # its middle, under lights near the camera
    frontal = hemisphere_lights(24, np.random.default_rng(2)) * np.array([0.3, 0.3, 1.0])
    frontal = (frontal / np.linalg.norm(frontal, axis=1, keepdims=True)).astype(np.float32)
    images = shade(normals, frontal).astype(np.float32)
    assert images[:, mask].min() > 0.05
    assert not stray_light(images[:, mask]).any()


def test_an_image_without_a_shadow_of_its_own_has_about_the_level_of_the_others(sphere: tuple) -> None:
    images, mask = sphere
    shadow = (images[..., 0] == 0.0) & mask
    veiled = images + np.float32(0.004)
    veiled[0, shadow[0]] = 0.5  # nothing dark is left in the first
    found = stray_light(veiled[:, mask])
    np.testing.assert_allclose(found[1:], 0.004, atol=0.001)
    assert 0.0 < found[0].max() <= 0.0081  # its darkest pixels are lit


def test_nothing_is_below_zero_where_too_much_was_taken_off(sphere: tuple) -> None:
    """A black level too high, or a dark frame: shadows lie below 0, and noise in them further; logarithms follow."""
    images, mask = sphere
    noisy = images - np.float32(0.004) + np.random.default_rng(3).normal(0.0, 0.001, images.shape).astype(np.float32)
    scene = survey(noisy, mask, None, stray=True)
    assert scene.stray.max() < 0.0
    shown = scene.read(0, 24)
    assert shown.min() == 0.0
    lit = mask & (images.min(-1) > 0.1)
    assert np.abs(shown[lit] - images[lit]).mean() < 0.002
