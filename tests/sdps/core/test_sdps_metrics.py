"""Metrics, baseline and least squares against numbers worked out by hand."""

import numpy as np
import pytest
from sdps_scenes import hemisphere_lights, shade, sphere_normals

from render.shared.errors import InputError
from sdps.classical.least_squares import least_squares
from sdps.core.estimate import Estimate, constant_estimate
from sdps.core.metrics import angle_degrees, direction_mae, intensity_error, normal_error_map, normal_mae, score


def tilted(degrees: float) -> np.ndarray:
    return np.array([np.sin(np.radians(degrees)), 0.0, np.cos(np.radians(degrees))])


def test_angles_of_known_pairs() -> None:
    front = np.array([0.0, 0.0, 1.0])
    others = np.array([[0.0, 0.0, 2.0], [0.0, 3.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 1.0], [0.0, 0.0, 0.0]])
    np.testing.assert_allclose(angle_degrees(front, others), [0.0, 90.0, 180.0, 45.0, 90.0], atol=1e-6)


def test_normal_mae_is_the_mean_over_the_mask_only() -> None:
    truth = np.zeros((2, 2, 3))
    truth[..., 2] = 1.0
    estimate = np.array([[tilted(10.0), tilted(30.0)], [tilted(50.0), tilted(170.0)]])
    mask = np.array([[True, True], [True, False]])
    assert normal_mae(estimate, truth, mask) == pytest.approx(30.0)
    errors = normal_error_map(estimate, truth, mask)
    assert np.isnan(errors[1, 1])
    np.testing.assert_allclose(errors[mask], [10.0, 30.0, 50.0], rtol=1e-5)


def test_direction_mae_of_ten_and_twenty_degrees() -> None:
    estimate = np.stack([tilted(10.0), tilted(-20.0)])
    assert direction_mae(estimate, np.tile(tilted(0.0), (2, 1))) == pytest.approx(15.0)


def test_intensity_error_ignores_scale() -> None:
    truth = np.array([0.5, 1.0, 2.0])
    assert intensity_error(7.0 * truth, truth) == pytest.approx(0.0, abs=1e-7)


def test_intensity_error_by_hand() -> None:
    # Truth relative to the first image: (1, 2); estimate (1, 1); s = (1 + 2) / 2; errors 0.5 / 1 and 0.5 / 2.
    assert intensity_error(np.array([1.0, 1.0]), np.array([3.0, 6.0])) == pytest.approx(0.375)


def test_intensity_error_divides_coloured_lights_by_the_first_image() -> None:
    # Per channel the second light is twice, four times and twice the first: (1,1,1), (2,4,2); estimate (1, 2).
    # s = (3 + 2*8) / (3 + 12) = 19/15; errors 4/15 three times, then 8/30 twice and |4 - 38/15| / 4 = 22/60.
    truth = np.array([[1.0, 0.5, 2.0], [2.0, 2.0, 4.0]])
    expected = (3 * 4 / 15 + 2 * (38 / 15 - 2) / 2 + (4 - 38 / 15) / 4) / 6
    assert intensity_error(np.array([1.0, 2.0]), truth) == pytest.approx(expected)


def test_scores_carry_their_definition() -> None:
    truth, mask = sphere_normals(32)
    found = score(Estimate(truth, np.eye(3), np.ones(3)), mask, normals=truth, light_directions=np.eye(3))
    values = {entry.name: entry.value for entry in found}
    assert values["normal_mae"] == pytest.approx(0.0, abs=0.05)
    assert values["normal_within_11.25"] == 1.0
    assert values["direction_mae"] == pytest.approx(0.0, abs=1e-6)
    assert all(entry.definition for entry in found)


def test_mismatched_sizes_are_named() -> None:
    truth, mask = sphere_normals(16)
    with pytest.raises(InputError, match="one size"):
        normal_mae(truth[:8], truth, mask)
    with pytest.raises(InputError, match="empty"):
        normal_mae(truth, truth, np.zeros_like(mask))
    with pytest.raises(InputError, match="2 estimated"):
        direction_mae(np.eye(3)[:2], np.eye(3))


def test_constant_baseline_on_a_sphere() -> None:
    # On a whole sphere's disc the mean angle to the view axis is 45 degrees: the integral of
    # 2 r asin(r) over [0, 1] is pi / 4.
    truth, mask = sphere_normals(256, radius=0.95)
    mask = (truth**2).sum(-1) > 0.5
    estimate = constant_estimate(5, mask)
    limit = np.sqrt(0.98)
    mean = np.degrees((limit**2 - 0.5) * np.arcsin(limit) + 0.5 * limit * np.sqrt(1 - limit**2)) / limit**2
    assert normal_mae(estimate.normals, truth, mask) == pytest.approx(mean, abs=0.3)
    assert estimate.light_directions.shape == (5, 3)


def test_least_squares_is_exact_without_shadows() -> None:
    normals, mask = sphere_normals(48)
    lights = np.array([[0.1, 0.0, 1.0], [-0.1, 0.1, 1.0], [0.0, -0.1, 1.0], [0.1, 0.1, 1.0]])
    lights /= np.linalg.norm(lights, axis=1, keepdims=True)
    gains = np.array([0.5, 1.0, 2.0, 1.5])
    mask &= (normals @ lights.T > 0.0).all(-1)
    estimate = least_squares(shade(normals, lights, 0.6) * gains[:, None, None, None], mask, lights, gains)
    assert normal_mae(estimate.normals, normals, mask) < 0.02
    np.testing.assert_allclose(estimate.notes.albedo[mask], 0.6, rtol=1e-4)


def test_shadow_threshold_repairs_attached_shadows() -> None:
    normals, mask = sphere_normals(64)
    lights = hemisphere_lights(24, np.random.default_rng(1), lowest=0.5)
    images = shade(normals, lights)
    plain = normal_mae(least_squares(images, mask, lights).normals, normals, mask)
    robust = normal_mae(least_squares(images, mask, lights, shadow_threshold=0.02).normals, normals, mask)
    assert plain > 2.0
    assert robust < 0.2


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"images": slice(0, 2)}, "at least 3 images"),
        ({"lights": np.array([[0, 0, 1], [0, 1, 1], [0, -1, 1], [0, 2, 1]], float)}, "coplanar"),
        ({"mask": False}, "mask is empty"),
        ({"value": np.nan}, "NaN"),
        ({"gains": np.array([1.0, 0.0, 1.0, 1.0])}, "must be positive"),
        ({"gains": np.ones(3)}, "4 images need 4"),
    ],
)
def test_degenerate_least_squares_input(change: dict, message: str) -> None:
    normals, mask = sphere_normals(16)
    lights = change.get("lights", hemisphere_lights(4, np.random.default_rng(0)))
    images = shade(normals, lights)
    images[0, 8, 8] = change.get("value", images[0, 8, 8])
    part = change.get("images", slice(None))
    with pytest.raises(InputError, match=message) as error:
        least_squares(images[part], mask & change.get("mask", True), lights[part], change.get("gains"))
    assert "\n" not in str(error.value)
