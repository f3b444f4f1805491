"""Inference: what comes out does not depend on how the object is framed, chunked or ordered."""

import json
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from sdps_scenes import hemisphere_lights, shade, sphere_normals

from render.shared.config import to_plain
from render.shared.errors import InputError
from sdps.core.metrics import score
from sdps.data.augment import Augmentation, measure_exposure
from sdps.inference import chunked, image_source
from sdps.inference.estimator import Estimator
from sdps.models.checkpoint import TrainedModel
from sdps.models.cnnps import predict_normals
from sdps.models.registry import create

METADATA = {"config": {"augmentation": to_plain(Augmentation())}}


def trained(name: str, **options: Any) -> TrainedModel:
    """Return a model with random weights."""
    torch.manual_seed(0)
    return TrainedModel(name, create(name, **options).eval(), options, METADATA)


@pytest.fixture(scope="module")
def estimator() -> Estimator:
    models = {"lighting": trained("lcnet"), "normals": trained("nenet")}
    return Estimator(**models, device=torch.device("cpu"), precision="float32", read_out="centre")


def scene(size: int = 90, count: int = 6) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    normals, mask = sphere_normals(size, radius=0.6)
    lights = hemisphere_lights(count, np.random.default_rng(0))
    return shade(normals, lights), mask, lights


def test_shapes_dtypes_and_units(estimator: Estimator) -> None:
    images, mask, _ = scene()
    estimate = estimator.estimate(images, mask)
    assert estimate.normals.shape == (90, 90, 3)
    assert estimate.normals.dtype == estimate.light_directions.dtype == estimate.intensities.dtype == np.float32
    np.testing.assert_allclose(np.linalg.norm(estimate.normals[mask], axis=-1), 1.0, rtol=1e-5)
    np.testing.assert_array_equal(estimate.normals[~mask], 0.0)
    np.testing.assert_allclose(np.linalg.norm(estimate.light_directions, axis=-1), 1.0, rtol=1e-5)
    assert estimate.intensities.shape == estimate.confidence.shape == (6,)


@pytest.mark.parametrize(("count", "height", "width"), [(1, 37, 61), (2, 300, 20), (3, 5, 7)])
def test_any_number_and_size_of_images(estimator: Estimator, count: int, height: int, width: int) -> None:
    images = np.random.default_rng(0).random((count, height, width, 3), dtype=np.float32)
    estimate = estimator.estimate(images, np.ones((height, width), bool))
    assert estimate.normals.shape == (height, width, 3)
    assert np.isfinite(estimate.normals).all()
    assert np.isfinite(estimate.light_directions).all()


def test_order_of_images_does_not_matter(estimator: Estimator) -> None:
    images, mask, _ = scene()
    order = np.array([3, 0, 5, 1, 4, 2])
    straight, shuffled = estimator.estimate(images, mask), estimator.estimate(images[order], mask)
    np.testing.assert_array_equal(straight.light_directions[order], shuffled.light_directions)
    np.testing.assert_array_equal(straight.intensities[order], shuffled.intensities)
    np.testing.assert_allclose(straight.normals, shuffled.normals, atol=1e-4)


def test_chunks_background_and_brightness_do_not_matter(estimator: Estimator) -> None:
    images, mask, _ = scene()
    reference = estimator.estimate(images, mask)
    chunked = replace(estimator, chunk_pixels=1).estimate(images, mask)
    np.testing.assert_allclose(chunked.normals, reference.normals, atol=1e-4)
    noisy = np.where(mask[..., None], images, 7.0)
    np.testing.assert_array_equal(estimator.estimate(noisy, mask).normals, reference.normals)
    dim = estimator.estimate(images * np.float32(2**-7), mask)  # an exact scale, so the same numbers
    np.testing.assert_allclose(dim.normals, reference.normals, atol=1e-4)
    np.testing.assert_array_equal(dim.light_directions, reference.light_directions)


def test_object_is_found_wherever_it_is(estimator: Estimator) -> None:
    images, mask, _ = scene()
    reference = estimator.estimate(images, mask)
    wide = np.pad(images, ((0, 0), (40, 0), (24, 60), (0, 0)))
    moved = estimator.estimate(wide, np.pad(mask, ((40, 0), (24, 60))))
    np.testing.assert_array_equal(moved.light_directions, reference.light_directions)
    np.testing.assert_allclose(moved.normals[40:, 24:114], reference.normals, atol=1e-5)
    framed = replace(estimator, margin=None).estimate(wide, np.pad(mask, ((40, 0), (24, 60))))
    assert np.abs(framed.light_directions - reference.light_directions).max() > 1e-3  # a smaller object


