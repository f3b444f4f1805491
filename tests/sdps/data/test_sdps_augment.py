"""What happens to the images of a sample: exposure, intensities, noise, symmetries, which lights, the camera."""

from dataclasses import replace

import numpy as np
import pytest
from sdps_samples import PLAIN, options, rng
from sdps_scenes import hemisphere_lights, shade, sphere_normals

from render.shared.errors import InputError
from render.shared.imaging.sensor import SensorModel
from sdps.core.symmetry import Symmetry
from sdps.data.augment import Augmentation, augment, exposure_scale, measure_exposure
from sdps.data.dataset import choose_images


def test_plain_augmentation_changes_nothing() -> None:
    images = rng().random((3, 8, 8, 3), dtype=np.float32)
    out, intensities = augment(images, np.ones((8, 8), bool), PLAIN, rng())
    np.testing.assert_array_equal(out, images)
    np.testing.assert_array_equal(intensities, 1.0)


def test_paper_order_is_clip_exposure_intensities_noise() -> None:
    config = Augmentation(exposure="paper", exposure_range=(3.0, 3.0), noise=0.05)
    images = np.full((500, 2, 2, 3), 4.0, np.float32)
    images[:, 0] = 0.0  # background
    mask = np.array([[False, False], [True, True]])
    out, intensities = augment(images, mask, config, rng())
    # 4 saturates at 1, as in an 8-bit file; exposure and intensity then reach 6; noise comes last and everywhere.
    assert intensities.min() >= 0.2
    assert intensities.max() < 2.0
    residue = out[:, 1] - 3.0 * intensities[:, None, None]
    assert np.abs(residue).max() <= 0.0251
    assert np.abs(out[:, 0]).max() <= 0.025
    assert out[:, 0].std() == pytest.approx(0.05 / np.sqrt(12.0), rel=0.05)
    assert out.max() > 5.5


def test_intensities_are_equal_in_the_three_channels_and_independent_of_the_image() -> None:
    config = Augmentation(noise=0.0, clip=1e6)
    images = rng(1).random((4, 8, 8, 3), dtype=np.float32)
    out, intensities = augment(images, np.ones((8, 8), bool), config, rng())
    ratio = out / images / intensities[:, None, None, None]
    np.testing.assert_allclose(ratio, ratio[0, 0, 0, 0], rtol=1e-4)


@pytest.mark.parametrize("albedo", [0.003, 0.8])
def test_mean_exposure_brings_dark_and_bright_objects_to_one_level(albedo: float) -> None:
    normals, mask = sphere_normals(32)
    images = shade(normals, hemisphere_lights(6, rng()), albedo)
    config = Augmentation(mean_jitter=(1.0, 1.0), noise=0.0)
    out, _ = augment(images, mask, config, rng())
    assert out[:, mask].mean() == pytest.approx(0.3, rel=0.02)
    exposure = measure_exposure(images[:, mask], config)
    test = exposure.apply(images)
    assert test[:, mask].mean() == pytest.approx(0.3, rel=0.02)
    np.testing.assert_allclose(test, images * exposure.scale, rtol=1e-5)


def test_exposure_is_not_held_down_by_a_few_highlights() -> None:
    values = np.full(10_000, 0.01, np.float32)
    values[:50] = 200.0
    scale = exposure_scale(values, level=0.3, clip=4.0)
    assert np.minimum(values * scale, 4.0).mean() == pytest.approx(0.3, rel=0.03)
    # Without the clip the mean would be 1, of which the highlights hold nearly all.
    assert scale > 10 * 0.3 / values.mean()
    assert exposure_scale(np.zeros(9, np.float32), 0.3, 4.0) == 1.0


def test_paper_mode_exposes_dark_test_images_as_published() -> None:
    images = np.full((2, 4, 4, 3), 0.005, np.float32)
    exposure = measure_exposure(images[:, 1:], PLAIN)
    assert exposure.scale == pytest.approx(1.5 * 4.0, rel=1e-4)
    np.testing.assert_allclose(exposure.apply(images), 0.03, rtol=1e-4)


def turn(symmetry: Symmetry, images: np.ndarray, normals: np.ndarray, lights: np.ndarray) -> tuple[np.ndarray, ...]:
    """Turn a scene as `make_sample` does."""
    turned = symmetry.vectors(symmetry.images(normals, 0)), symmetry.vectors(lights)
    return symmetry.images(images, 1), *turned


