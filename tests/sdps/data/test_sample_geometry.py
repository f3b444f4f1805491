"""Pixels and lamps of samples against the renderer's own geometry, and against that of a capture."""

from dataclasses import replace

import numpy as np
import pytest
from sdps_samples import PLAIN, options, rng
from sdps_scenes import sphere_normals

from render.records.manifest import SceneSpec, View
from render.records.view_geometry import incident, points, view_directions
from sdps.core.geometry import Camera, Capture, reach
from sdps.core.symmetry import Symmetry
from sdps.data.dataset import make_sample
from sdps.data.sample_geometry import Placed, lay_out, place
from sdps.data.scene_store import StoredScene

NORMALS, MASK = sphere_normals(32)
DEPTH = np.where(MASK, 0.8 * NORMALS[..., 2], 0.0).astype(np.float32)
LIGHTS = ((0.3, 0.2, 0.9327), (-0.5, 0.1, 0.8602), (0.0, 0.6, 0.8))
NEAR = SceneSpec(
    id="near", seed=0, split="train", shape="sphere", material="lambertian:1", view=View(offset=(0.1, -0.05)),
    lights=LIGHTS, size=32, spp=1, bounces=0, light_distances=(2.5, 3.0, 4.0),
)  # fmt: skip
FROM_NEARBY = replace(NEAR, view=replace(NEAR.view, camera_distance=2.2))


def placed(scene: SceneSpec) -> Placed:
    return place(lay_out(scene, DEPTH, MASK, np.arange(3)), MASK, scene.light_directions())


@pytest.mark.parametrize("scene", [NEAR, FROM_NEARBY], ids=["orthographic", "perspective"])
def test_light_reaches_pixels_as_the_renderer_has_it(scene: SceneSpec) -> None:
    found, camera = placed(scene), scene.view.camera_distance
    centre = np.array([*scene.view.offset, 0.0])
    where = points(DEPTH.astype(np.float64), camera)[MASK]
    directions, irradiance = incident(where, scene.light_directions(), scene.light_positions(), centre)
    ours, falloff = reach(found.places[MASK].astype(np.float64), found.directions, found.nearness)
    np.testing.assert_allclose(ours.swapaxes(0, 1), directions, atol=2e-5)
    np.testing.assert_allclose((falloff * found.irradiance).T, irradiance, rtol=2e-4)
    sights = found.sights / np.linalg.norm(found.sights, axis=-1, keepdims=True)
    np.testing.assert_allclose(sights, view_directions(MASK.shape, camera), atol=1e-6)


@pytest.mark.parametrize("scene", [NEAR, FROM_NEARBY], ids=["orthographic", "perspective"])
def test_samples_and_captures_agree(scene: SceneSpec) -> None:
    found, distance = placed(scene), scene.view.camera_distance
    inside = DEPTH[MASK].astype(np.float64)
    if distance is None:
        camera, heights = Camera(), (DEPTH - inside.mean()) * 16
    else:
        camera = Camera(distance * 16)
        mean = np.exp(np.log(distance - inside).mean())
        heights = camera.focal * (1 - (distance - DEPTH) / mean)
    places = Capture.of(MASK, camera).places(heights)
    np.testing.assert_allclose(places[MASK], found.places[MASK], atol=1e-5)


def test_distant_lamps_stay_what_they_are() -> None:
    found = placed(replace(NEAR, light_distances=()))
    assert np.array_equal(found.directions, NEAR.light_directions())
    assert not found.nearness.any() and (found.irradiance == 1).all()


def test_what_faces_all_lamps_of_a_mixture_is_lit_as_by_the_lamp_that_stands_for_them() -> None:
    found = placed(NEAR)
    alone = found.mix(np.eye(3))
    for name in ("directions", "nearness", "irradiance"):
        np.testing.assert_allclose(getattr(alone, name), getattr(found, name), rtol=1e-6)
    shares = np.array([[0.2, 0.5, 0.3], [0.0, 0.4, 0.6]])
    mixed, normal = found.mix(shares), np.array([0.1, 0.2, 0.9747])
    each = found.irradiance * (found.directions @ normal)  # (3,), by every lamp
    assert (each > 0.0).all()
    np.testing.assert_allclose(mixed.irradiance * (mixed.directions @ normal), shares @ each, rtol=1e-6)
    low, high = found.nearness.min(), found.nearness.max()
    assert ((low < mixed.nearness) & (mixed.nearness < high)).all()


