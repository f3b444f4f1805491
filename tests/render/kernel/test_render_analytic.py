"""Scenes with a known answer: planes and spheres, the frame, and the signs of a view."""

import numpy as np
import pytest
import render_support as support

from render import shapes
from render.records.manifest import View
from render.shapes import TriangleMesh

SIZE, SCALE = 48, 0.8


@pytest.fixture(scope="module")
def sphere() -> TriangleMesh:
    return shapes.load("sphere")


def subpixels(size: int = SIZE, scale: float = SCALE, fine: int = 16) -> tuple[np.ndarray, np.ndarray]:
    """Return the exact normals (S, S, fine^2, 3) of the sphere at points spread over each pixel, and which hit it."""
    axis = ((np.arange(size * fine) + 0.5) / (size * fine) * 2 - 1) / scale
    x, y = np.meshgrid(axis, -axis)
    square = 1 - x**2 - y**2
    normals = np.stack([x, y, np.sqrt(np.maximum(square, 0))], axis=-1)
    blocks = normals.reshape(size, fine, size, fine, 3).swapaxes(1, 2).reshape(size, size, fine**2, 3)
    return blocks, (square > 0).reshape(size, fine, size, fine).swapaxes(1, 2).reshape(size, size, fine**2)


def inside(radius: float) -> np.ndarray:
    """Return the pixels whose centre lies within `radius` of the sphere's own."""
    axis = (np.arange(SIZE) + 0.5) / SIZE * 2 - 1
    return np.hypot(*np.meshgrid(axis, axis)) < radius * SCALE


@pytest.mark.parametrize("bounces", [0, 2])
def test_lambertian_sphere_is_albedo_times_cosine(sphere, bounces):
    lights = support.unit([0, 0, 1], [1, 0, 0.5], [-0.3, 1, 0.2], [0.2, -0.6, 0.7])
    albedo = np.array([0.8, 0.5, 0.2])
    _, images = support.render(
        sphere, "lambertian:0.8/0.5/0.2", lights=lights, view=View(scale=SCALE), size=SIZE, spp=64, bounces=bounces
    )
    normals, _ = subpixels()
    cosine = np.maximum(np.einsum("hwsc,lc->lhws", normals, lights), 0).mean(-1)
    error = (images[0] - cosine[..., None] * albedo)[:, inside(0.9)]
    assert np.abs(error).max() < 0.01
    assert np.abs(error.mean(axis=1)).max() < 5e-4  # no bias, to which a bounce would add


@pytest.mark.parametrize("angle", [0, 30, 60, 80])
def test_white_plane_has_radiance_cosine(angle):
    light = np.array([[np.sin(np.radians(angle)), 0, np.cos(np.radians(angle))]], np.float32)
    _, images = support.render(support.plane(), "lambertian:1", lights=light, size=16)
    centre = images[0][0, 4:12, 4:12]
    np.testing.assert_allclose(centre, np.cos(np.radians(angle)), rtol=1e-5)


def test_ground_truth_of_the_sphere(sphere):
    view = View(scale=SCALE)
    truth, _ = support.render(sphere, "lambertian:0.5", lights=support.unit([0, 0, 1]), view=view, size=SIZE, spp=64)
    normals, hit = subpixels()
    coverage = hit.mean(-1)
    np.testing.assert_allclose(truth.coverage, coverage, atol=0.1)
    assert abs(truth.coverage.mean() - np.pi * SCALE**2 / 4) < 1e-3
    clear = np.abs(coverage - 0.5) > 0.06
    assert (truth.mask == (coverage >= 0.5))[clear].all()
    mean = (normals * hit[..., None]).sum(2)
    mean /= np.maximum(np.linalg.norm(mean, axis=-1, keepdims=True), 1e-9)
    angle = np.degrees(np.arccos(np.clip((mean * truth.normals).sum(-1), -1, 1)))
    assert angle[inside(0.9)].max() < 0.3
    np.testing.assert_allclose(np.linalg.norm(truth.normals, axis=-1)[truth.mask], 1, atol=1e-6)
    assert not truth.normals[~truth.mask].any() and not truth.depth[~truth.mask].any()
    np.testing.assert_allclose(truth.depth[inside(0.9)], (normals[..., 2] * SCALE).mean(2)[inside(0.9)], atol=0.01)


