"""Near lights and perspective with a known answer; the comparison with `path` is in test_render_reference.py."""

from dataclasses import replace

import numpy as np
import pytest
import render_support as support

import render
from render import shapes
from render.backend.jit import dr
from render.kernel import many_lights, scene
from render.materials.kernels.packed import pack
from render.records import view_geometry
from render.records.manifest import View
from render.shared.errors import InputError

LIGHTS = support.unit([0, 0, 1], [0.7, 0.2, 0.6], [-0.5, -0.6, 0.5])
DISTANCES = np.array([1.6, 2.0, 3.0])
VIEW = View(rotation=(0.8, 0, 0.6, 0, 1, 0, -0.6, 0, 0.8), scale=0.7, offset=(0.15, -0.1))


def rendered(mesh, *names, view=VIEW, lights=LIGHTS, distances=DISTANCES, **settings):
    """Return ground truth and images by material."""
    options = {"size": 32, "spp": 64, "bounces": 0, "seed": 0, "distances": distances} | settings
    truth, images = many_lights.render(scene.build(mesh), view, pack(names, mesh), lights, **options)
    return truth, dict(images)


def positions(view: View) -> np.ndarray:
    return np.array([*view.offset, 0]) + LIGHTS.astype(np.float64) * DISTANCES[:, None]


@pytest.mark.parametrize("camera", [None, 2.0])
def test_white_plane_has_radiance_cosine_times_falloff(camera):
    """The plane z = 0 looks the same to both cameras: cos (d0 / d)^2 at the point itself."""
    view = View(scale=1.2, camera_distance=camera, offset=VIEW.offset)
    _, images = rendered(support.plane(), "lambertian:1", view=view)
    points = view_geometry.points(np.zeros((32, 32)), camera)
    towards = positions(view)[:, None, None] - points
    distance = np.linalg.norm(towards, axis=-1)
    expected = towards[..., 2] / distance * (DISTANCES[:, None, None] / distance) ** 2
    inner = np.s_[:, 4:28, 4:28]
    np.testing.assert_allclose(images[0].mean(-1)[inner], expected[inner], rtol=6e-3)


def test_the_centre_has_radiance_one():
    """At the object's centre a white surface that faces the light has radiance 1, whatever the distance."""
    view = View(scale=0.5, offset=(0.25, -0.25), camera_distance=3.0)
    _, images = rendered(support.plane(), "lambertian:1", view=view, lights=LIGHTS[:1], distances=DISTANCES[:1])
    around = images[0][0, 19:21, 19:21]  # the four pixels that meet at (0.25, -0.25)
    np.testing.assert_allclose(around, 1, rtol=3e-3)


@pytest.mark.parametrize("camera", [None, 1.8])
def test_lambertian_sphere(camera):
    """n.l (d0 / d)^2 with the exact normals where the pixels' rays meet the sphere, away from shadow and rim."""
    view = replace(VIEW, camera_distance=camera)
    truth, images = rendered(shapes.load("sphere"), "lambertian:0.8", view=view, spp=128)
    centre = np.array([*view.offset, 0])
    points = view_geometry.points(truth.depth.astype(np.float64), camera)
    normals = (points - centre) / view.scale
    np.testing.assert_allclose(np.linalg.norm(normals[truth.coverage == 1], axis=-1), 1, atol=0.03)
    towards = positions(view)[:, None, None] - points
    distance = np.linalg.norm(towards, axis=-1)
    cosine = np.einsum("lhwc,hwc->lhw", towards / distance[..., None], normals)
    expected = 0.8 * cosine * (DISTANCES[:, None, None] / distance) ** 2
    seen = view_geometry.view_directions((32, 32), camera)
    inner = truth.mask & ((normals * seen).sum(-1) > 0.5) & (cosine > 0.1)
    assert inner.sum() > 300
    np.testing.assert_allclose(images[0].mean(-1)[inner], expected[inner], rtol=0.02, atol=0.01)
    facing = truth.mask & ((normals * seen).sum(-1) > 0.4)
    unit = normals / np.linalg.norm(normals, axis=-1, keepdims=True)
    assert (truth.normals[facing] * unit[facing]).sum(-1).min() > 0.999  # camera frame, not ray frame


def test_a_known_point_is_projected_where_the_formula_says():
    """A small ball in a corner of the object's sphere: the centroid of its mask."""
    place, view = np.array([0.4, -0.5, 0.6]), View(scale=1.0, camera_distance=2.5)
    truth, _ = rendered(support.ball(0.05, place), "lambertian:1", view=view, size=96, spp=16)
    rows, columns = np.nonzero(truth.mask)
    x, y = (2 * columns.mean() + 1) / 96 - 1, 1 - (2 * rows.mean() + 1) / 96
    np.testing.assert_allclose([x, y], place[:2] / (1 - place[2] / 2.5), atol=6e-3)
    assert truth.depth[truth.mask].mean() == pytest.approx(0.63, abs=0.01)  # the near side, mean over the disc


