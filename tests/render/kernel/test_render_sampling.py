"""Sample points: stratified in every aligned run of 2^k, in [0, 1), of the right mean, and apart by pixel and seed."""

import numpy as np
import pytest
import render_support as support

from render.backend import sampling
from render.backend.jit import dr, mi


def lanes(pixels: int, spp: int, first: int = 0) -> tuple:
    """Return pixel and number of `spp` samples of each of `pixels` pixels, as the renderer numbers them."""
    index = dr.arange(mi.UInt32, pixels * spp)
    pixel = index // spp
    return pixel, index - pixel * spp + first


def places(pixels: int, spp: int, first: int = 0, seed: int = 0) -> np.ndarray:  # (pixels, spp, 2)
    found = sampling.pixel_position(*lanes(pixels, spp, first), sampling.stream(seed, 0))
    return np.array(found).T.reshape(pixels, spp, 2)


@pytest.mark.parametrize("first", [0, 256])
@pytest.mark.parametrize("power", [0, 1, 4, 7, 8])
def test_every_aligned_run_is_stratified_over_the_pixel(power, first):
    """Of 2^k samples, every elementary interval of area 2^-k holds one, whatever its proportions."""
    points = places(50, 2**power, first)
    assert points.min() >= 0 and points.max() < 1
    for wide in range(power + 1):
        columns, rows = 2**wide, 2 ** (power - wide)
        cell = (points[..., 0] * columns).astype(int) * rows + (points[..., 1] * rows).astype(int)
        assert (np.sort(cell, axis=1) == np.arange(2**power)).all()


def test_pixels_and_seeds_have_samples_of_their_own():
    points = places(100, 16)
    assert len(np.unique(points[:, 0], axis=0)) == 100
    assert (points != places(100, 16, seed=1)).all(2).mean() > 0.99
    np.testing.assert_array_equal(points, places(100, 16))
    np.testing.assert_allclose(points.mean((0, 1)), 0.5, atol=0.01)


def test_samples_do_not_depend_on_how_many_there_are():
    np.testing.assert_array_equal(places(20, 64)[:, :16], places(20, 16))
    np.testing.assert_array_equal(places(20, 64)[:, 32:], places(20, 32, first=32))


def test_uniform_covers_the_half_open_interval():
    bits = mi.UInt32([0, 255, 256, 0x7FFFFFFF, 0x80000000, 0xFFFFFF00, 0xFFFFFFFF])
    value = np.array(sampling.uniform(bits))
    assert value[0] == value[1] == 0 and value[2] == 2.0**-24 and value[4] == 0.5
    assert value[-1] == value[-2] == np.float32(1 - 2.0**-24) < 1


def test_bounce_variates_are_even_in_every_pixel():
    """The first values of a Kronecker sequence fill each dimension, and each pair, far better than chance."""
    spp, pixels = 256, 200
    variates = np.stack([np.array(v) for v in sampling.bounce_variates(*lanes(pixels, spp), sampling.stream(0, 1))])
    assert variates.min() >= 0 and variates.max() < 1
    np.testing.assert_allclose(variates.mean(1), 0.5, atol=1e-3)
    own = variates.reshape(3, pixels, spp)
    assert own.mean(2).std() < 0.3 / np.sqrt(12 * spp)  # of what independent samples would scatter
    for a, b in ((0, 1), (0, 2), (1, 2)):
        cells = (own[a] * 8).astype(int) * 8 + (own[b] * 8).astype(int)
        counts = np.stack([np.bincount(row, minlength=64) for row in cells])
        assert (counts == 0).mean() < 0.005 and counts.var() < 0.5 * spp / 64  # by chance 0.018, and twice that
    assert len(np.unique(own[:, :, 0], axis=1).T) == pixels


def test_a_million_samples_are_as_even_as_the_first():
    """Rounded to float32 before it wraps, the sequence would have few values left there."""
    pixel, number = lanes(1, 1024, first=1 << 20)
    for values in sampling.bounce_variates(pixel, number, sampling.stream(0, 1)):
        counts = np.bincount((np.array(values) * 64).astype(int), minlength=64)
        assert counts.min() >= 12 and counts.max() <= 20


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_random_variates_are_independent(seed):
    """Of each other, and from lane to lane: neighbouring lanes are samples of one pixel."""
    count = 1 << 16
    lane = dr.arange(mi.UInt32, count)
    variates = np.stack([np.array(v) for v in sampling.random_variates(lane, sampling.stream(seed, 2))]) - 0.5
    assert variates.min() >= -0.5 and variates.max() < 0.5
    chance = 4.5 / np.sqrt(count)
    np.testing.assert_allclose(variates.mean(1) * np.sqrt(12), 0, atol=chance)
    np.testing.assert_allclose(np.corrcoef(variates), np.eye(3), atol=chance)
    for lag in (1, 2, 3, 4, 8, 16, 64):
        np.testing.assert_allclose((variates[:, :-lag] * variates[:, lag:]).mean(1) * 12, 0, atol=chance)


@pytest.mark.parametrize("draw", [sampling.pixel_position, sampling.bounce_variates])
def test_neighbouring_pixels_are_not_alike(draw):
    pixels = 1 << 14
    pixel = dr.arange(mi.UInt32, pixels)
    for values in draw(pixel, dr.zeros(mi.UInt32, pixels), sampling.stream(0, 0)):
        shift = np.array(values) - 0.5
        for lag in (1, 2, 4, 32):
            assert abs((shift[:-lag] * shift[lag:]).mean() * 12) < 4.5 / np.sqrt(pixels)


def test_streams_differ_by_seed_and_stage_and_compile_nothing():
    streams = {int(sampling.stream(seed, stage)[0]) for seed in range(20) for stage in range(20)}
    assert len(streams) == 400

    def go(seed: int, first: int) -> None:
        pixel, number = lanes(16, 64)
        number += sampling.opaque(mi.UInt32(first))
        dr.eval(sampling.pixel_position(pixel, number, sampling.stream(seed, 0)))
        dr.eval(sampling.bounce_variates(pixel, number, sampling.stream(seed, 1)))

    go(0, 0)
    assert support.compiled(lambda: go(7, 4096)) == 0
