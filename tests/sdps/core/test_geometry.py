"""The geometry of a capture against the renderer's, and against plain formulas."""

import numpy as np
import pytest
import torch

from render.records import view_geometry
from render.shared.errors import InputError
from sdps.core.geometry import ORTHOGRAPHIC, Camera, Capture, reach


@pytest.mark.parametrize("distance", [None, 2.5])
def test_lines_of_sight_and_positions_are_the_renderers(distance: float | None) -> None:
    depth = np.random.default_rng(0).uniform(-0.5, 0.8, (16, 16))
    camera = ORTHOGRAPHIC if distance is None else Camera(distance * 8)
    np.testing.assert_allclose(camera.views((16, 16)), view_geometry.view_directions((16, 16), distance), atol=1e-12)
    np.testing.assert_allclose(camera.positions(8 * depth) / 8, view_geometry.points(depth, distance), atol=1e-12)


def test_a_point_is_seen_where_the_pinhole_says() -> None:
    camera, heights = Camera(50.0, (3.0, 20.0)), np.full((10, 12), 5.0)
    found = camera.positions(heights)
    seen = found[..., :2] / (1 - found[..., 2:] / 50.0)
    assert seen[4, 7].tolist() == pytest.approx([4.0, 16.0])
    towards = np.array([0.0, 0.0, 50.0]) - found[4, 7]
    np.testing.assert_allclose(camera.views((10, 12))[4, 7], towards / np.linalg.norm(towards))


def test_a_part_and_a_smaller_picture_keep_their_lines_of_sight() -> None:
    whole = Camera(40.0)
    part = whole.crop((20, 30), 5, 8)
    np.testing.assert_allclose(part.views((10, 12)), whole.views((20, 30))[5:15, 8:20])
    half = whole.scale(0.5).views((10, 15))
    np.testing.assert_allclose(half[2, 3], view_of_block(whole, 2, 3), atol=1e-12)
    assert ORTHOGRAPHIC.crop((20, 30), 5, 8) is ORTHOGRAPHIC
    moved = Camera(40.0, (14.5, 9.5)).scale(0.5).views((10, 15))
    np.testing.assert_allclose(moved, half, atol=1e-12)


def view_of_block(camera: Camera, row: int, column: int) -> np.ndarray:
    middle = camera.sights((20, 30))[2 * row : 2 * row + 2, 2 * column : 2 * column + 2].mean(axis=(0, 1))
    return middle / np.linalg.norm(middle)


def test_slopes_of_a_plane_are_what_the_text_says() -> None:
    camera, shape = Camera(60.0), (21, 21)
    normal = np.array([0.3, -0.2, 1.0])
    x, y = np.moveaxis(camera.image_points(shape), -1, 0)
    # The plane n . X = 0 meets the line of sight (x, y) (1 - z / f), z: solve for z.
    across = normal[0] * x + normal[1] * y
    z = -across / (normal[2] - across / 60.0)
    w = -60.0 * np.log1p(-z / 60.0)
    np.testing.assert_allclose(camera.height(w), z, atol=1e-9)
    below = camera.sights(shape) @ normal
    np.testing.assert_allclose(np.gradient(w, axis=1)[:, 1:-1], (-normal[0] / below)[:, 1:-1], rtol=2e-3)
    np.testing.assert_allclose(-np.gradient(w, axis=0)[1:-1], (-normal[1] / below)[1:-1], rtol=2e-3)
    assert ORTHOGRAPHIC.height(w) is w


@pytest.mark.parametrize("library", [np.asarray, torch.from_numpy])
def test_light_reaches_pixels_as_from_points(library) -> None:
    rng = np.random.default_rng(1)
    places, directions = rng.uniform(-1, 1, (5, 3)), rng.standard_normal((3, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    nearness = np.array([0.0, 0.2, 0.4])
    found, falloff = (np.asarray(part) for part in reach(library(places), library(directions), library(nearness)))
    np.testing.assert_allclose(found[:, 0], np.tile(directions[0], (5, 1)), atol=1e-12)
    np.testing.assert_allclose(falloff[:, 0], 1.0)
    for lamp in (1, 2):
        lamps = directions[lamp] / nearness[lamp]
        gap = lamps - places
        length = np.linalg.norm(gap, axis=1)
        np.testing.assert_allclose(found[:, lamp], gap / length[:, None])
        np.testing.assert_allclose(falloff[:, lamp], (1 / nearness[lamp] / length) ** 2)


def test_an_object_has_its_middle_and_its_radius() -> None:
    mask = np.zeros((20, 30), bool)
    mask[4:10, 12:22] = True
    capture = Capture.of(mask)
    assert capture.centre.tolist() == [2.0, 3.0, 0.0] and capture.radius == 5.0
    places = capture.places()
    assert np.abs(places[mask].mean(axis=0)).max() < 1e-12 and places[mask][:, 0].max() == 0.9
    assert capture.places(np.full(mask.shape, 5.0))[mask][:, 2].tolist() == [1.0] * 60


@pytest.mark.parametrize("values", [{"focal": 0.0}, {"focal": -1.0}, {"focal": np.nan}])
def test_a_camera_without_a_focal_length_is_refused(values) -> None:
    with pytest.raises(InputError, match="focal length must be above 0"):
        Camera(**values)
    with pytest.raises(InputError, match="principal point"):
        Camera(10.0, (np.nan, 2.0))