def test_given_lights_are_used_and_their_scale_is_not(estimator: Estimator) -> None:
    images, mask, lights = scene()
    gains = np.linspace(0.5, 2.0, 6)
    first = estimator.estimate(images, mask, lights, gains)
    second = estimator.estimate(images, mask, 3.0 * lights, np.repeat(100.0 * gains[:, None], 3, axis=1))
    np.testing.assert_allclose(first.light_directions, lights, atol=1e-6)
    np.testing.assert_allclose(first.intensities / first.intensities[0], gains / gains[0], rtol=1e-5)
    np.testing.assert_allclose(first.normals, second.normals, atol=1e-4)
    assert first.confidence is None
    unaided = replace(estimator, lighting=None)
    np.testing.assert_array_equal(unaided.estimate(images, mask, lights, gains).normals, first.normals)
    with pytest.raises(InputError, match="must be given"):
        unaided.estimate(images, mask)


def test_bfloat16_is_close_to_float32(estimator: Estimator) -> None:
    images, mask, lights = scene()
    full, half = (
        replace(estimator, precision=precision).estimate(images, mask, lights, np.ones(6)).normals[mask]
        for precision in ("float32", "bfloat16")
    )
    assert (full * half).sum(-1).mean() > 0.999


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"images": np.zeros((0, 90, 90, 3), np.float32)}, r"L >= 1"),
        ({"images": np.zeros((2, 90, 90), np.float32)}, r"\(L, H, W, 3\)"),
        ({"mask": np.ones((90, 80), bool)}, "mask must be bool of shape"),
        ({"mask": np.ones((90, 90), np.uint8)}, "mask must be bool"),
        ({"mask": np.zeros((90, 90), bool)}, "mask is empty"),
        ({"images": np.full((6, 90, 90, 3), np.nan, np.float32)}, "NaN"),
        ({"lights": np.ones((5, 3))}, "6 images need light directions"),
        ({"lights": np.zeros((6, 3))}, "zero or NaN"),
        ({"intensities": np.zeros(6)}, "positive"),
    ],
)
def test_unusable_input_is_refused_in_one_line(estimator: Estimator, change: dict, message: str) -> None:
    images, mask, _ = scene()
    with pytest.raises(InputError, match=message) as error:
        estimator.estimate(**{"images": images, "mask": mask, **change})
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"lighting": "nenet"}, "lighting: 'nenet' is a model for 'normals', not for lighting"),
        ({"normals": "lcnet"}, "normals: 'lcnet' is a model for 'lighting', not for normals or pixels"),
        ({"rotations": 0}, "rotations must be at least 1, got 0"),
        ({"chunk_pixels": 0}, "chunk_pixels must be at least 1"),
        ({"margin": -1}, "margin must be at least 0"),
    ],
)
def test_models_and_options_that_do_not_fit_are_refused(estimator: Estimator, change: dict, message: str) -> None:
    change = {key: trained(value) if isinstance(value, str) else value for key, value in change.items()}
    with pytest.raises(InputError, match=message):
        replace(estimator, **change)


class Recorder:
    """A source that makes images on demand and notes how many it was asked for."""

    def __init__(self, images: np.ndarray) -> None:
        self.images, self.asked = images, []

    def __len__(self) -> int:
        return len(self.images)

    def __getitem__(self, part: slice) -> np.ndarray:
        self.asked.append(part.stop - part.start)
        return self.images[part].astype(np.float16)