def test_frame_is_x_right_y_up_z_to_the_camera(sphere):
    lights = support.unit([1, 0, 0.3], [0, 1, 0.3])
    truth, images = support.render(sphere, "lambertian:0.7", lights=lights, view=View(scale=1.0), size=33, spp=16)
    assert truth.normals[16, 1, 0] < -0.8 and truth.normals[16, 31, 0] > 0.8
    assert truth.normals[1, 16, 1] > 0.8 and truth.normals[31, 16, 1] < -0.8
    np.testing.assert_allclose(truth.normals[16, 16], [0, 0, 1], atol=0.01)
    assert truth.depth[16, 16] > 0.99
    from_right, from_above = images[0][..., 0]
    assert from_right[:, 17:].sum() > 5 * from_right[:, :16].sum()
    assert from_above[:16].sum() > 5 * from_above[17:].sum()


def centroid(mask: np.ndarray) -> tuple[float, float]:
    """Return the centre of a mask as (x right, y up) in half image widths."""
    rows, columns = np.nonzero(mask)
    size = len(mask)
    return (columns.mean() + 0.5) / size * 2 - 1, 1 - (rows.mean() + 0.5) / size * 2


def test_view_rotates_scales_and_moves(sphere):
    small = TriangleMesh(
        vertices=(sphere.vertices * 0.3 + [0, 0, 0.7]).astype(np.float32), faces=sphere.faces, normals=sphere.normals
    )
    light = support.unit([0, 0, 1])
    turned = View(rotation=(0, 0, 1, 0, 1, 0, -1, 0, 0), scale=0.8)  # +90 degrees about y: +z goes to +x
    truth, _ = support.render(small, "lambertian:1", lights=light, view=turned)
    np.testing.assert_allclose(centroid(truth.mask), [0.56, 0], atol=0.02)
    assert abs(truth.depth[truth.mask].max() - 0.24) < 0.02
    pitched = View(rotation=(1, 0, 0, 0, 0, -1, 0, 1, 0), scale=0.8)  # +90 degrees about x: +z goes to -y
    truth, _ = support.render(small, "lambertian:1", lights=light, view=pitched)
    np.testing.assert_allclose(centroid(truth.mask), [0, -0.56], atol=0.02)
    moved = View(scale=0.5, offset=(0.3, 0.2))
    truth, _ = support.render(sphere, "lambertian:1", lights=light, view=moved)
    np.testing.assert_allclose(centroid(truth.mask), [0.3, 0.2], atol=0.02)
    assert abs(truth.coverage.mean() - np.pi * 0.25 / 4) < 0.005


def test_lights_stay_with_the_camera_when_the_object_turns(sphere):
    lights = support.unit([0.8, 0.3, 0.5])
    turned = View(rotation=(0, 0, 1, 0, 1, 0, -1, 0, 0), scale=0.8)
    _, straight = support.render(sphere, "lambertian:1", lights=lights, view=View(scale=0.8), spp=64)
    _, rotated = support.render(sphere, "lambertian:1", lights=lights, view=turned, spp=64)
    np.testing.assert_allclose(rotated[0], straight[0], atol=0.02)


def test_cast_shadow_lies_opposite_the_light(sphere):
    """A ball before a wall, lit from the right, darkens the wall on the left, where geometry says."""
    wall = support.plane()
    ball = (sphere.vertices * 0.15 + [0, 0, 0.5]).astype(np.float32)
    mesh = TriangleMesh(
        vertices=np.concatenate([wall.vertices, ball]),
        faces=np.concatenate([wall.faces, sphere.faces + 4]).astype(np.uint32),
        normals=np.concatenate([wall.normals, sphere.normals]),
    )
    _, images = support.render(
        mesh, "lambertian:1", lights=support.unit([1, 0, 1]), view=View(scale=1.0), size=64, spp=16
    )
    image = images[0][0, ..., 0]
    assert image[32, 16] == 0  # x = -0.5, the foot of the ray through the ball's centre
    np.testing.assert_allclose(image[32, 48], np.sqrt(0.5), rtol=1e-5)
    np.testing.assert_allclose(image[8, 16], np.sqrt(0.5), rtol=1e-5)


def test_object_outside_the_frame_gives_an_empty_mask(sphere):
    view = View(scale=0.1, offset=(5.0, 0.0))
    truth, images = support.render(sphere, "lambertian:1", lights=support.unit([0, 0, 1]), view=view, bounces=1)
    assert not truth.mask.any() and not images[0].any()
