"""LM13: distances between intensity profiles, shown with lights over the whole sphere."""

import logging

import numpy as np
import pytest
from classical_scenes import glossy, lambertian, lights, patches, sphere

from render.shared.errors import InputError
from render.shared.imaging.vectors import spiral
from sdps.classical.plain import factorisation
from sdps.classical.profile_distances import (
    compress,
    decompose,
    distribution_slope,
    geodesics,
    normalise,
    orient,
    profile_distances,
)
from sdps.classical.profile_lights import find_lights
from sdps.core.metrics import angle_degrees


def around(count: int, seed: int = 3) -> np.ndarray:
    return lights(count, seed, lowest=-1.0)


def strengths(count: int) -> np.ndarray:
    return np.random.default_rng(0).uniform(0.5, 2.0, count)


def two_blobs(size: int = 72) -> tuple[np.ndarray, np.ndarray]:
    """Return normals and mask of the level set of two Gaussian blobs, seen along z; closed and smooth."""
    axis = (np.arange(size) + 0.5) / size * 2.0 - 1.0
    x, y = np.meshgrid(axis, -axis)
    blobs = ((-0.33, -0.1, 0.0, 0.5), (0.38, 0.25, 0.1, 0.42))

    def parts(z):
        return [np.exp(-((x - a) ** 2 + (y - b) ** 2 + (z - c) ** 2) / r**2) for a, b, c, r in blobs]

    near, found = np.full(x.shape, np.nan), np.full(x.shape, False)
    for z in np.linspace(1.2, -1.2, 300):
        hit = (sum(parts(z)) > 0.5) & ~found
        near[hit], found = z, found | hit
    low, high = near, near + 2.4 / 299.0  # inside, outside
    for _ in range(25):
        middle = (low + high) / 2.0
        inside = sum(parts(middle)) > 0.5
        low, high = np.where(inside, middle, low), np.where(inside, high, middle)
    z = np.where(found, low, 0.0)
    gradient = sum(
        part[..., None] * np.stack([x - a, y - b, z - c], axis=-1) / r**2
        for part, (a, b, c, r) in zip(parts(z), blobs, strict=True)
    )
    normals = gradient / np.linalg.norm(gradient, axis=-1, keepdims=True)
    mask = found & (normals[..., 2] > 0.0)
    return (normals * mask[..., None]).astype(np.float32), mask


def random_normals(count: int) -> np.ndarray:
    return lights(count, 5, lowest=0.0).astype(np.float64)


def test_geodesics_are_linear_in_the_angle_and_the_distribution_gives_their_slope():
    normals = random_normals(700)
    brightness = np.maximum(normals @ spiral(400).T, 0.0)  # (S, L)
    ways = geodesics(normalise(brightness), 15)
    angles = np.arccos(np.clip(normals @ normals.T, -1.0, 1.0))
    near = (angles > 0.1) & (angles < 1.0)
    assert np.corrcoef(ways[near], angles[near])[0, 1] > 0.985
    slope = (ways[near] * angles[near]).sum() / (ways[near] ** 2).sum()
    assert abs(distribution_slope(brightness) / np.sqrt(0.625) - 1.0) < 0.03  # closed form for Lambert's law
    assert 0.8 < slope / np.sqrt(0.625) < 1.02  # ways over a graph are never shorter than the true ones


def test_decomposition_recovers_normals_from_near_angles_alone():
    normals = random_normals(400)
    angles = np.arccos(np.clip(normals @ normals.T, -1.0, 1.0))
    angles = np.where(angles < np.pi / 3, angles, 1.1 * angles)  # the far ones are wrong, and not to be trusted
    rim = np.flatnonzero(normals[:, 2] < 0.2)
    outward = normals[rim, :2] / np.linalg.norm(normals[rim, :2], axis=1, keepdims=True)
    found = orient(decompose(angles, limit=300), rim, outward)
    assert angle_degrees(found, normals).mean() < 3.0  # over seeds, 0.4 to 1.8


def test_lights_of_known_normals():
    normals, directions, gains = random_normals(400), around(60), strengths(60)
    profiles = np.maximum(normals @ directions.T, 0.0) * gains
    found = find_lights(profiles, compress(profiles / gains), normals)
    front = directions[:, 2] > 0.0
    assert angle_degrees(found.directions, directions)[front].mean() < 3.0
    ratio = found.intensities / gains
    assert np.abs(ratio[front] / np.median(ratio[front]) - 1.0).mean() < 0.05


def even(count: int, seed: int = 3) -> np.ndarray:
    """Return directions spread evenly over the whole sphere, the method's assumption, turned at random."""
    turn = np.linalg.qr(np.random.default_rng(seed).standard_normal((3, 3)))[0]
    return (spiral(count) @ turn).astype(np.float32)


@pytest.mark.parametrize("surface", [sphere, two_blobs])
@pytest.mark.parametrize("shade", [lambertian, glossy])
def test_clearly_better_than_factorisation_under_lights_all_around(surface, shade):
    normals, mask = surface(52)
    scene = shade(normals, mask, even(150), intensities=strengths(150))
    ours = profile_distances(scene.images, mask, samples=350)
    normal, direction, _ = scene.errors(ours)
    assert normal < 5.0
    assert direction < 7.0
    rival = scene.errors(factorisation(scene.images, mask))
    assert normal < 0.7 * rival[0]
    assert np.allclose(np.linalg.norm(ours.normals[mask], axis=1), 1.0, atol=1e-5)
    assert not ours.normals[~mask].any()
    assert ours.notes.light_mean < 0.3


def test_albedo_cancels_and_the_seed_fixes_the_answer():
    normals, mask = sphere(56)
    albedo = patches(mask, 4, np.random.default_rng(2))
    scene = lambertian(normals, mask, around(120), albedo=albedo)
    first = profile_distances(scene.images, mask, samples=300, rounds=1, seed=4)
    again = profile_distances(scene.images, mask, samples=300, rounds=1, seed=4)
    assert np.array_equal(first.normals, again.normals)
    assert scene.errors(first)[0] < 9.0


def test_lights_on_one_side_draw_a_warning(caplog):
    normals, mask = sphere(48)
    scene = lambertian(normals, mask, lights(60, 1, lowest=0.6))
    with caplog.at_level(logging.WARNING):
        estimate = profile_distances(scene.images, mask, samples=250, rounds=1)
    assert estimate.notes.light_mean > 0.35
    assert "do not surround the object" in caplog.text


def plane(count: int = 40) -> tuple[np.ndarray, np.ndarray]:
    mask = np.zeros((40, 40), bool)
    mask[5:35, 5:35] = True
    noise = 1.0 + 0.01 * np.random.default_rng(0).standard_normal((count, 40, 40))
    return np.maximum(around(count)[:, 2], 0.0)[:, None, None] * noise, mask


def test_degenerate_input_is_refused():
    with pytest.raises(InputError, match="contour"):
        profile_distances(*plane())
    normals, mask = sphere(40)
    angle = np.linspace(0.0, 2.0 * np.pi, 60, endpoint=False)
    coplanar = np.stack([np.cos(angle), 0.0 * angle, np.sin(angle)], axis=-1)
    with pytest.raises(InputError, match="coplanar"):
        profile_distances(lambertian(normals, mask, coplanar).images, mask, samples=300)
    images = lambertian(normals, mask, around(30)).images
    with pytest.raises(InputError, match="at least 10"):
        profile_distances(images[:9], mask)
    with pytest.raises(InputError, match="slope"):
        profile_distances(images, mask, slope="guess")
    with pytest.raises(InputError, match="contour inside the image"):
        profile_distances(images, np.ones_like(mask))
