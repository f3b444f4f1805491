"""Noise, signed distance fields, and meshing them, against closed forms."""

import numpy as np
import pytest

from render.shapes.blobby import BlobParameters, displace_sphere
from render.shapes.geometry import sdf
from render.shapes.geometry.mesh import vertex_normals
from render.shapes.geometry.noise import scalar_waves, vector_waves
from render.shapes.geometry.polygonise import polygonise
from render.shapes.sculpture import forms
from render.shared.seeds import generator


def points(*rows):
    return np.array(rows, dtype=np.float32).T  # (3, N)


@pytest.mark.parametrize("draw", [scalar_waves, vector_waves])
def test_wave_derivatives_match_differences(draw):
    rng = generator(0, "test")
    waves = draw(rng, 2.0, 6.0)
    at = rng.uniform(-1, 1, (3, 50)).astype(np.float32)
    way = rng.normal(size=(3, 50)).astype(np.float32)
    value, (slope,) = waves.with_derivatives(at, [way])
    ahead, behind = (waves.with_derivatives(at + sign * np.float32(1e-2) * way, [])[0] for sign in (1, -1))
    np.testing.assert_allclose(slope, (ahead - behind) / 2e-2, atol=0.05)
    np.testing.assert_allclose(np.squeeze(value), waves(at), atol=1e-5)


def test_waves_have_unit_variance_and_vector_waves_no_divergence():
    rng = generator(1, "test")
    at = rng.uniform(-40, 40, (3, 40_000)).astype(np.float32)
    assert scalar_waves(rng, 1.0, 8.0)(at).std() == pytest.approx(1, abs=0.05)
    field = vector_waves(rng, 1.0, 8.0)
    axes = [np.repeat(np.float32(axis)[:, None], 100, axis=1) for axis in np.eye(3)]
    _, slopes = field.with_derivatives(at[:, :100], axes)
    assert np.abs(sum(slopes[k][k] for k in range(3))).max() < 1e-3


def test_drawn_out_waves_keep_their_wave_number_and_slow_down_along_the_direction():
    waves = scalar_waves(generator(2, "test"), 10.0, 20.0)
    ridges = waves.stretch(np.array([0.0, 1.0, 0.0]), 10.0)
    np.testing.assert_allclose(np.linalg.norm(ridges.vectors, axis=1), np.linalg.norm(waves.vectors, axis=1), rtol=1e-5)
    assert np.abs(ridges.vectors[:, 1]).mean() < 0.3 * np.abs(waves.vectors[:, 1]).mean()


def test_distances_to_solids():
    at = points([3, 0, 0], [0, 0, 0], [0, 2, 0])
    np.testing.assert_allclose(sdf.ball([0, 0, 0], 1.0)(at), [2, -1, 1], atol=1e-6)
    np.testing.assert_allclose(sdf.box([0, 0, 0], [1, 1, 1])(at), [2, -1, 1], atol=1e-6)
    np.testing.assert_allclose(sdf.cylinder([0, 0, 0], 1.0, 0.5)(at), [2, -0.5, 1.5], atol=1e-6)
    np.testing.assert_allclose(sdf.torus([0, 0, 0], 2.0, 0.5)(at), [0.5, 1.5, np.sqrt(8) - 0.5], atol=1e-6)
    np.testing.assert_allclose(sdf.cone([0, 0, 0], [2, 0, 0], 0.5, 0.25)(at), [0.75, -0.5, 1.5], atol=1e-6)
    np.testing.assert_allclose(sdf.ellipsoid([0, 0, 0], [1, 0.5, 1])(at[:, :1]), [2], atol=1e-5)


def test_smooth_union_fills_the_groove_and_is_exact_away_from_it():
    walls = [sdf.halfspace([0, 1, 0], 0.0), sdf.halfspace([1, 0, 0], 0.0)]
    at = points([0, 0, 0], [2, 1, 0], [-1, 3, 0])
    np.testing.assert_allclose(sdf.union(walls, 0.4)(at), [-0.1, 1, -1], atol=1e-6)
    np.testing.assert_allclose(sdf.intersection(walls, 0.4)(at), [0.1, 2, 3], atol=1e-6)