def test_any_source_of_images_will_do(estimator: Estimator, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    images, mask, _ = scene()
    images = images.astype(np.float16)
    reference = estimator.estimate(images, mask)
    np.save(tmp_path / "images.npy", images)
    monkeypatch.setattr(image_source, "_READ_PIXELS", 2 * mask.size)
    recorder = Recorder(images)
    for source in (recorder, np.load(tmp_path / "images.npy", mmap_mode="r"), list(images)):
        estimate = estimator.estimate(source, mask)
        np.testing.assert_array_equal(estimate.light_directions, reference.light_directions)
        np.testing.assert_allclose(estimate.normals, reference.normals, atol=1e-5)
    assert max(recorder.asked) == 2


def test_a_source_of_unequal_images_is_refused(estimator: Estimator, monkeypatch: pytest.MonkeyPatch) -> None:
    images, mask, _ = scene()
    monkeypatch.setattr(image_source, "_READ_PIXELS", 1)
    with pytest.raises(InputError, match=r"one size.*got \(90, 80\) for image 5"):
        estimator.estimate([*images[:5], images[5][:, :80]], mask)


def test_nan_outside_the_mask_is_no_concern(estimator: Estimator) -> None:
    images, mask, _ = scene()
    reference = estimator.estimate(images, mask)
    broken = np.where(mask[..., None], images, np.float32(np.nan))
    np.testing.assert_array_equal(estimator.estimate(broken, mask).normals, reference.normals)


def test_exposure_is_measured_on_a_fair_sample(estimator: Estimator, monkeypatch: pytest.MonkeyPatch) -> None:
    images, mask, _ = scene(count=12)
    exact = estimator.estimate(images, mask).exposure
    assert exact["normals"] == pytest.approx(measure_exposure(images[:, mask], Augmentation()).scale, rel=1e-5)
    monkeypatch.setattr(image_source, "EXPOSURE_VALUES", 12 * 3 * 400)
    sampled = estimator.estimate(images, mask).exposure
    assert sampled["normals"] != exact["normals"]
    assert sampled["normals"] == pytest.approx(exact["normals"], rel=0.1)


def test_intensities_alone_may_be_given(estimator: Estimator) -> None:
    images, mask, _ = scene()
    gains = np.linspace(0.5, 2.0, 6)
    blind = estimator.estimate(images, mask)
    told = estimator.estimate(images, mask, intensities=gains)
    np.testing.assert_array_equal(told.light_directions, blind.light_directions)
    np.testing.assert_allclose(told.intensities, gains / gains.mean() * 1.1, rtol=1e-5)  # the mean of (0.2, 2)
    again = estimator.estimate(images, mask, blind.light_directions, gains)
    np.testing.assert_allclose(told.normals, again.normals, atol=1e-5)


def test_directions_alone_leave_intensities_to_the_lighting_model(estimator: Estimator) -> None:
    images, mask, lights = scene()
    np.testing.assert_array_equal(
        estimator.estimate(images, mask, lights).intensities, estimator.estimate(images, mask).intensities
    )
    assumed = replace(estimator, lighting=None).estimate(images, mask, lights)
    np.testing.assert_allclose(assumed.intensities, 1.1, rtol=1e-6)


@pytest.mark.parametrize("name", ["nenet", "nenet-norm", "cnnps"])
def test_colours_of_lights_are_divided_out(estimator: Estimator, name: str) -> None:
    images, mask, lights = scene(size=24)
    model = replace(estimator, normals=trained(name), rotations=2)
    colours = np.random.default_rng(1).uniform(0.5, 2.0, (6, 3))
    coloured = images * colours[:, None, None].astype(np.float32)
    white = model.estimate(images, mask, lights, np.ones(6)).normals[mask]
    divided = model.estimate(coloured, mask, lights, colours).normals[mask]
    assert (divided * white).sum(-1).mean() > 0.999  # not 1: the exposures differ a little


@pytest.mark.parametrize("lighting", [None, "lcnet"])
def test_networks_told_no_lights_work_without(estimator: Estimator, lighting: str | None) -> None:
    images, mask, lights = scene(size=48)
    alone = replace(estimator, lighting=trained(lighting) if lighting else None, normals=trained("upsfcn-deep-mask"))
    estimate = alone.estimate(images, mask)
    np.testing.assert_allclose(np.linalg.norm(estimate.normals[mask], axis=-1), 1.0, rtol=1e-5)
    if lighting is None:
        assert estimate.light_directions.shape == (0, 3)
        assert estimate.intensities.shape == (0,)
        with pytest.raises(InputError, match="0 estimated light directions against 6"):
            score(estimate, mask, light_directions=lights)
        with pytest.raises(InputError, match="0 estimated light intensities against 6"):
            score(estimate, mask, intensities=np.ones(6))
        given = alone.estimate(images, mask, lights)
        np.testing.assert_allclose(given.light_directions, lights, atol=1e-6)
        assert given.intensities.shape == (0,)
    else:
        expected = estimator.estimate(images, mask)
        np.testing.assert_array_equal(estimate.light_directions, expected.light_directions)
    told = alone.estimate(images, mask, lights, np.ones(6))
    np.testing.assert_array_equal(told.normals, estimate.normals)


@pytest.mark.parametrize("views", [1, 2])
def test_a_network_that_tells_the_error_to_expect_tells_it_in_degrees(estimator: Estimator, views: int) -> None:
    images, mask, lights = scene(size=50)
    model = replace(estimator, normals=trained("frames"), normal_views=views)
    expected = model.estimate(images, mask, lights, np.ones(6)).expected_error
    assert expected.shape == mask.shape and not expected[~mask].any()
    np.testing.assert_allclose(expected[mask], 2.0 * np.degrees(np.arcsin(0.5 * np.exp(-2.0))), rtol=1e-4)
    assert estimator.estimate(images, mask, lights, np.ones(6)).expected_error is None


@pytest.mark.parametrize("views", [1, 2])
def test_a_network_that_tells_the_error_of_lights_to_expect_tells_it(estimator: Estimator, views: int) -> None:
    images, mask, _ = scene(size=50)
    model = replace(estimator, lighting=trained("lightset"), light_views=views)
    first = model.estimate(images, mask)
    errors = first.expected_light_error
    assert errors is not None and errors.shape == (6,) and first.confidence is None
    assert ((errors > 0.0) & (errors < 180.0)).all()
    second = model.estimate(images, mask, found=model.estimate_lights(images, mask))
    np.testing.assert_array_equal(second.expected_light_error, errors)
    assert estimator.estimate(images, mask).expected_light_error is None


@pytest.mark.parametrize("lighting", ["lcnet", "lightset"])
def test_lights_found_before_change_nothing(lighting: str) -> None:
    images, mask, lights = scene(size=72)
    gains = np.linspace(0.5, 2.0, 6)
    models = {"lighting": trained(lighting), "normals": trained("nenet")}
    estimator = Estimator(**models, device=torch.device("cpu"), precision="float32", light_views=2)
    for given in ({}, {"intensities": gains}):
        expected = estimator.estimate(images, mask, **given)
        found = estimator.estimate_lights(images, mask, **given)
        estimate = estimator.estimate(images, mask, **given, found=found)
        assert estimate.seconds > found.seconds  # of both
        np.testing.assert_equal(vars(replace(estimate, seconds=0.0)), vars(replace(expected, seconds=0.0)))
    for wrong in ({"images": images[:5]}, {"lights": lights, "intensities": gains}):
        with pytest.raises(InputError, match="found holds lights of other images"):
            estimator.estimate(**{"images": images, "mask": mask, "found": found, **wrong})


def test_inference_gives_what_training_sees() -> None:
    """On images of 128x128, which are not resized."""
    images, mask, lights = scene(size=128)
    lighting, normals = trained("lcnet-soft"), trained("nenet-plus")
    estimator = Estimator(
        lighting=lighting, normals=normals, device=torch.device("cpu"), precision="float32", margin=None
    )
    estimate = estimator.estimate(images, mask)
    exposed = measure_exposure(images[:, mask], Augmentation()).apply(images * mask[..., None])
    seen = torch.from_numpy(exposed).permute(0, 3, 1, 2)[None], torch.from_numpy(mask.astype(np.float32))[None, None]
    with torch.no_grad():
        expected = lighting.network.read_lights(lighting.network(*seen))
        found = normals.network(normals.network.observe(*seen, expected))[0].permute(1, 2, 0).numpy()
    np.testing.assert_allclose(estimate.light_directions, expected.directions[0], atol=1e-4)
    np.testing.assert_allclose(estimate.intensities, expected.intensities[0], atol=1e-4)
    np.testing.assert_allclose(estimate.normals[mask], found[mask], atol=1e-3)
    assert estimate.exposure.keys() == {"lighting", "normals"}
    known = estimator.estimate(images, mask, lights, np.ones(6))
    assert known.exposure.keys() == {"normals"}  # nothing was asked about lights


def test_pixel_networks_see_the_whole_pixel(estimator: Estimator, monkeypatch: pytest.MonkeyPatch) -> None:
    images, mask, lights = scene(size=24)
    gains = np.linspace(0.5, 2.0, 6).astype(np.float32)
    model = replace(estimator, normals=trained("cnnps"), rotations=3)
    estimate = model.estimate(images, mask, lights, gains)
    grey = torch.from_numpy((images / gains[:, None, None, None])[:, mask].mean(-1).T)
    expected = np.zeros((*mask.shape, 3), np.float32)
    with torch.no_grad():
        valid = torch.ones_like(grey, dtype=torch.bool)
        found = predict_normals(model.normals.network, grey, torch.from_numpy(lights), valid, rotations=3)
    expected[mask] = found
    np.testing.assert_allclose(estimate.normals, expected, atol=1e-4)
    monkeypatch.setattr(chunked, "_GREY_VALUES", 6 * 50)  # 50 pixels at a time
    np.testing.assert_allclose(model.estimate(images, mask, lights, gains).normals, expected, atol=1e-4)


@pytest.mark.slow
def test_a_thousand_images_fit_in_two_gibibytes() -> None:
    root = Path(__file__).parents[3]
    command = [sys.executable, "tests/support/inference_memory.py", "1000", "nenet", "lcnet"]
    environment = os.environ | {"PYTHONPATH": str(root)}
    done = subprocess.run(command, check=True, capture_output=True, text=True, cwd=root, env=environment)
    measured = json.loads(done.stdout)
    assert measured["finite"]
    assert measured["object_share"] > 0.8
    assert measured["peak_mib"] < 2048.0
