"""Determinism, shared rays, passes, and the absence of compilation in steady state."""

import numpy as np
import pytest
import render_support as support
from scipy import stats

from render import shapes
from render.backend.jit import dr
from render.kernel import many_lights, scene
from render.planning import light_sets
from render.records.manifest import View
from render.shared.seeds import generator

LIGHTS = light_sets.draw("azimuth-elevation", 40, generator(0, "lights")).astype(np.float32)  # more than one word
SETTINGS = {"size": 32, "spp": 8, "bounces": 2}


@pytest.fixture(scope="module")
def built():
    return scene.build(support.bowl())


def images(built, *, names=("white-acrylic", "gold-metallic-paint"), seed=1, lights=LIGHTS, only=None, **changes):
    """Return the ground truth and a dictionary of images by material number."""
    truth, stacks = many_lights.render(
        built, View(scale=0.95), support.packed(*names), lights, seed=seed, only=only, **SETTINGS | changes
    )
    return truth, dict(stacks)


def test_same_seed_same_bytes_with_one_thread_and_two(built):
    threads = dr.thread_count()
    try:
        results = []
        for count in (1, 2, 2):
            dr.set_thread_count(count)
            truth, stacks = images(built)
            results.append([truth.normals, truth.depth, truth.coverage, stacks[0], stacks[1]])
    finally:
        dr.set_thread_count(threads)
    for result in results[1:]:
        for first, other in zip(results[0], result, strict=True):
            assert first.tobytes() == other.tobytes()


def test_another_seed_gives_another_sample_of_the_same_image(built):
    (_, first), (_, second) = images(built, seed=0), images(built, seed=1)
    assert (first[0] != second[0]).mean() > 0.3
    np.testing.assert_allclose(first[0].mean(), second[0].mean(), rtol=0.01)


def test_only_does_not_change_the_bytes(built):
    names = ("white-acrylic", "gold-metallic-paint", "chrome")
    _, everything = images(built, names=names)
    _, chosen = images(built, names=names, only=[2, 0])
    assert list(chosen) == [0, 2]
    assert all(chosen[index].tobytes() == everything[index].tobytes() for index in (0, 2))


def test_a_light_does_not_depend_on_the_other_lights(built):
    """Lights share paths, so a light's image is the same whatever its number and company."""
    _, together = images(built)
    _, alone = images(built, lights=LIGHTS[[35, 2]])
    np.testing.assert_array_equal(alone[0], together[0][[35, 2]])


def test_images_scale_with_the_albedo_in_direct_light(built):
    _, stacks = images(built, names=("lambertian:1", "lambertian:0.25"), bounces=0)
    np.testing.assert_allclose(stacks[1], 0.25 * stacks[0], rtol=1e-5)


def test_passes_agree_with_one_pass(built, monkeypatch):
    """Split into passes, the samples stay those of the whole set: ground truth alike, radiance within its noise."""
    settings = {"size": 16, "spp": 32, "lights": LIGHTS[:2]}
    one = [images(built, seed=seed, **settings) for seed in range(16)]
    monkeypatch.setattr(many_lights, "SAMPLES_PER_PASS", 5 * 16**2)  # passes of 5, 5, ..., 2 samples
    split = [images(built, seed=seed, **settings) for seed in range(100, 116)]
    again = images(built, seed=0, **settings)
    np.testing.assert_allclose(again[0].normals, one[0][0].normals, atol=1e-5)  # the same camera samples
    np.testing.assert_allclose(again[0].depth, one[0][0].depth, atol=1e-5)
    np.testing.assert_array_equal(again[0].coverage, one[0][0].coverage)
    first, second = (np.stack([stacks[0].mean(-1) for _, stacks in results]) for results in (one, split))
    varies = first.var(0) + second.var(0) > 1e-12
    p = stats.ttest_ind(first[:, varies], second[:, varies], equal_var=False).pvalue
    assert -np.expm1(p.size * np.log1p(-p.min())) > 0.01


def test_steady_state_compiles_nothing():
    """After two warm-up renders: another shape, view, number of materials, set of lights or seed is data, not code."""

    def go(shape, names, view, count, seed):
        lights = light_sets.draw("hemisphere", count, generator(seed, "lights")).astype(np.float32)
        _, stacks = many_lights.render(
            scene.build(shape), view, support.packed(*names), lights, size=32, spp=4, bounces=2, seed=seed
        )
        return [stack.mean() for _, stack in stacks]

    sculpture, blob = shapes.load("sculpture:1"), shapes.load("blobby:1")
    go(sculpture, ("chrome", "pink-felt"), View(scale=1.2), 16, 0)
    go(support.bowl(), ("brass", "pvc"), View(scale=0.9), 16, 1)
    turned = View(rotation=(0, 0, 1, 0, 1, 0, -1, 0, 0), scale=1.4, offset=(0.1, -0.2))
    assert support.compiled(lambda: go(blob, ("steel", "nylon"), turned, 16, 5)) == 0
    assert support.compiled(lambda: go(sculpture, ("nickel", "lambertian:0.5"), turned, 48, 6)) == 0


def test_far_more_lights_than_a_word(built):
    """Bits of visibility reach the right light at 31, 32, 33 and 65 lights."""
    lights = light_sets.draw("hemisphere", 65, generator(3, "lights")).astype(np.float32)
    _, whole = images(built, lights=lights, names=("lambertian:1",))
    for count in (1, 31, 32, 33):
        _, part = images(built, lights=lights[:count], names=("lambertian:1",))
        np.testing.assert_allclose(part[0], whole[0][:count], rtol=1e-5, atol=1e-7)
