"""Photographs reduced as they are read: by area averaging of linear values, the mask too."""

from pathlib import Path

import numpy as np
import photo_folders as folders
import pytest
from sdps_scenes import hemisphere_lights

from render.shared.errors import InputError
from render.shared.imaging.reducing import smaller_shape
from sdps.photos import check, load, scaling

LIGHTS = hemisphere_lights(5, np.random.default_rng(0))


def blocks(image: np.ndarray, every: int) -> np.ndarray:
    """Return the means of squares of pixels."""
    height, width = (side // every for side in image.shape[:2])
    shape = (height, every, width, every, *image.shape[2:])
    return image[: height * every, : width * every].reshape(shape).mean(axis=(1, 3))


@pytest.mark.parametrize(("suffix", "bits"), [(".png", 16), (".jpg", 8), (".exr", 32)])
@pytest.mark.parametrize(("scale", "every"), [(0.5, 2), (0.25, 4)])
def test_pictures_are_averaged_in_linear_light(tmp_path: Path, suffix: str, bits: int, scale: float, every: int):
    images, mask = folders.matte(LIGHTS, paint=True)
    folders.write_folder(tmp_path, images, mask, suffix=suffix, bits=bits)
    whole, less = load(tmp_path, gamma="srgb"), load(tmp_path, gamma="srgb", scale=scale)
    assert less.shape == tuple(side // every for side in whole.shape) and less.scale == scale
    assert any("reduced from" in note for note in less.notes)
    for one, other in zip(whole[0:5], less[0:5], strict=True):
        np.testing.assert_allclose(other, blocks(one, every), atol=2e-6)
    share = blocks(whole.mask.astype(float), every)
    np.testing.assert_array_equal(less.mask, share >= 0.5)
    np.testing.assert_array_equal(less.window(slice(1, 3), slice(4, 9), slice(2, 30, 3)), less[1:3][:, 4:9, 2:30:3])
    np.testing.assert_array_equal(whole.window(slice(1, 3), slice(4, 9), slice(2, 30, 3)), whole[1:3][:, 4:9, 2:30:3])
    assert {finding.level for finding in check(less)} <= {"warning", "note"}


def test_odd_sides_keep_the_light(tmp_path: Path) -> None:
    images, _ = folders.matte(LIGHTS)
    folders.write_folder(tmp_path, images[:, :101, :77], bits=16)
    less = load(tmp_path, scale=0.3)
    assert less.shape == (30, 23)
    np.testing.assert_allclose(less[0:1].mean(), load(tmp_path)[0:1].mean(), rtol=1e-4)


def test_an_automatic_mask_is_found_on_what_is_left(tmp_path: Path) -> None:
    images, mask = folders.matte(LIGHTS)
    folders.write_folder(tmp_path, images, bits=16)
    found = load(tmp_path, scale=0.5)
    assert found.mask_origin == "automatic"
    assert (found.mask != (blocks(mask.astype(float), 2) >= 0.5)).mean() < 0.03


def test_what_is_not_finite_spoils_the_pixel_it_falls_into(tmp_path: Path) -> None:
    images, mask = folders.matte(LIGHTS)
    row, column = np.argwhere(mask)[len(np.argwhere(mask)) // 2]
    images[2, row, column] = np.nan
    folders.write_folder(tmp_path, images, mask, suffix=".exr")
    with pytest.raises(InputError, match=r"3\.exr: NaN or infinite values inside the mask \(1 pixels"):
        load(tmp_path, scale=0.5)


def test_a_mask_may_be_of_the_reduced_size(tmp_path: Path) -> None:
    images, mask = folders.matte(LIGHTS)
    folders.write_folder(tmp_path, images, bits=16)
    small = blocks(mask.astype(float), 2) >= 0.5
    folders.write(tmp_path / "beside" / "small.png", small.astype(np.float32))
    np.testing.assert_array_equal(load(tmp_path, scale=0.5, mask=tmp_path / "beside" / "small.png").mask, small)
    folders.write(tmp_path / "beside" / "other.png", small[:10].astype(np.float32))
    with pytest.raises(InputError, match="the mask is 52x10 pixels, the pictures are 104x104"):
        load(tmp_path, scale=0.5, mask=tmp_path / "beside" / "other.png")
    speck = np.zeros(mask.shape, np.float32)
    speck[40, 41] = 1.0
    folders.write(tmp_path / "beside" / "speck.png", speck)
    with pytest.raises(InputError, match="nothing is left of the mask"):
        load(tmp_path, scale=0.25, mask=tmp_path / "beside" / "speck.png")


@pytest.mark.parametrize("scale", [0, -0.5, 1.01, float("nan"), float("inf"), "0.5", True, None])
def test_scales_that_are_none(tmp_path: Path, scale: object) -> None:
    with pytest.raises(InputError, match=r"scale .* above 0 and at most 1"):
        load(tmp_path, scale=scale)  # type: ignore[arg-type]


def test_pictures_that_would_fill_the_memory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(scaling, "MOST_PIXELS", 5000)
    images, mask = folders.matte(LIGHTS)
    folders.write_folder(tmp_path, images, mask)
    with pytest.raises(InputError, match=r"1\.png: is 104x104 pixels; .* give --scale 0\.65 "):
        load(tmp_path)
    assert load(tmp_path, scale=0.65).shape == (68, 68)
    assert check(load(tmp_path, anyway=True))[0].level == "error"


def test_a_scale_that_leaves_nothing() -> None:
    assert smaller_shape((100, 200), 1.0) == (100, 200)
    with pytest.raises(InputError, match="leaves 4x2 pixels of pictures of 200x100"):
        smaller_shape((100, 200), 0.02)