def test_bounded_is_exact_near_its_ball():
    ball = sdf.ball([0.2, 0, 0], 0.3)
    at = generator(3, "test").uniform(-1, 1, (3, 500)).astype(np.float32)
    limited = sdf.bound(ball, [0, 0, 0], 0.5, margin=0.2)
    near = np.linalg.norm(at, axis=0) < 0.7
    np.testing.assert_array_equal(limited(at)[near], ball(at)[near])
    assert (limited(at)[~near] > 0.19).all()


def test_mesh_of_a_torus_has_its_volume_positions_and_normals():
    mesh = polygonise(sdf.torus([0.1, 0, 0], 0.7, 0.25), half_size=1.5, triangles=40_000)
    x, y, z = mesh.vertices.T - np.float32([[0.1], [0], [0]])
    ring = np.hypot(x, z)
    out = np.stack([(ring - 0.7) * x / ring, y, (ring - 0.7) * z / ring], axis=1)
    assert np.abs(np.linalg.norm(out, axis=1) - 0.25).max() < 1e-3
    cosine = (mesh.normals * out).sum(axis=1) / np.linalg.norm(out, axis=1)
    assert np.degrees(np.arccos(np.clip(cosine, -1, 1))).max() < 0.5
    corners = mesh.vertices[mesh.faces].astype(np.float64)
    volume = np.einsum("fi,fi->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) / 6
    assert volume == pytest.approx(2 * np.pi**2 * 0.7 * 0.25**2, rel=2e-3)
    assert 30_000 < len(mesh.faces) < 55_000


def test_only_the_largest_surface_is_kept_and_cavities_are_closed():
    pieces = sdf.union([sdf.ball([0, 0, 0], 0.6), sdf.ball([1, 0, 0], 0.1)])
    mesh = polygonise(sdf.subtraction(pieces, sdf.ball([0, 0, 0], 0.3)), half_size=1.5, triangles=20_000)
    np.testing.assert_allclose(np.linalg.norm(mesh.vertices, axis=1), 0.6, atol=1e-3)


def test_a_field_without_surface_is_refused():
    with pytest.raises(ValueError, match="no surface"):
        polygonise(sdf.ball([9, 9, 9], 1.0), half_size=1.0)


def test_a_steep_field_leaves_no_hole():
    # Four times as steep as a distance: blocks missed at first must be found by their sign changes.
    ball = sdf.ball([0, 0, 0], 1.0)
    mesh = polygonise(lambda p: 8 * ball(p), half_size=1.3, triangles=20_000)
    np.testing.assert_allclose(np.linalg.norm(mesh.vertices, axis=1), 1, atol=2e-3)


def test_knotted_tube_keeps_its_thickness():
    harmonics = np.zeros((3, 2), dtype=complex)
    harmonics[:, 1] = (0.8, 0, -0.8j)  # the circle (0.8 cos t, 0, 0.8 sin t)
    tube = forms.tube(harmonics, lambda t: np.full_like(t, 0.1))
    at = generator(4, "test").uniform(-1, 1, (3, 300)).astype(np.float32)
    np.testing.assert_allclose(tube(at), sdf.torus([0, 0, 0], 0.8, 0.1)(at), atol=2e-3)


@pytest.mark.parametrize("flow", [0.0, 0.4])
def test_blob_normals_match_its_triangles(flow):
    parameters = BlobParameters(
        lumpiness=0.2, frequency=3.0, bandwidth=2.0, slope=1.0, crease=-0.5, stretch=(1, 0.8, 1.2), flow=flow,
        flow_frequency=2.0,
    )  # fmt: skip
    mesh = displace_sphere(generator(5, "test"), parameters)
    cosine = (vertex_normals(mesh.vertices, mesh.faces.astype(np.int64)) * mesh.normals).sum(axis=1)
    assert np.degrees(np.arccos(np.clip(cosine, -1, 1))).mean() < 0.5