def test_depth_and_points_of_a_view():
    """From depth to points and back to the sphere, through the public interface."""
    view = render.render_view(
        "sphere", "lambertian:0.5", LIGHTS, size=48, spp=16, bounces=0, scale=0.8, offset=(0.1, 0.2),
        camera_distance=2.0, light_distance=[1.5, 2.0, 4.0],
    )  # fmt: skip
    inner = view.coverage == 1
    radius = np.linalg.norm(view.points[inner] - [0.1, 0.2, 0.0], axis=-1)
    assert abs(radius - 0.8).max() < 0.02 and abs(radius - 0.8).mean() < 0.002
    np.testing.assert_allclose(view.light_positions, [0.1, 0.2, 0] + LIGHTS * [[1.5], [2.0], [4.0]], atol=1e-6)
    assert (view.normals[inner] * view.view_directions[inner]).sum(-1).min() > 0
    shard = view.shard()
    np.testing.assert_array_equal(shard.light_positions, view.light_positions)
    assert (shard.provenance["camera"], shard.camera_distance) == ("perspective", 2.0)
    matrix = np.array([float(value) for value in shard.provenance["camera_matrix"].split()]).reshape(3, 3)
    np.testing.assert_allclose(matrix, view_geometry.camera_matrix(48, 2.0))
    np.testing.assert_allclose(shard.centre, [0.1, 0.2, 0.0])


@pytest.mark.parametrize("name", ["lambertian:0.8", "red-plastic"])
def test_far_away_both_are_the_plain_renderer(name):
    """The same camera samples, so that only shadow edges and bounces that fall the other way differ."""
    mesh, options = support.bowl(), {"bounces": 1, "spp": 256, "size": 16}
    _, plain = rendered(mesh, name, distances=None, **options)
    view = replace(VIEW, camera_distance=1e4)
    truth, far = rendered(mesh, name, view=view, distances=np.full(3, 1e4), **options)
    assert truth.mask.sum() > 60
    np.testing.assert_allclose(far[0].mean((1, 2, 3)), plain[0].mean((1, 2, 3)), rtol=5e-3)
    assert np.abs(far[0] - plain[0]).mean() < 0.02 * plain[0].mean()


def test_other_lights_distances_cameras_and_shapes_compile_nothing():
    def go(mesh, lights, near, camera, seed):
        distances = np.linspace(*near, lights)
        view = replace(VIEW, camera_distance=camera)
        options = {"size": 16, "spp": 16, "bounces": 1, "seed": seed}
        rendered(mesh, "gold-paint", "lambertian:0.3", view=view, lights=support.spread(lights, 0.02),
                 distances=distances, **options)  # fmt: skip

    bowl, blob = support.bowl(), shapes.load("blobby:2")
    go(bowl, 20, (2, 3), 2.0, 0)
    go(blob, 40, (3, 4), 3.0, 1)
    again = support.compiled(lambda: (go(bowl, 33, (2.5, 6), 4.0, 2), go(blob, 64, (1.2, 9), 1.6, 3)))
    assert again == 0


def test_same_bytes_with_one_thread_and_two():
    threads, results, view = dr.thread_count(), [], replace(VIEW, camera_distance=3.0)
    try:
        for count in (1, 2):
            dr.set_thread_count(count)
            names = ("chrome", "stripes:1:nickel+pink-felt")
            _, images = rendered(support.bowl(), *names, view=view, bounces=1, size=16, spp=8)
            results.append([image.tobytes() for image in images.values()])
    finally:
        dr.set_thread_count(threads)
    assert results[0] == results[1]


def test_a_light_or_a_camera_inside_the_object_is_refused():
    options = {"size": 16, "spp": 1, "scale": 0.9}
    with pytest.raises(InputError, match=r"light_distances: light 0 is 0\.9 from the object's centre"):
        render.render_view("sphere", "chrome", LIGHTS, light_distance=0.9, **options)
    with pytest.raises(InputError, match=r"view\.camera_distance is 0\.5"):
        render.render_view("sphere", "chrome", LIGHTS, camera_distance=0.5, **options)
    with pytest.raises(InputError, match="light_distance: expected one number or 3, got 2"):
        render.render_view("sphere", "chrome", LIGHTS, light_distance=[2.0, 3.0], **options)
