"""Masks and pictures of normals are known by their values, and photographs are never taken for either."""

import io

import classical_scenes as scenes
import cv2
import numpy as np
import photo_folders as folders
import pytest
from PIL import Image, ImageDraw

from render.shared.images import encode_normals
from sdps.photos.pictures.contents import judge_content, like_mask
from sdps.photos.pictures.picture_names import MASK, NORMALS

LIGHTS = np.array([[0.5, 0, 0.8], [-0.5, 0, 0.8], [0, 0.5, 0.8], [0, -0.9, 0.1], [0, 0, 1]])


def disc(size: int = 96, smooth: int = 1) -> np.ndarray:  # (H, W, 3) uint8
    """Return a white disc on black; drawn larger by `smooth`, its edge has grey values."""
    image = Image.new("L", (size * smooth, size * smooth))
    ImageDraw.Draw(image).ellipse([size * smooth * part for part in (0.2, 0.1, 0.8, 0.7)], fill=255)
    return np.repeat(np.asarray(image.resize((size, size), Image.Resampling.BOX))[..., None], 3, axis=2)


def as_jpeg(pixels: np.ndarray, quality: int = 85) -> np.ndarray:
    file = io.BytesIO()
    Image.fromarray(pixels).save(file, "JPEG", quality=quality)
    return np.asarray(Image.open(file).convert("RGB"))


def normals(size: int = 96, shape: str = "hills") -> np.ndarray:
    found, mask = getattr(scenes, shape)(size)
    return np.where(mask[..., None], found, 0)


def test_masks() -> None:
    assert judge_content(disc()) == MASK
    assert judge_content(disc(smooth=4)) == MASK  # an anti-aliased edge
    assert judge_content(disc().astype(np.uint16) * 257) == MASK
    assert judge_content(disc().astype(np.float32) / 255) == MASK
    assert judge_content(disc() // 2) == MASK
    assert judge_content(disc() // 255 * np.array([200, 0, 0], np.uint8)) == MASK  # a label's colour
    for quality in (60, 85, 98):
        assert judge_content(as_jpeg(disc(256), quality), lossy=True) == MASK


@pytest.mark.parametrize("background", [0, 127, 128, 255])
@pytest.mark.parametrize("shape", ["hills", "sphere"])
def test_pictures_of_normals(shape: str, background: int) -> None:
    vectors = normals(shape=shape)
    outside = ~vectors.any(-1)
    coded = encode_normals(vectors)
    coded[outside] = background
    assert judge_content(coded) == NORMALS
    wide = np.rint((vectors + 1) / 2 * 65535).astype(np.uint16)
    assert judge_content(wide) == NORMALS
    assert judge_content(vectors.astype(np.float32)) == NORMALS
    assert judge_content(((vectors + 1) / 2).astype(np.float32)) == NORMALS


@pytest.mark.parametrize("quality", [75, 95])
def test_pictures_of_normals_as_jpeg(quality: int) -> None:
    assert judge_content(as_jpeg(encode_normals(normals(300)), quality), lossy=True) == NORMALS


def test_a_relief_of_normals_that_fills_the_frame() -> None:
    y, x = np.mgrid[:64, :64] / 9
    slopes = np.stack([0.1 * np.sin(x), 0.1 * np.cos(y), np.ones_like(x)], axis=-1)
    assert judge_content(encode_normals(slopes / np.linalg.norm(slopes, axis=-1, keepdims=True))) == NORMALS


@pytest.mark.parametrize("bits", [8, 16, 32])
@pytest.mark.parametrize("gain", [0.01, 0.1, 1, 3, 30, 1000])
def test_photographs_are_neither(gain: float, bits: int) -> None:
    images, _ = folders.matte(LIGHTS, size=96)
    for image in images:
        for tint in ([1, 1, 1], [0.5, 0.5, 1], [1, 0.7, 0.4]):
            values = np.clip(image * gain * np.array(tint), 0, 1 if bits < 32 else None).astype(np.float32)
            if bits < 32:
                values = np.rint(values * (2**bits - 1)).astype(np.uint8 if bits == 8 else np.uint16)
            assert judge_content(values) is None
            if bits == 8:
                assert judge_content(as_jpeg(values), lossy=True) is None


def test_odd_photographs_are_neither() -> None:
    rng = np.random.default_rng(0)
    for level in (0, 3, 54, 127, 128, 201, 255):  # 54 and 201: greys that decode to unit vectors
        noisy = np.clip(rng.normal(level, 2, (80, 90, 1)), 0, 255).astype(np.uint8).repeat(3, axis=2)
        assert judge_content(noisy) is None
        assert judge_content(np.full((80, 90, 3), level, np.uint8)) is None
    black = np.zeros((80, 90, 3), np.uint8)
    black[40:43, 40:43] = 255  # a mirror's highlight
    assert judge_content(black) is None
    assert judge_content((rng.random((80, 90, 1)) < 0.2).astype(np.uint8).repeat(3, axis=2)) is None  # almost black
    assert judge_content(disc(12)) is None  # too small to say
    blue = np.clip(rng.normal((128, 128, 240), 12, (80, 90, 3)), 0, 255).astype(np.uint8)
    assert judge_content(blue) is None
    assert judge_content(np.full((80, 90, 3), np.nan, np.float32)) is None
    assert judge_content(np.full((80, 90, 3), 1e30, np.float32)) is None


def test_an_overexposed_object_has_shading_at_its_edge() -> None:
    y, x = np.mgrid[-1:1:200j, -1:1:200j]
    height = np.sqrt(np.maximum(0.5 - x**2 - y**2, 0))
    lit = np.where(x**2 + y**2 < 0.5, np.clip(4 * (0.5 * x + 0.8 * height), 0, 1), 0)
    image = np.rint(255 * cv2.GaussianBlur(lit, (3, 3), 0.7)).astype(np.uint8)[..., None].repeat(3, axis=2)
    assert judge_content(image) is None


def test_like_a_mask() -> None:
    assert like_mask(disc(smooth=4)) and like_mask(cv2.GaussianBlur(disc(), (5, 5), 1))
    assert like_mask(np.full((9, 9, 3), 255, np.uint8)) and not like_mask(np.zeros((9, 9, 3), np.uint8))
    assert not like_mask(np.linspace(0, 255, 300).astype(np.uint8).reshape(10, 10, 3))
