"""Inference: what comes out does not depend on how the object is framed, chunked or ordered."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from sdps_scenes import hemisphere_lights, shade, sphere_normals

from render.config import to_plain
from render.errors import InputError
from sdps.augment import Augmentation
from sdps.checkpoint import TrainedModel, save_weights
from sdps.inference import Estimator, load_pair
from sdps.models.registry import create


@pytest.fixture(scope="module")
def estimator(tmp_path_factory: pytest.TempPathFactory) -> Estimator:
    folder = tmp_path_factory.mktemp("weights")
    torch.manual_seed(0)
    metadata = {"config": {"augmentation": to_plain(Augmentation())}}
    for name, options in (("lcnet", {"direction_classes": 36, "intensity_classes": 20}), ("nenet", {})):
        save_weights(folder / f"{name}.safetensors", TrainedModel(name, create(name, **options), options, metadata))
    return load_pair(folder / "lcnet.safetensors", folder / "nenet.safetensors", device="cpu")


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
    assert estimate.intensities.shape == estimate.diagnostics["confidence"].shape == (6,)


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


def test_given_lights_are_used_and_their_scale_is_not(estimator: Estimator) -> None:
    images, mask, lights = scene()
    gains = np.linspace(0.5, 2.0, 6)
    first = estimator.estimate(images, mask, lights, gains)
    second = estimator.estimate(images, mask, 3.0 * lights, np.repeat(100.0 * gains[:, None], 3, axis=1))
    np.testing.assert_allclose(first.light_directions, lights, atol=1e-6)
    np.testing.assert_allclose(first.intensities / first.intensities[0], gains / gains[0], rtol=1e-5)
    np.testing.assert_allclose(first.normals, second.normals, atol=1e-4)
    assert "confidence" not in first.diagnostics
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


def test_swapped_files_are_noticed(estimator: Estimator, tmp_path: Path) -> None:
    save_weights(tmp_path / "a.safetensors", estimator.lighting)
    with pytest.raises(InputError, match="'nenet' is needed"):
        load_pair(None, tmp_path / "a.safetensors")
