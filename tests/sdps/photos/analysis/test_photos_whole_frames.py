"""Plates and reliefs that fill the frame: movement told from wandering relief, near lamps told from curved surfaces."""

from pathlib import Path

import classical_scenes as scenes
import numpy as np
import photo_folders as folders
import pytest

from sdps import photos
from sdps.photos.analysis.explainer import Explainer
from sdps.photos.analysis.fall_off import FallOff, block_means, fall_off
from sdps.photos.analysis.motion import Tracker, second_look

RING = np.arange(12) * 2 * np.pi * 5 / 12
AROUND = np.stack([0.8 * np.cos(RING), 0.8 * np.sin(RING), np.full(12, 0.6)], axis=-1)
PLATES = {
    "relief": {},
    "deep relief": {"depth": 3.0},
    "painted relief": {"paint": True},
    "lumps": {"lumps": True},
    "print": {"depth": 0.0, "paint": True},
}


def moved(series: np.ndarray, mask: np.ndarray | None = None) -> dict[int, tuple[float, float]]:
    """Return the shifts of the images (L, H, W) that are said to have moved, by number."""
    tracker = Tracker(np.ones(series.shape[1:], bool) if mask is None else mask)
    first = [tracker.add(image) for image in series]
    found = second_look(tracker, first, lambda number: series[number])
    return {number: (shift.rows, shift.columns) for number, shift in enumerate(found) if shift.length}


def dimming(images: np.ndarray) -> FallOff:
    return fall_off(np.stack([block_means(image) for image in images.mean(-1)]), images.shape[1:3])


@pytest.mark.parametrize("count", [4, 6, 8, 12])
@pytest.mark.parametrize("distance", [None, 3.0, 1.6])
@pytest.mark.parametrize("kind", PLATES)
def test_relief_that_wanders_with_the_light_is_no_movement(kind: str, distance: float | None, count: int) -> None:
    """Every edge of a relief lies elsewhere under every light, and with it the sum of edges had seen movement."""
    frame = folders.plate(AROUND[:count], distance=distance, shape=(108, 140), **PLATES[kind]).mean(-1)
    still = np.ascontiguousarray(frame[:, 6:-6, 6:-6])
    assert moved(still) == {}
    if count < 6:
        return
    number = count // 2
    still[number] = frame[number, 3:-9, 8:-4]
    assert set(moved(still)) == {number}
    np.testing.assert_allclose(moved(still)[number], (3, -2), atol=1)


def test_a_knock_in_the_middle_of_a_relief() -> None:
    frame = folders.plate(AROUND, distance=3.0, shape=(108, 140)).mean(-1)
    knocked = np.concatenate([frame[:7, 6:-6, 6:-6], frame[7:, 2:-10, 6:-6]])
    assert set(moved(knocked)) == set(range(7, 12))


def test_a_camera_held_in_the_hand_before_a_relief() -> None:
    frame = folders.plate(AROUND, distance=3.0, shape=(116, 148)).mean(-1)
    steps = np.random.default_rng(5).integers(-6, 7, (len(frame), 2))
    series = [image[8 - r : 108 - r, 8 - c : 140 - c] for image, (r, c) in zip(frame, steps, strict=True)]
    assert len(moved(np.stack(series))) > 6


def test_few_pictures_of_a_smooth_glossy_object_are_no_movement() -> None:
    """Nothing of it stays in its place but the outline, of which each picture shows another half."""
    normals, mask = scenes.sphere(72)
    for seed in range(4):
        series = scenes.glossy(normals, mask, scenes.lights(8, seed, 0.45), diffuse=0.5, specular=0.2, roughness=0.15)
        images = np.pad(series.images.mean(-1), ((0, 0), (16, 16), (16, 16)))
        noise = np.random.default_rng(seed).normal(0, 0.001, images.shape)
        assert moved(np.clip(images + noise, 0, 1).astype(np.float32), np.pad(mask, 16)) == {}


def test_pictures_are_taken_out_as_they_were_put_in() -> None:
    rng = np.random.default_rng(0)
    pictures = rng.random((25, 60, 60), np.float32)
    explainer, other = Explainer((60, 60)), Explainer((60, 60))
    for number, picture in enumerate(pictures):
        explainer.take(number, picture)
        if number % 2:
            other.take(number, picture)
    for number in range(0, 25, 2):
        explainer.take(number, pictures[number], -1)
    np.testing.assert_allclose(explainer._fields, other._fields, atol=1e-5)


def test_tiles_vote_for_the_shift() -> None:
    """A picture under a new light is explained where it lies, and elsewhere once it moved."""
    frames = folders.plate(scenes.lights(9, 2), depth=3.0, shape=(140, 140)).mean(-1)
    explainer = Explainer((128, 128))
    for number, frame in enumerate(frames[:8, 6:-6, 6:-6]):
        explainer.take(number, frame)
    votes = explainer.search(frames[8, 2:-10, 9:-3])
    assert (votes.rows, votes.columns) == (4, -3)
    assert votes.agree > 0.9 * votes.telling > 10 and votes.against == 0
    still = explainer.judge(frames[8, 6:-6, 6:-6], 4, -3)
    assert still.against > 0.9 * still.telling > 10 and still.agree == 0


@pytest.mark.parametrize("kind", [kind for kind in PLATES if kind != "deep relief"])
@pytest.mark.parametrize("count", [6, 12])
def test_near_lamps_are_told_from_distant_ones(kind: str, count: int) -> None:
    near, middle, far = (dimming(folders.plate(AROUND[:count], distance=d, **PLATES[kind])) for d in (1.6, 3.0, None))
    assert near.near and middle.near and not far.near
    assert near.k == pytest.approx(2 / 3, abs=0.15)
    assert 1.0 < near.distance < 2.2 < middle.distance < 4.0


def test_a_dome_under_distant_lights_has_no_near_lamps() -> None:
    """Its pictures dim as much; the curvature of the dimming has the other sign."""
    normals, _ = scenes.sphere(200)
    part = (slice(60, 140), slice(50, 150))
    images = scenes.lambertian(normals[part], np.ones((80, 100), bool), AROUND).images
    found = dimming(images)
    assert found.slope > 0.5 and found.k == pytest.approx(-1, abs=0.15) and not found.near


def test_few_or_black_pictures_tell_nothing_of_lamps() -> None:
    images = folders.plate(AROUND, distance=1.6)
    assert not dimming(images[:5]).near
    images[5:] = 0
    assert not dimming(images).near


def test_a_folder_under_near_lamps_is_warned_of(tmp_path: Path) -> None:
    def texts(name: str, images: np.ndarray, mask: np.ndarray | None = None) -> str:
        found = photos.check(photos.load(folders.write_folder(tmp_path / name, images, mask)))
        return " ".join(finding.text for finding in found if finding.level != "note")

    near = texts("near", folders.plate(AROUND, distance=1.6))
    assert "dims towards the rim" in near and "dome" in near and "moved" not in near and "edges lie" not in near
    known = photos.check(photos.load(tmp_path / "near", light_distance="2"))
    assert not any("dims towards the rim" in finding.text for finding in known)
    for name, distance in (("far", None), ("six widths", 6.0)):
        assert "dims towards the rim" not in texts(name, folders.plate(AROUND, distance=distance))
    images, mask = folders.matte(AROUND)
    assert "dims towards the rim" not in texts("object", images, mask)
