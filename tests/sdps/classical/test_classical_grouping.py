"""Groups of normals and albedos (SM10) on surfaces of several colours."""

import numpy as np
import pytest
from classical_scenes import Scene, hills, lambertian, lights, patches

from render.shared.errors import InputError
from sdps.classical.common.gbr import Gbr
from sdps.classical.grouping import grouping, solve_groups
from sdps.classical.plain import factorisation
from sdps.core.metrics import angle_degrees


def coloured(seed: int, count: int = 5, **options) -> Scene:
    rng = np.random.default_rng(seed)
    normals, mask = hills(64)
    gains = rng.uniform(0.5, 2.0, 24)
    albedo = patches(mask, count, rng)
    return lambertian(normals, mask, lights(24, seed, 0.7), albedo=albedo, intensities=gains, **options)


@pytest.mark.parametrize("groups", [1, 2, 5])
@pytest.mark.parametrize("gbr", [Gbr(0.4, -0.7, 0.6), Gbr(-1.5, 0.3, 2.5)])
def test_the_linear_system_is_exact(groups, gbr):
    rng = np.random.default_rng(groups)
    normals = hills(48)[0].astype(float)
    normals = normals[np.linalg.norm(normals, axis=-1) > 0.5]
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    index = rng.integers(groups, size=len(normals))
    truth = normals * rng.uniform(0.2, 1.0, groups)[index][:, None]
    found = solve_groups(gbr.inverse.surface(truth), index)
    assert angle_degrees(found.surface(gbr.inverse.surface(truth)), truth).max() < 1e-4
    np.testing.assert_allclose([found.mu, found.nu, found.lam], [gbr.mu, gbr.nu, gbr.lam], rtol=1e-6)


def test_one_normal_does_not_solve():
    surface = np.tile([0.2, 0.1, 0.9], (10, 1))
    assert solve_groups(surface, np.zeros(10, int)) is None


@pytest.mark.parametrize("count", [2, 5])
def test_exact_without_shadows(count):
    scene = coloured(0, count, shadows=False)
    estimate = grouping(scene.images, scene.mask, front="none")
    assert scene.errors(estimate)[0] < 0.5
    assert estimate.notes.albedo_groups == count
    assert estimate.notes.residual < 0.01


@pytest.mark.parametrize("front", ["none", "low-rank"])
def test_few_colours_with_shadows(front):
    scene = coloured(1)
    normals, directions, intensities = scene.errors(grouping(scene.images, scene.mask, front=front))
    assert normals < 4.0 and directions < 4.0 and intensities < 0.05
    assert normals < 0.5 * scene.errors(factorisation(scene.images, scene.mask, front=front))[0]


def test_a_uniform_object_is_one_group(caplog):
    normals, mask = hills(64)
    scene = lambertian(normals, mask, lights(24, 3, 0.7), albedo=np.array([0.6, 0.3, 0.2]), shadows=False)
    estimate = grouping(scene.images, scene.mask, front="none")
    assert estimate.notes.albedo_groups == 1
    assert scene.errors(estimate)[0] < 0.5
    assert "single chromaticity" in caplog.text


def test_same_seed_same_answer():
    scene = coloured(2)
    first, second = (grouping(scene.images, scene.mask, front="none", draws=5, seed=7) for _ in range(2))
    np.testing.assert_array_equal(first.normals, second.normals)


@pytest.mark.parametrize("front", ["none", "low-rank"])
def test_grey_images_are_refused(front):
    scene = coloured(0)
    with pytest.raises(InputError, match="entropy"):
        grouping(scene.images.mean(-1), scene.mask, front=front)


def test_options_out_of_range():
    scene = coloured(0)
    with pytest.raises(InputError):
        grouping(scene.images, scene.mask, draws=0)
