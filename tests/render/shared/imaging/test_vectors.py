"""Vectors of length 1, half vectors, and directions spread evenly."""

import numpy as np

from render.shared.imaging.vectors import half_vectors, spiral, unit


def test_vectors_come_to_length_1_and_zero_stays_zero() -> None:
    np.testing.assert_allclose(unit(np.array([[3.0, 0.0, 4.0], [0.0, 0.0, 0.0]])), [[0.6, 0.0, 0.8], [0.0, 0.0, 0.0]])
    assert unit(np.ones((2, 3), np.float32)).dtype == np.float32


def test_a_half_vector_halves_the_angle_of_light_and_view() -> None:
    light = np.array([np.sin(1.0), 0.0, np.cos(1.0)])
    np.testing.assert_allclose(half_vectors(light), [np.sin(0.5), 0.0, np.cos(0.5)])


def test_a_spiral_is_even_in_solid_angle() -> None:
    for lowest in (-1.0, 0.0, 0.5):
        directions = spiral(400, lowest)
        np.testing.assert_allclose(np.linalg.norm(directions, axis=1), 1.0)
        heights = np.histogram(directions[:, 2], bins=8, range=(lowest, 1.0))[0]
        assert (heights == 50).all() and np.abs(directions[:, :2].mean(axis=0)).max() < 0.01
