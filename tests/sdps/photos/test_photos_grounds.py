"""Automatic masks where the ground is bright: kept on tables, given up where the object fills the frame."""

import classical_scenes as scenes
import numpy as np
import photo_folders as folders
import pytest

from sdps.photos.masks import Variation, automatic_mask

LIGHTS = scenes.lights(16, 3)


def found(images: np.ndarray) -> tuple[np.ndarray, str]:
    variation = Variation(images.shape[1:3])
    for image in images:
        variation.add(image.mean(-1))
    return automatic_mask(variation)


@pytest.mark.parametrize("count", [4, 6])
@pytest.mark.parametrize("seed", range(3))
def test_lumps_on_a_plate_are_no_object(count: int, seed: int) -> None:
    """One lump of many was the mask: the part of the frame that changes most."""
    images = folders.plate(scenes.lights(count, seed, 0.5), lumps=True, seed=seed)
    mask, said = found(images)
    assert mask.all(), said
    assert "whole frame" in said


@pytest.mark.parametrize("paint", [False, True])
@pytest.mark.parametrize("ground", [0.05, 0.1, 0.2, 0.3, 0.4])
def test_an_object_on_a_grey_table_keeps_its_mask(ground: float, paint: bool) -> None:
    images, mask = folders.matte(LIGHTS, shape="sphere", paint=paint, size=96)
    images[:, ~mask] += (ground * LIGHTS[:, 2])[:, None, None]
    got, _ = found(images)
    assert (got & mask).sum() / (got | mask).sum() > 0.93


@pytest.mark.parametrize("paint", [False, True])
def test_an_object_on_a_white_table_is_not_told_from_it(paint: bool) -> None:
    images, mask = folders.matte(LIGHTS, shape="sphere", paint=paint, size=96)
    images[:, ~mask] += (0.8 * LIGHTS[:, 2])[:, None, None]
    got, said = found(images)
    assert got.all() and "whole frame" in said


def test_two_objects_before_a_dark_ground_keep_the_larger() -> None:
    images, mask = folders.matte(LIGHTS, size=96)
    small, other = folders.matte(LIGHTS, size=80, shape="sphere")
    height = max(mask.shape[0], other.shape[0])
    padded = [np.pad(part, ((0, 0), (0, height - part.shape[1]), (0, 0), (0, 0))) for part in (images, small)]
    got, _ = found(np.concatenate(padded, axis=2))
    mask = np.pad(mask, ((0, 0), (0, other.shape[1])))
    assert (got & mask).sum() / (got | mask).sum() > 0.95
