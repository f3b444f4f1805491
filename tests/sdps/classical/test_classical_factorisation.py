"""The front end of the uncalibrated methods: the bas-relief group, robust low rank, factorisation, orientation."""

import logging

import classical_scenes as scenes
import numpy as np
import pytest

from render.shared.errors import InputError
from sdps.classical import registry
from sdps.classical.common.factorisation import Factors, factorise, impose_integrability, orient, outward_score
from sdps.classical.common.front_end import prepare
from sdps.classical.common.gbr import Gbr
from sdps.classical.common.observations import observe
from sdps.classical.common.rpca import robust_low_rank
from sdps.classical.plain import equal_intensity, factorisation


@pytest.fixture(scope="module")
def exact() -> scenes.Scene:
    """A textured Lambertian hill without shadows: images of exactly three dimensions."""
    normals, mask = scenes.hills()
    rng = np.random.default_rng(1)
    axis = np.linspace(0.0, 9.0, len(mask))
    albedo = (0.5 + 0.4 * np.sin(axis)[:, None] * np.cos(axis)[None])[..., None]
    gains = rng.uniform(0.5, 2.0, 30)
    return scenes.lambertian(normals, mask, scenes.lights(30), albedo=albedo, intensities=gains, shadows=False)


def truth(scene: scenes.Scene) -> np.ndarray:  # (P, 3)
    """Return albedo times normal."""
    lights = scene.lights * scene.intensities[:, None]
    grey = scene.images.mean(-1)[:, scene.mask].T
    return np.linalg.lstsq(lights, grey.T, rcond=None)[0].T


def test_bas_relief_transformations_form_a_group():
    first, second = Gbr(0.3, -0.2, 1.5), Gbr(-1.0, 0.4, 0.5)
    assert np.allclose(first.then(second).matrix, first.matrix @ second.matrix)
    assert np.allclose(first.then(first.inverse).matrix, np.eye(3))


def test_bas_relief_transformation_leaves_the_images_alone():
    rng = np.random.default_rng(0)
    surface, lights = rng.normal(size=(50, 3)), rng.normal(size=(3, 7))
    moved, lit = Gbr(0.3, -0.2, 1.5).apply(surface, lights)
    assert np.allclose(moved @ lit, surface @ lights)


@pytest.mark.parametrize("parameters", [(0.0, 0.0, 0.0), (np.nan, 0.0, 1.0)])
def test_no_bas_relief_transformation_without_depth(parameters):
    with pytest.raises(InputError, match="lambda other than 0"):
        Gbr(*parameters)


def test_integrability_leaves_exactly_a_bas_relief_transformation(exact):
    """Entries off the pattern of `Gbr` stay under 1e-3 (spec: 3e-4 at 128x128), whatever the albedo."""
    factors = impose_integrability(factorise(exact.images.mean(-1)[:, exact.mask].T), exact.mask, smoothing=0.0)
    matrix = np.linalg.lstsq(truth(exact), factors.surface, rcond=None)[0]
    matrix /= matrix[0, 0]
    assert np.abs(matrix[:2] - np.eye(3)[:2]).max() < 1e-3
    assert np.abs(matrix[2, 2]) > 0.05


def test_equal_lights_resolve_the_ambiguity():
    normals, mask = scenes.hills()
    scene = scenes.lambertian(normals, mask, scenes.lights(30), shadows=False)
    normal, direction, intensity = scene.errors(factorisation(scene.images, mask, front="none"))
    assert normal < 0.2 and direction < 0.2 and intensity < 0.01


def test_equal_intensity_undoes_any_transformation(exact):
    surface, lights = truth(exact), exact.lights.T.astype(np.float64)  # all of strength one
    factors = Factors(surface, lights, np.ones(3)).transform(Gbr(0.4, -0.3, 0.6))
    recovered = factors.transform(equal_intensity(factors))
    assert np.allclose(recovered.lights, lights, atol=1e-4)


def test_contour_tells_convex_from_concave():
    normals, mask = scenes.sphere()
    assert outward_score(normals[mask], mask) > 0.5
    scene = scenes.lambertian(normals, mask, scenes.lights(12), shadows=False)
    prepared = prepare(scene.images, mask, front="none")
    for flip in ([1, 1, -1], [-1, -1, 1], [-1, -1, -1]):
        flipped = Factors(prepared.factors.surface * flip, prepared.factors.lights, prepared.factors.singular)
        assert np.allclose(orient(flipped, mask).surface, prepared.factors.surface)


