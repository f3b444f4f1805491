"""Lights that are given: whether they are those of the photographs, and how strong they were."""

from pathlib import Path

import classical_scenes as scenes
import numpy as np
import photo_folders as folders
import pytest

import sdps
from render.shared.errors import InputError
from sdps.core.metrics import angle_degrees
from sdps.methods.given_lights import (
    AXES,
    ReducedImages,
    carry_intensities,
    compare_lights,
    find_intensities,
    reduce_images,
)
from sdps.photos.light_files.light_advice import advise
from sdps.photos.light_files.light_frame import frame_matrix, frame_name

COUNT = 14
LIGHTS = scenes.lights(COUNT, lowest=0.5).astype(np.float64)
FILES = tuple(f"p{number}.png" for number in range(1, COUNT + 1))
STRENGTHS = np.random.default_rng(3).uniform(0.6, 1.4, COUNT)
STRENGTHS /= STRENGTHS.mean()


def near(lights: np.ndarray, degrees: float = 6.0) -> np.ndarray:
    """Return directions that a network may find: each is off, and all are a little."""
    draw = np.random.default_rng(7)
    found = lights + np.radians(degrees) * draw.normal(size=lights.shape) / np.sqrt(2) + [0.05, -0.03, 0.0]
    return found / np.linalg.norm(found, axis=1, keepdims=True)


@pytest.fixture(scope="module", params=["sphere", "hills"])
def images(request: pytest.FixtureRequest) -> ReducedImages:
    """A painted matte object under lights of unequal strength."""
    pictures, mask = folders.matte(LIGHTS.astype(np.float32), shape=request.param, paint=True, size=100)
    return reduce_images(pictures * STRENGTHS[:, None, None, None].astype(np.float32), mask)


@pytest.mark.parametrize("number", range(8))
def test_flipped_and_exchanged_axes_are_found(images: ReducedImages, number: int) -> None:
    """A file with other axes fits after the very turn that was made."""
    in_file = LIGHTS @ AXES[number]
    fit = compare_lights(images, FILES, in_file, STRENGTHS, near(LIGHTS))
    if number == 0:
        assert fit.better is None and fit.sure and fit.given.apart < 12
    else:
        assert fit.better is not None and fit.sure
        np.testing.assert_array_equal(fit.better.axes, AXES[number])
        assert fit.better.sorting == "" and fit.better.apart < 12 < fit.given.apart


@pytest.mark.parametrize("sorting", ["sorted", "reversed", "other"])
def test_rows_in_another_order_are_found(images: ReducedImages, sorting: str) -> None:
    names = {"sorted": sorted(FILES), "reversed": FILES[::-1], "other": np.random.default_rng(1).permutation(FILES)}
    rows = [FILES.index(name) for name in names[sorting]]
    fit = compare_lights(images, FILES, LIGHTS[rows], STRENGTHS[rows], near(LIGHTS))
    assert fit.better is not None and fit.better.sorting == sorting
    np.testing.assert_array_equal(LIGHTS[rows][fit.better.order], LIGHTS)


@pytest.mark.parametrize("inside_out", [False, True])
def test_of_a_relief_without_outline_nothing_is_sure(inside_out: bool) -> None:
    """A flipped axis shows in the curl of its normals, a half turn does not: the network's word may be wrong."""
    row, column = np.mgrid[:90, :90]
    height = 4 * np.sin(column / 7) * np.sin(row / 9) + 3 * np.sin((row + column) / 11)
    down, right = np.gradient(height)
    normals = np.stack([-right, down, np.ones_like(height)], axis=-1)
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    pictures = np.maximum(normals @ LIGHTS.T, 0).transpose(2, 0, 1)[..., None] * np.ones(3)
    relief = reduce_images(pictures, np.ones((90, 90), bool))
    seen = near(LIGHTS @ AXES[3]) if inside_out else near(LIGHTS)  # a network that takes hollows for bumps
    right_fit = compare_lights(relief, FILES, LIGHTS, np.ones(COUNT), seen)
    assert right_fit.better is None and right_fit.sure != inside_out
    flipped = compare_lights(relief, FILES, LIGHTS @ AXES[2], np.ones(COUNT), seen)
    assert flipped.better is not None and not flipped.sure
    assert (flipped.better.axes == (AXES[3] @ AXES[2] if inside_out else AXES[2])).all()
    level, text = advise(flipped, FILES, "lights.txt", "y-up")
    assert level == "error" and "--frame y-down" in text and "--frame x-left" in text


