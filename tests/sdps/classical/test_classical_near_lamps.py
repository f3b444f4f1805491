"""Calibrated methods under lamps that stand near: each pixel's own light, found in turns with the depth."""

from dataclasses import dataclass

import numpy as np
import pytest

from render.shared.errors import InputError
from sdps import api
from sdps.classical import registry
from sdps.classical.common.near_lamps import NearLamps, settle
from sdps.core.geometry import FAR, ORTHOGRAPHIC, Camera, Capture, are_near, reach
from sdps.core.metrics import normal_mae
from sdps.methods.on_box import Box

CALIBRATED = [name for name, entry in registry.METHODS.items() if entry.calibrated]
RHO = 1 / 2.5


@dataclass(frozen=True, eq=False)
class Scene:
    """A matte sphere, or its cap, under lamps; `places` are its pixels', (H, W, 3)."""

    images: np.ndarray
    mask: np.ndarray
    normals: np.ndarray
    lights: np.ndarray
    nearness: np.ndarray
    places: np.ndarray

    def error(self, normals: np.ndarray) -> float:
        return normal_mae(normals, self.normals, self.mask)


def ball(size: int, cap: float, camera: Camera) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return mask, normals and heights (S, S) of mean 0 of a ball's cap, of radius `cap` times the ball's."""
    squared, radius, depth = (camera.image_points((size, size)) ** 2).sum(-1), size / 2, 0.0
    for _ in range(20):  # until the mean of what is seen lies in the plane z = 0
        a, b = 1 + squared / camera.focal**2, depth - squared / camera.focal  # |X - middle| = radius, for z
        rest = b**2 - a * (squared + depth**2 - radius**2)
        heights = (np.sqrt(np.maximum(rest, 0.0)) - b) / a
        normals = (camera.positions(heights) + np.array([0.0, 0.0, depth])) / radius
        mask = (rest > 0) & (np.hypot(normals[..., 0], normals[..., 1]) < cap)
        depth += heights[mask].mean()
    return mask, np.where(mask[..., None], normals, 0.0), np.where(mask, heights, 0.0)


def photograph(
    rho: float = RHO, cap: float = 0.95, camera: Camera = ORTHOGRAPHIC, size: int = 64, count: int = 20
) -> Scene:
    """Photograph a ball under lamps within 50 degrees of the camera, as near as `rho`."""
    mask, normals, heights = ball(size, cap, camera)
    places = Capture.of(mask, camera).places(heights)
    turns = np.arange(count) + 0.5
    z = 1 - turns / count * (1 - np.cos(np.radians(50)))
    lights = np.stack([*(np.sqrt(1 - z**2) * (np.cos(2.39996 * turns), np.sin(2.39996 * turns))), z], -1)
    directions, falloff = reach(places[mask], lights, np.full(count, rho))
    images = np.zeros((count, size, size, 3), np.float32)
    shading = falloff * np.maximum((normals[mask][:, None] * directions).sum(-1), 0.0)
    images[:, mask] = 0.7 * shading.T[..., None]
    return Scene(images, mask, normals, lights, np.full(count, rho), places)


@pytest.mark.parametrize("name", CALIBRATED)
def test_a_cap_without_shadows(name: str) -> None:
    """Every calibrated method is exact there, but for the depth, which is integrated."""
    scene = photograph(cap=0.5, size=40)
    found = api.estimate(scene.images, scene.mask, name, light_directions=scene.lights,
                         intensities=np.ones(20), light_nearness=scene.nearness)  # fmt: skip
    distant = registry.run(name, scene.images, scene.mask, scene.lights)
    assert scene.error(distant.normals) > 4.0
    assert scene.error(found.normals) < 0.5
    assert found.notes.albedo is not None
    np.testing.assert_allclose(found.notes.albedo[scene.mask], 0.7, rtol=0.04)
    np.testing.assert_array_equal(found.light_directions, scene.lights.astype(np.float32))


def test_a_whole_ball() -> None:
    """Where lamps are below the horizon of a pixel, observations that are dark are left out."""
    scene = photograph()
    distant = registry.run("least-squares-shadows", scene.images, scene.mask, scene.lights)
    assert scene.error(distant.normals) > 10.0
    found = api.estimate(scene.images, scene.mask, "least-squares-shadows", light_directions=scene.lights,
                         intensities=np.ones(20), light_nearness=scene.nearness)  # fmt: skip
    assert scene.error(found.normals) < 0.5
    truth = registry.run(
        "least-squares-shadows", scene.images, scene.mask, scene.lights, near=NearLamps(scene.places, scene.nearness)
    )
    assert scene.error(truth.normals) < 0.01  # with the true places there is nothing left


def test_a_near_camera() -> None:
    """Positions are those of the camera's lines of sight, and so is the depth."""
    camera = Camera(150.0)  # a ball of 64 pixels
    scene = photograph(camera=camera)
    errors = [
        scene.error(
            api.estimate(
                scene.images, scene.mask, "least-squares-shadows", light_directions=scene.lights,
                intensities=np.ones(20), light_nearness=scene.nearness, camera=one,
            ).normals
        )
        for one in (ORTHOGRAPHIC, camera)
    ]  # fmt: skip

    assert errors[1] < 0.1 and errors[0] > 0.3