@pytest.mark.parametrize("symmetry", [Symmetry(0, True), Symmetry(1), Symmetry(2), Symmetry(3, True)])
def test_symmetries_give_scenes_that_still_obey_lamberts_law(symmetry: Symmetry) -> None:
    normals, mask = sphere_normals(24)
    normals[:12, :12] = mask[:12, :12, None] * np.array([0.6, 0.0, 0.8], np.float32)  # no longer symmetric
    lights = hemisphere_lights(5, rng())
    turned = turn(symmetry, shade(normals, lights), normals, lights)
    np.testing.assert_allclose(turned[0], shade(*turned[1:]), atol=1e-6)
    assert not np.allclose(turned[1], normals)
    # A sphere's own normals are the same after any symmetry: the vectors turn with the pixels.
    sphere, _ = sphere_normals(24)
    np.testing.assert_allclose(turn(symmetry, shade(sphere, lights), sphere, lights)[1], sphere)


def test_augmentation_fields_are_checked() -> None:
    with pytest.raises(InputError, match=r"augmentation\.intensity_range"):
        Augmentation(intensity_range=(0.0, 2.0))
    with pytest.raises(InputError, match=r"augmentation\.mean_level"):
        Augmentation(mean_level=5.0, clip=4.0)
    with pytest.raises(InputError, match=r"frontal must leave biased its share 0\.7"):
        Augmentation(biased=0.7, frontal=0.4)


def test_biased_samples_have_the_lights_around_one_direction() -> None:
    directions = hemisphere_lights(64, rng(), lowest=0.05)
    plain = options(augmentation=PLAIN, images=8)
    biased = options(augmentation=replace(PLAIN, biased=1.0), images=8)
    spread, centres = {plain: [], biased: []}, []
    for seed in range(60):
        for kind, found in spread.items():
            chosen = choose_images(directions, kind, rng(seed))
            assert len(set(chosen)) == 8
            mean = directions[chosen].mean(0)
            found.append(np.linalg.norm(mean))  # 1 for lights that are all alike
        centres.append(mean / np.linalg.norm(mean))
        # Without a share of biased samples the stream of the plain ones is as it was.
        np.testing.assert_array_equal(choose_images(directions, plain, rng(seed)), rng(seed).permutation(64)[:8])
    assert np.mean(spread[biased]) > np.mean(spread[plain]) + 0.15
    assert np.std(centres, axis=0)[:2].min() > 0.3  # now around one direction, now around another


def test_frontal_samples_have_the_lights_nearest_to_the_camera() -> None:
    directions = hemisphere_lights(64, rng(), lowest=0.05)
    nearest = np.argsort(-directions[:, 2])
    frontal = options(augmentation=replace(PLAIN, frontal=1.0), images=8)
    counts = [np.isin(nearest, choose_images(directions, frontal, rng(seed))).nonzero()[0].max() for seed in range(60)]
    assert 7 <= min(counts) < 12 and 24 < max(counts) <= 31  # from as many as asked for to half of them
    mixed = options(augmentation=replace(PLAIN, biased=0.4, frontal=0.3), images=8)
    heights = np.array([directions[choose_images(directions, mixed, rng(seed)), 2].min() for seed in range(400)])
    assert 0.25 < np.mean(heights >= directions[nearest[31], 2]) < 0.4  # the frontal share, and a few biased ones


def test_a_perfect_camera_changes_nothing_and_a_bright_exposure_saturates_before_scaling() -> None:
    images, mask = rng().random((3, 32, 32, 3), dtype=np.float32), np.ones((32, 32), bool)
    perfect = SensorModel(
        stops=(0, 0), full_well=(1e12, 1e12), read_noise=(0, 0), bits=(16,), black_level=(0, 0), black_error=(0, 0),
        ambient=(0, 0), field_angle=(0, 0), blur=(0, 0), jpeg=0.0,
    )  # fmt: skip
    for exposure in ("mean", "paper"):
        plain = Augmentation(exposure=exposure, noise=0.0, clip=1.0)
        expected, _ = augment(images, mask, plain, rng(1))
        recorded, _ = augment(images, mask, replace(plain, sensor=perfect), rng(1))
        np.testing.assert_allclose(recorded, expected, rtol=0.015, atol=2e-4)  # `exposure_scale` to a per cent
    level = Augmentation(noise=0.0, mean_jitter=(1.0, 1.0), sensor=replace(perfect, stops=(3, 3)))
    bright, _ = augment(images, mask, level, rng(1))
    assert bright.mean() == pytest.approx(0.3, rel=0.02)
    assert (bright > 0.999 * bright.max()).mean() > 0.3 and bright.max() < 0.6  # a plateau below the clip