def test_object_cut_by_the_frame_is_judged_by_its_true_contour():
    normals, mask = scenes.sphere()
    half = (slice(None), slice(0, 48))
    assert outward_score(normals[half][mask[half]], mask[half]) > 0.5


def test_robust_low_rank_takes_sparse_outliers_out():
    rng = np.random.default_rng(0)
    clean = rng.random((2000, 3)) @ rng.random((3, 40))
    outliers = np.where(rng.random(clean.shape) < 0.1, rng.uniform(0, 5, clean.shape), 0.0)
    assert np.abs(robust_low_rank(clean + outliers) - clean).max() < 1e-2


def test_robust_low_rank_of_nothing_is_nothing():
    assert not robust_low_rank(np.zeros((50, 8))).any()


def test_robust_low_rank_says_when_it_did_not_settle(caplog):
    with caplog.at_level(logging.WARNING):
        robust_low_rank(np.random.default_rng(0).random((50, 8)), limit=2)
    assert "did not settle" in caplog.text


def images_of(normals: np.ndarray, lights: np.ndarray) -> np.ndarray:
    mask = np.ones(normals.shape[:2], bool)
    return scenes.lambertian(normals, mask, lights).images


UNCALIBRATED = [name for name, item in registry.METHODS.items() if not item.calibrated]
MASK = np.ones((40, 40), bool)


@pytest.mark.parametrize("name", UNCALIBRATED)
def test_degenerate_input_is_refused(name):
    rng = np.random.default_rng(0)
    fine = rng.uniform(0.1, 1.0, (60, 40, 40, 3))
    broken = fine.copy()
    broken[3, 20, 20, 1] = np.nan
    cases = {
        "at least": fine[:2],
        "do not fit": fine[:, :30],
        "NaN": broken,
        "alike": np.broadcast_to(fine[:1], fine.shape),
        "black": np.zeros_like(fine),
    }
    for message, images in cases.items():
        with pytest.raises(InputError, match=message):
            registry.run(name, images, MASK)
    with pytest.raises(InputError, match="mask is empty"):
        registry.run(name, fine, np.zeros_like(MASK))


@pytest.mark.parametrize("name", [name for name in UNCALIBRATED if name != "lm13"])
def test_flat_objects_and_coplanar_lights_are_refused(name):
    flat = np.broadcast_to(np.array([0.0, 0.0, 1.0]), (40, 40, 3))
    with pytest.raises(InputError, match=r"fewer than three dimensions|alike"):
        registry.run(name, images_of(flat, scenes.lights(60)), MASK)
    normals, mask = scenes.hills(40)
    lights = scenes.lights(60) * np.array([1.0, 0.0, 1.0])
    images = scenes.lambertian(normals, mask, lights / np.linalg.norm(lights, axis=1, keepdims=True), shadows=False)
    with pytest.raises(InputError, match="fewer than three dimensions"):
        registry.run(name, images.images, mask)


def test_black_images_draw_a_warning(caplog):
    images = np.random.default_rng(0).uniform(0.1, 1.0, (6, 20, 20))
    images[2] = 0.0
    with caplog.at_level(logging.WARNING):
        observe(images, np.ones((20, 20), bool))
    assert "1 of 6 images are black" in caplog.text


def test_weak_third_dimension_draws_a_warning(caplog):
    rng = np.random.default_rng(0)
    with caplog.at_level(logging.WARNING):
        factorise(rng.uniform(0.0, 1.0, (500, 12)))
    assert "expect large errors" in caplog.text


def test_tiny_object_is_refused():
    mask = np.zeros((40, 40), bool)
    mask[10:14, 10:14] = True
    normals, _ = scenes.hills(40)
    with pytest.raises(InputError, match="too few to differentiate"):
        factorisation(scenes.lambertian(normals, mask, scenes.lights(8)).images, mask)


def test_registry_suggests_the_nearest_and_asks_for_lights():
    with pytest.raises(InputError, match=r"did you mean 'pf14'"):
        registry.run("pf-14", np.zeros((4, 2, 2)), np.ones((2, 2), bool))
    with pytest.raises(InputError, match="needs the light directions"):
        registry.run("least-squares", np.zeros((4, 2, 2)), np.ones((2, 2), bool))


def test_unknown_front_end_is_refused():
    normals, mask = scenes.hills(40)
    with pytest.raises(InputError, match="did you mean 'low-rank'"):
        factorisation(scenes.lambertian(normals, mask, scenes.lights(8)).images, mask, front="lowrank")