def test_light_from_many_sides_has_the_covariance_of_its_directions() -> None:
    found = placed(replace(NEAR, light_distances=()))
    assert not found.covariance.any() and np.abs(found.mix(np.eye(3)).covariance).max() < 1e-6, "single lamps"
    apart = found._replace(directions=np.array([[0.6, 0.0, 0.8], [-0.6, 0.0, 0.8], [0.0, 0.0, 1.0]], np.float32))
    two, three = apart.mix(np.array([[0.5, 0.5, 0.0], [0.25, 0.25, 0.5]])).covariance
    np.testing.assert_allclose(two, np.diag([0.36, 0.0, 0.0]), atol=1e-6)
    np.testing.assert_allclose(three, np.diag([0.18, 0.0, 0.01]), atol=1e-6)
    around = np.concatenate([np.eye(3), -np.eye(3)]).astype(np.float32)
    whole = Placed(found.places, found.sights, around, np.zeros(6, np.float32), np.ones(6, np.float32), np.zeros(0))
    np.testing.assert_allclose(whole.mix(np.ones((1, 6))).covariance[0], np.eye(3) / 3.0, atol=1e-6)


def test_geometry_turns_and_shrinks_with_the_scene() -> None:
    layout = lay_out(FROM_NEARBY, DEPTH, MASK, np.arange(3))
    plain, symmetry = place(layout, MASK, NEAR.light_directions()), Symmetry(1, True)
    turned = place(layout.turn(symmetry), symmetry.images(MASK, 0), symmetry.vectors(NEAR.light_directions()))
    back = symmetry.vectors(symmetry.images(plain.places, 0))
    np.testing.assert_allclose(turned.places, back, atol=1e-6)
    np.testing.assert_allclose(turned.sights, symmetry.vectors(symmetry.images(plain.sights, 0)), atol=1e-6)
    np.testing.assert_allclose(turned.directions, symmetry.vectors(plain.directions), atol=1e-6)
    np.testing.assert_allclose(turned.nearness, plain.nearness, rtol=1e-6)
    images = np.ones((3, 32, 32, 3), np.float16) * MASK[..., None]
    stored = StoredScene(images, NORMALS, MASK, DEPTH)
    whole, half = (
        make_sample(FROM_NEARBY, stored, options(images=3, size=size, augmentation=PLAIN), rng()) for size in (32, 16)
    )
    np.testing.assert_allclose(half.nearness, whole.nearness, rtol=0.1)
    np.testing.assert_allclose(half.directions, whole.directions, atol=0.01)
    inside = half.mask[0].numpy() > 0
    shrunk = whole.places.numpy().reshape(3, 16, 2, 16, 2).mean(axis=(2, 4))
    core = inside & (whole.mask[0].numpy().reshape(16, 2, 16, 2).mean(axis=(1, 3)) == 1)
    assert np.abs(half.places.numpy() - shrunk)[:, core].max() < 0.12


def test_lamps_of_a_sample_are_equally_strong_where_the_object_is() -> None:
    images = np.ones((3, 32, 32, 3), np.float16) * MASK[..., None]
    sample = make_sample(
        NEAR, StoredScene(images, NORMALS, MASK, DEPTH), options(images=3, size=32, augmentation=PLAIN), rng()
    )
    irradiance = placed(NEAR).irradiance
    shown = np.sort(sample.images[:, 0, 16, 16].numpy())
    np.testing.assert_allclose(shown / shown[0], np.sort(1 / irradiance) / (1 / irradiance).min(), rtol=1e-3)
