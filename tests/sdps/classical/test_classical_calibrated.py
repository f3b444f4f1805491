"""Calibrated least squares and its robust variants."""

import os
import zipfile
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from classical_scenes import Scene, glossy, hills, lambertian, lights, sphere

from render.exchange.layouts import LAYOUTS
from render.shared.errors import InputError
from sdps.classical.least_squares import least_squares
from sdps.classical.robust import low_rank_least_squares, position_threshold, robust_least_squares
from sdps.core.metrics import normal_mae

ROBUST = (position_threshold, robust_least_squares, low_rank_least_squares)
DATA = os.environ.get("SDPS_SHARED_DATA")


def mae(method, scene: Scene, **options) -> float:
    estimate = method(scene.images, scene.mask, scene.lights, scene.intensities, **options)
    return normal_mae(estimate.normals, scene.normals, scene.mask)


@pytest.mark.parametrize("method", [least_squares, *ROBUST])
def test_exact_on_lambertian_images_without_shadows(method):
    gains = np.random.default_rng(1).uniform(0.5, 2.0, 24)
    scene = lambertian(*hills(48), lights(24), intensities=gains, shadows=False)
    estimate = method(scene.images, scene.mask, scene.lights, gains)
    assert normal_mae(estimate.normals, scene.normals, scene.mask) < 0.05
    np.testing.assert_allclose(estimate.notes.albedo[scene.mask], 0.7, rtol=2e-3)
    np.testing.assert_allclose(estimate.intensities, gains, rtol=1e-6)
    assert not estimate.normals[~scene.mask].any()


@pytest.mark.parametrize(
    ("method", "share"), [(position_threshold, 0.75), (robust_least_squares, 0.75), (low_rank_least_squares, 0.9)]
)
def test_robust_variants_beat_plain_on_a_glossy_sphere(method, share):
    scene = glossy(*sphere(32), lights(60, lowest=0.5), intensities=np.random.default_rng(2).uniform(0.5, 2.0, 60))
    assert mae(method, scene) < share * mae(least_squares, scene)


def test_middle_positions_by_hand():
    """Two highlights and a shadow at ranks 10, 9 and 1 of ten images leave the answer exact."""
    scene = lambertian(*hills(24), lights(10, lowest=0.7), shadows=False)
    images = scene.images.copy()
    images[0] += 5.0
    images[1] += 7.0
    images[2] = -1.0
    estimate = position_threshold(images, scene.mask, scene.lights)
    assert estimate.notes.kept == 6
    assert normal_mae(estimate.normals, scene.normals, scene.mask) < 0.05
    assert normal_mae(least_squares(images, scene.mask, scene.lights).normals, scene.normals, scene.mask) > 10.0


def test_least_absolute_minimises_the_sum_of_absolute_residuals():
    scene = glossy(*sphere(24), lights(30, lowest=0.5))
    profiles = scene.images[:, scene.mask, 0].T

    def cost(method) -> np.ndarray:
        estimate = method(scene.images, scene.mask, scene.lights)
        vectors = estimate.normals[scene.mask] * estimate.notes.albedo[scene.mask][:, None]
        return np.abs(profiles - vectors @ scene.lights.T).sum(1)

    best = cost(partial(robust_least_squares, iterations=200, floor=1e-5))
    assert (best <= 1.001 * cost(least_squares)).all()
    assert (best <= 1.1 * cost(position_threshold)).all()


def test_pixels_in_shadow_fall_back_and_say_so(caplog):
    lit = lights(8, lowest=0.8)
    lit[5:] = lit[0]  # the brightest directions are few, so the middle ones may coincide
    scene = lambertian(*hills(24), lit)
    estimate = position_threshold(scene.images, scene.mask, lit, drop_lowest=0.6, drop_highest=0.0)
    assert np.isfinite(estimate.normals).all()
    assert estimate.notes.unresolved > 0.05
    assert "coplanar" in caplog.text


@pytest.mark.parametrize("method", [least_squares, *ROBUST])
@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"count": 2}, "at least 3 images"),
        ({"lights": np.array([[0, 0, 1], [0, 1, 1], [0, -1, 1], [0, 2, 1]], float)}, "coplanar"),
        ({"lights": np.array([[0, 0, 1], [0, 1, 1], [1, -1, 1], [0, 0, 0]], float)}, r"\(0, 0, 0\)"),
        ({"mask": False}, "mask is empty"),
        ({"value": np.nan}, "NaN"),
        ({"gains": np.ones((4, 2))}, "do not fit"),
        ({"flat": True}, "alike"),
    ],
)
def test_degenerate_input(method, change, message):
    scene = lambertian(*hills(16), lights(4))
    images = np.ones_like(scene.images) if change.get("flat") else scene.images.copy()
    images[0, 8, 8] = change.get("value", images[0, 8, 8])
    count = change.get("count", 4)
    directions = change.get("lights", scene.lights)[:count]
    with pytest.raises(InputError, match=message) as error:
        method(images[:count], scene.mask & change.get("mask", True), directions, change.get("gains"))
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("method", "options"),
    [
        (least_squares, {"shadow_threshold": 1.0}),
        (position_threshold, {"drop_lowest": 0.5, "drop_highest": 0.5}),
        (position_threshold, {"drop_lowest": 0.4, "drop_highest": 0.4}),
        (robust_least_squares, {"iterations": 0}),
    ],
)
def test_options_out_of_range(method, options):
    with pytest.raises(InputError):
        mae(method, lambertian(*hills(16), lights(6)), **options)


@pytest.mark.skipif(not DATA, reason="SDPS_SHARED_DATA names no folder with diligent_ball.zip")
def test_the_diligent_ball(tmp_path):
    """4.17 degrees with all 96 images and no handling of shadows: the benchmark's own baseline."""
    with zipfile.ZipFile(Path(DATA) / "diligent_ball.zip") as archive:
        archive.extractall(tmp_path)
    (read,) = LAYOUTS["diligent"].list_samples(tmp_path / "ballPNG")
    source = read()
    truth = source.truth()
    images, _ = source.stack(truth.mask.shape)  # divided by the intensities

    def error(method) -> float:
        return normal_mae(method(images, truth.mask, source.directions).normals, truth.normals, truth.mask)

    plain = error(least_squares)
    assert plain == pytest.approx(4.17, abs=0.02)
    for method in ROBUST:
        assert error(method) < plain - 0.5, method.__name__