def test_intensities_are_found(images: ReducedImages) -> None:
    """What the images say corrects a network's error, by far most of it."""
    start = STRENGTHS * np.random.default_rng(2).uniform(0.85, 1.15, COUNT)
    begun = np.abs(start / start.mean() - STRENGTHS).mean()
    found = find_intensities(images, LIGHTS, start)
    assert np.abs(found - STRENGTHS).mean() < 0.4 * begun
    assert np.abs(find_intensities(images, LIGHTS, STRENGTHS) - STRENGTHS).mean() < 0.02


def test_advice_names_the_flag_that_joins_both_turns() -> None:
    for first in ("y-up", "y-down", "x-left,xy-swapped", "z-away"):
        for axes in AXES:
            joined = frame_matrix(frame_name(axes @ frame_matrix(first)))
            np.testing.assert_array_equal(joined, axes @ frame_matrix(first))
    assert frame_name(AXES[2] @ frame_matrix("y-down")) == "y-up"


@pytest.fixture(scope="module")
def photographs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A glossy sphere under lamps of which the strongest is twice as strong as the weakest; no truth beside it."""
    scene = scenes.glossy_shape("sphere", 72, COUNT)
    folder = tmp_path_factory.mktemp("given")
    lit = scene.images / scene.images.max() * 0.7 * STRENGTHS[:, None, None, None]
    folders.write_folder(folder, np.pad(lit, ((0, 0), (9, 9), (9, 9), (0, 0))), np.pad(scene.mask, 9))
    np.savetxt(folder / "right.lp", scene.lights, header=f"{COUNT}", comments="")
    np.savetxt(folder / "flipped.lp", scene.lights * [1, -1, 1], header=f"{COUNT}", comments="")
    np.save(folder / "normals.npy", np.pad(scene.normals, ((9, 9), (9, 9), (0, 0))))
    return folder


def error_of(photographs: Path, **options: object) -> float:
    """Return the mean error of the normals in degrees, unrefined."""
    photos = sdps.load(photographs, **options)
    found = sdps.infer(photos, refine=False)
    truth = np.load(photographs / "normals.npy")
    return float(angle_degrees(found.normals[photos.mask], truth[photos.mask]).mean())


def test_directions_without_intensities_are_no_worse_than_no_lights(photographs: Path) -> None:
    """What every chrome ball gives. Taken for equal, such lamps gave 12 degrees where unknown lights gave 4."""
    unknown, given = error_of(photographs), error_of(photographs, lights=photographs / "right.lp")
    equal = error_of(photographs, lights=photographs / "right.lp", intensities="equal")
    assert given < unknown + 0.3 and given < 0.6 * equal


def test_flipped_lights_stop_and_say_the_flag(photographs: Path) -> None:
    with pytest.raises(InputError) as error:
        error_of(photographs, lights=photographs / "flipped.lp")
    assert "flipped.lp do not fit" in str(error.value) and "--frame y-down" in str(error.value)
    assert error_of(photographs, lights=photographs / "flipped.lp", frame="y-down") < 10
    photos = sdps.load(photographs, lights=photographs / "flipped.lp")
    found = sdps.infer(photos, refine=False, anyway=True)
    assert "NOT TO BE USED" in found.verdict and "--frame y-down" in found.verdict
    assert found.summary()["verdict"] == found.verdict


def test_right_lights_have_no_verdict(photographs: Path) -> None:
    photos = sdps.load(photographs, lights=photographs / "right.lp")
    found = sdps.infer(photos, refine=True)
    assert found.verdict == "" and found.findings[-1].level == "note"
    facts = found.summary()
    assert facts["light_directions"] == "given" and facts["light_intensities"] == "found"
    assert "expected_light_error_degrees" not in facts["refined"]  # given lights are not exact


def test_intensities_of_a_network_are_mended_by_the_map_that_mends_its_directions() -> None:
    true = STRENGTHS / STRENGTHS.mean()
    bent = (true[:, None] * LIGHTS) @ (np.diag([1.12, 0.95, 0.9]) + 0.03)
    strengths = np.linalg.norm(bent, axis=1)
    found = carry_intensities(LIGHTS, bent / strengths[:, None], strengths)
    assert np.abs(found / true - 1.0).max() < 1e-3 < np.abs(strengths / strengths.mean() / true - 1.0).max()
    shuffled = np.roll(LIGHTS, 3, axis=0)
    kept = carry_intensities(shuffled, bent / strengths[:, None], strengths)
    np.testing.assert_allclose(kept, strengths / strengths.mean())
    few = carry_intensities(LIGHTS[:5], bent[:5] / strengths[:5, None], strengths[:5])
    np.testing.assert_allclose(few, strengths[:5] / strengths[:5].mean())
