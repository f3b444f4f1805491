"""PF14: exact where its assumptions hold, independent of the starting ambiguity, and steady under false maxima."""

import classical_scenes as scenes
import numpy as np
import pytest

from render.shared.errors import InputError
from sdps.classical import diffuse_maxima as pf14
from sdps.classical.common.front_end import Prepared, conclude, prepare
from sdps.classical.common.gbr import Gbr
from sdps.core.metrics import angle_degrees


@pytest.fixture(scope="module")
def scene() -> scenes.Scene:
    """A smooth hill without shadows, so that the images are exactly of rank 3, under unequal lights."""
    normals, mask = scenes.hills(128)
    gains = np.random.default_rng(0).uniform(0.5, 1.5, 40)
    return scenes.lambertian(normals, mask, scenes.lights(40, 3, 0.5), intensities=gains, shadows=False)


@pytest.fixture(scope="module")
def prepared(scene: scenes.Scene) -> Prepared:
    return prepare(scene.images, scene.mask, front="none")


def solve(prepared: Prepared, maxima: pf14.Maxima, start: Gbr | None = None) -> np.ndarray:
    """Return the normals (H, W, 3) found from factors that a transformation has put elsewhere first."""
    start = start or Gbr()
    gbr = pf14.median_gbr(*pf14.intersect(prepared.factors.transform(start), maxima))
    return conclude(prepared, start.then(gbr)).normals


def test_exact_on_a_smooth_lambertian_surface(scene: scenes.Scene) -> None:
    estimate = pf14.diffuse_maxima(scene.images, scene.mask, front="none")
    normals, lights, intensities = scene.errors(estimate)
    assert normals < 2.0  # over seeds, 0.6 to 0.9
    assert lights < 2.0
    assert intensities < 0.02
    notes = estimate.notes
    assert notes.candidates > 100
    assert notes.intersections > 1000
    assert (notes.candidate_map >= 0).sum() == notes.candidates
    assert notes.candidate_map.max() < 40


def test_maxima_face_their_light(scene: scenes.Scene, prepared: Prepared) -> None:
    maxima = pf14.find_maxima(prepared.profiles, scene.mask)
    angles = angle_degrees(scene.normals[scene.mask][maxima.pixels], scene.lights[maxima.images])
    assert np.median(angles) < 6.0


@pytest.mark.parametrize("start", [Gbr(0.8, -1.3, 0.4), Gbr(-2.0, 0.5, 3.0), Gbr(0.3, 0.2, -0.7)])
def test_the_start_does_not_matter(scene: scenes.Scene, prepared: Prepared, start: Gbr) -> None:
    maxima = pf14.find_maxima(prepared.profiles, scene.mask)
    np.testing.assert_allclose(solve(prepared, maxima, start), solve(prepared, maxima), atol=1e-6)


def test_survives_false_maxima(scene: scenes.Scene, prepared: Prepared) -> None:
    maxima = pf14.find_maxima(prepared.profiles, scene.mask)
    rng, count = np.random.default_rng(1), len(maxima.pixels) // 2
    false = rng.integers(0, int(scene.mask.sum()), count), rng.integers(0, 40, count)
    mixed = pf14.Maxima(
        np.concatenate([maxima.pixels, false[0]]), np.concatenate([maxima.images, false[1]])
    )  # a third of all points, hence more than half of all pairs
    errors = angle_degrees(solve(prepared, mixed)[scene.mask], scene.normals[scene.mask])
    assert errors.mean() < 2.5


def test_a_single_pair_gives_the_transformation() -> None:
    """Two exact maxima (normal = light), moved by a known transformation, give back its inverse."""
    lights = scenes.lights(2, 5)
    scene = scenes.lambertian(*scenes.sphere(48), scenes.lights(6, 1), shadows=False)
    factors = prepare(scene.images, scene.mask, front="none").factors
    moved = Gbr(0.4, -0.6, 1.7)
    exact = type(factors)(surface=moved.surface(lights), lights=moved.lights(lights.T), singular=factors.singular)
    gbr = pf14.median_gbr(*pf14.intersect(exact, pf14.Maxima(np.array([0, 1]), np.array([0, 1]))))
    np.testing.assert_allclose((gbr.mu, gbr.nu, gbr.lam), (moved.inverse.mu, moved.inverse.nu, moved.inverse.lam), 1e-5)


def test_the_limit_thins_at_random_but_repeatably(scene: scenes.Scene) -> None:
    first, second, other = (
        pf14.diffuse_maxima(scene.images, scene.mask, front="none", limit=80, seed=seed) for seed in (0, 0, 1)
    )
    assert first.notes.gbr == second.notes.gbr != other.notes.gbr
    assert scene.errors(first)[0] < 3.0


def test_albedo_maxima_are_dropped() -> None:
    """A bright spot of paint is brightest under every light, and says nothing of its slope."""
    normals, mask = scenes.sphere(96)
    albedo = np.full((96, 96, 1), 0.4)
    albedo[60:64, 40:44] = 1.0
    scene = scenes.lambertian(normals, mask, scenes.lights(12, 2, 0.6), albedo=albedo)
    maxima = pf14.find_maxima(scene.images[:, mask].mean(-1).T, mask)
    found = np.zeros(mask.shape, bool)
    found[mask] = np.isin(np.arange(mask.sum()), maxima.pixels)
    assert found.any()
    assert not found[61:63, 41:43].any()


def test_no_maximum_is_an_error() -> None:
    mask = np.ones((40, 40), bool)
    ramp = np.linspace(0.2, 1.0, 40)[None].repeat(40, 0)
    profiles = np.stack([ramp[mask], ramp[:, ::-1][mask], ramp.T[mask]], axis=1)  # brightest at the edge only
    with pytest.raises(InputError, match="no pixel is brightest in one image only"):
        pf14.find_maxima(profiles, mask)


def test_points_that_never_agree_are_an_error(prepared: Prepared) -> None:
    with pytest.raises(InputError, match="agree on no transformation"):
        pf14.intersect(prepared.factors, pf14.Maxima(np.array([5]), np.array([0])))


def test_bad_smoothing_is_an_error(scene: scenes.Scene) -> None:
    with pytest.raises(InputError, match="smoothing must be positive"):
        pf14.diffuse_maxima(scene.images, scene.mask, front="none", smoothing=0.0)