def test_lamps_of_their_own_distances_and_strengths() -> None:
    scene = photograph(cap=0.5)
    nearness, gains = np.linspace(0.0, 0.5, 20), np.linspace(0.5, 2.0, 20)
    directions, falloff = reach(scene.places[scene.mask], scene.lights, nearness)
    images = np.zeros_like(scene.images)
    shading = gains * falloff * (scene.normals[scene.mask][:, None] * directions).sum(-1)
    images[:, scene.mask] = shading.T[..., None]
    found = api.estimate(images, scene.mask, "least-squares", light_directions=scene.lights, intensities=gains,
                         light_nearness=nearness)  # fmt: skip
    assert scene.error(found.normals) < 0.5


@pytest.mark.parametrize("nearness", [None, 0.0, FAR])
def test_distant_lamps_give_the_same_bytes(nearness: float | None) -> None:
    scene = photograph(rho=0.0)
    near = None if nearness is None else np.full(20, nearness)
    assert not are_near(near)
    for name in ("least-squares", "robust-least-squares"):
        found = api.estimate(scene.images, scene.mask, name, light_directions=scene.lights, intensities=np.ones(20),
                             light_nearness=near)  # fmt: skip
        before = registry.run(name, scene.images, scene.mask, scene.lights, np.ones(20))
        np.testing.assert_array_equal(found.normals, before.normals)


def test_a_photograph_is_read_once_and_in_parts(monkeypatch: pytest.MonkeyPatch) -> None:
    """Methods that look at pixels one by one give the same of the object's box, whole or by rows."""
    scene, reads = photograph(), []
    near = NearLamps(scene.places, scene.nearness)
    whole = registry.run("robust-least-squares", scene.images, scene.mask, scene.lights, near=near).normals

    class Source:
        def __len__(self) -> int:
            return len(scene.images)

        def __getitem__(self, part: slice) -> np.ndarray:
            reads.append(part)
            return scene.images[part]

    box = Box("robust-least-squares", Source(), scene.mask)
    first, count = box.run((scene.lights, None), near).normals, len(reads)
    np.testing.assert_allclose(first, whole, atol=1e-6)
    np.testing.assert_array_equal(box.run((scene.lights, None), near).normals, first)
    assert len(reads) == count
    monkeypatch.setattr("sdps.methods.on_box.PART_BYTES", 60 * 20 * 500)
    parts = Box("robust-least-squares", Source(), scene.mask)
    assert parts.count > 5
    np.testing.assert_allclose(parts.run((scene.lights, None), near).normals, whole, atol=1e-6)


def test_methods_that_find_the_lights_say_that_they_take_them_for_distant(caplog: pytest.LogCaptureFixture) -> None:
    scene = photograph(cap=0.5, size=32)
    api.estimate(scene.images, scene.mask, "factorisation", light_nearness=scene.nearness)
    assert "factorisation takes the lamps for distant" in caplog.text


def test_a_flat_start_is_the_first_round() -> None:
    """Rounds end when the normals stay."""
    scene, places = photograph(cap=0.5), []

    def solve(near: NearLamps) -> registry.Estimate:
        places.append(near.places)
        return registry.run("least-squares", scene.images, scene.mask, scene.lights, near=near)

    settle(solve, scene.mask, scene.nearness, ORTHOGRAPHIC)
    assert not places[0][..., 2].any()
    assert 3 <= len(places) <= 6
    assert np.abs(places[-1] - scene.places)[scene.mask].max() < 0.02


@pytest.mark.parametrize(
    ("nearness", "said"),
    [(np.full(19, 0.3), r"20 images need 20 values of light_nearness, got \(19,\)"), (0.3, r"got \(\)"),
     (np.full(20, 1.0), "light_nearness 1: .* below 1"), (np.full(20, -0.1), "light_nearness -0.1"),
     (np.full(20, np.nan), "light_nearness nan")],
)  # fmt: skip
def test_nearness_that_cannot_be(nearness: np.ndarray, said: str) -> None:
    scene = photograph(cap=0.5, size=32)
    with pytest.raises(InputError, match=said):
        api.estimate(scene.images, scene.mask, "least-squares", light_directions=scene.lights,
                     intensities=np.ones(20), light_nearness=nearness)  # fmt: skip
