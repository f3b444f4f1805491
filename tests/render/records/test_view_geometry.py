"""Points, directions and matrices of perspective views and near lights, against their definitions."""

from dataclasses import replace

import numpy as np
import pytest

from render.records import view_geometry
from render.records.manifest import SceneSpec, View, read_manifest, write_manifest
from render.shared.errors import InputError

PLAIN = SceneSpec(
    id="a", seed=0, split="test", shape="sphere", material="chrome", view=View(scale=0.9, offset=(0.1, -0.2)),
    lights=((0.0, 0.0, 1.0), (0.6, 0.0, 0.8)), size=16, spp=4, bounces=1,
)  # fmt: skip


@pytest.mark.parametrize("distance", [None, 2.5, 40.0])
def test_a_point_is_seen_where_it_was_projected(distance):
    """Depth to points and back through K: the pixel's centre comes out."""
    rng = np.random.default_rng(0)
    depth = rng.uniform(-0.8, 0.8, (12, 16))
    x, y, z = np.moveaxis(view_geometry.points(depth, distance), -1, 0)
    np.testing.assert_array_equal(z, depth)
    if distance is None:
        u, v = (x + 1) * 8, 6 - y * 8
    else:
        matrix = view_geometry.camera_matrix(16, distance)
        matrix[1, 2] = 6.0  # half of the height; `camera_matrix` is for square images
        u, v, w = matrix @ np.stack([x, -y, distance - z]).reshape(3, -1)
        u, v = (u / w).reshape(12, 16), (v / w).reshape(12, 16)
    rows, columns = np.mgrid[:12, :16] + 0.5
    np.testing.assert_allclose(u, columns, atol=1e-9)
    np.testing.assert_allclose(v, rows, atol=1e-9)


def test_view_directions_lead_to_the_camera():
    depth = np.random.default_rng(1).uniform(-0.8, 0.8, (8, 8))
    towards = np.array([0, 0, 3.0]) - view_geometry.points(depth, 3.0)
    expected = towards / np.linalg.norm(towards, axis=-1, keepdims=True)
    np.testing.assert_allclose(view_geometry.view_directions((8, 8), 3.0), expected, atol=1e-12)
    np.testing.assert_array_equal(view_geometry.view_directions((2, 3)), np.broadcast_to([0, 0, 1.0], (2, 3, 3)))


def test_the_field_of_view_spans_the_frame():
    assert view_geometry.field_of_view(1.0) == pytest.approx(90)
    edge = np.array([1.0, 0.0, 0.0])  # a point of the plane z = 0 at the frame's edge
    matrix = view_geometry.camera_matrix(100, 5.0)
    u, _, w = matrix @ [edge[0], -edge[1], 5.0 - edge[2]]
    assert u / w == pytest.approx(100)
    assert view_geometry.field_of_view(5.0) == pytest.approx(2 * np.degrees(np.arctan2(50, matrix[0, 0])))


def test_incident_light_falls_with_the_square_of_the_distance():
    centre, positions = np.array([0.1, 0.0, 0.0]), np.array([[0.1, 0.0, 2.0]])
    places = np.array([[0.1, 0.0, 0.0], [0.1, 0.0, 1.0], [1.1, 0.0, 1.0]])
    towards, irradiance = view_geometry.incident(places, np.array([[0, 0, 1.0]]), positions, centre)
    np.testing.assert_allclose(irradiance[0], [1.0, 4.0, 2.0])
    np.testing.assert_allclose(towards[0], [[0, 0, 1], [0, 0, 1], [-(0.5**0.5), 0, 0.5**0.5]])


def test_positions_lie_along_the_directions_from_the_centre():
    scene = replace(PLAIN, light_distances=(2.0, 3.0))
    np.testing.assert_allclose(scene.light_positions(), [[0.1, -0.2, 2.0], [1.9, -0.2, 2.4]], atol=1e-6)
    assert PLAIN.light_positions() is None


def test_a_plain_line_of_a_manifest_says_nothing_of_them(tmp_path):
    view = replace(PLAIN.view, camera_distance=4.0)
    near = replace(PLAIN, id="b", view=view, light_distances=(2.0, 3.0))
    write_manifest(tmp_path, [PLAIN, near])
    plain, other = (tmp_path / "manifest.jsonl").read_text().splitlines()
    assert "camera_distance" not in plain and "light_distances" not in plain
    assert '"camera_distance": 4.0' in other and '"light_distances": [2.0, 3.0]' in other
    assert read_manifest(tmp_path) == [PLAIN, near]
    assert len({PLAIN.digest(), replace(near, id="a").digest(), replace(PLAIN, view=view).digest()}) == 3


@pytest.mark.parametrize("distance", [0.5, 0.9, -3.0, float("nan"), float("inf")])
def test_what_is_inside_the_object_is_refused_in_one_line(distance):
    with pytest.raises(InputError, match=r"^light_distances: light 1 is [^\n]*$"):
        replace(PLAIN, light_distances=(2.0, distance))
    with pytest.raises(InputError, match=r"^view.camera_distance is [^\n]*$"):
        View(scale=0.9, camera_distance=distance)


def test_as_many_distances_as_lights():
    with pytest.raises(InputError, match="1 of 2 lights"):
        replace(PLAIN, light_distances=(2.0,))
