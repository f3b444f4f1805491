"""Refinement under low-order light, against closed forms: a sphere under harmonics, a bowl that shades itself."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from render.shared.errors import InputError
from render.shared.imaging.vectors import spiral, unit
from sdps.core.geometry import Camera
from sdps.core.lighting import IRRADIANCE, harmonics
from sdps.core.metrics import angle_degrees
from sdps.refinement.surroundings import light_fit, low_order
from sdps.refinement.surroundings.hidden import find_hidden, visible_harmonics
from sdps.refinement.surroundings.low_order import LowOrderConfig, LowOrderResult, refine_low_order

SIDE = 56
EVERY = LowOrderConfig(coarse_pixels=SIDE**2)
"""No coarse grid."""


def sphere(side: int = SIDE) -> tuple[np.ndarray, np.ndarray]:
    """Return mask and normals of a ball that fills the picture."""
    y, x = np.mgrid[1 : -1 : side * 1j, -1 : 1 : side * 1j]
    mask = np.hypot(x, y) < 0.95
    normals = np.stack([x, y, np.sqrt(np.maximum(1 - x**2 - y**2, 0))], axis=-1)
    return mask, (normals * mask[..., None]).astype(np.float32)


def draw_light(count: int = 8, seed: int = 0) -> np.ndarray:
    """Return harmonics (L, 9, 3) of light from three coloured lamps each, and from all around."""
    rng = np.random.default_rng(seed)
    lamps = unit(rng.normal(size=(count, 3, 3)) + np.array([0.0, 0.0, 1.0]))
    light = np.einsum("lkh,lkc->lhc", harmonics(lamps), rng.uniform(0.2, 1.0, (count, 3, 3)))
    light[:, 0] += 0.3
    return light


def paint(mask: np.ndarray, seen: np.ndarray, light: np.ndarray, albedo: np.ndarray | None = None) -> np.ndarray:
    """Return images (L, H, W, 3) of pixels that see so much of each harmonic, (P, 9)."""
    images = np.zeros((len(light), *mask.shape, 3), np.float32)
    shaded = np.einsum("pk,lkc->lpc", seen, light)
    images[:, mask] = shaded if albedo is None else shaded * albedo[mask]
    return images


def draw_images(seed: int = 0, count: int = 8) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return images, mask, normals, light and albedo of a painted ball."""
    mask, normals = sphere()
    light = draw_light(count, seed)
    stripes = 0.6 + 0.3 * np.sign(np.sin(np.arange(SIDE) / 3.0))
    albedo = stripes[:, None, None] * np.array([1.0, 0.7, 0.5]) * np.ones((SIDE, SIDE, 1))
    seen = harmonics(normals[mask].astype(np.float64)) * IRRADIANCE
    return paint(mask, seen, light, albedo), mask, normals, light, albedo


def disturb(normals: np.ndarray, mask: np.ndarray, degrees: float = 10.0) -> np.ndarray:
    """Return normals turned by slow waves."""
    y, x = np.mgrid[: mask.shape[0], : mask.shape[1]] * (2 * np.pi / 25.0)
    waves = np.stack([np.sin(x + 0.3), np.cos(y), 0 * x], axis=-1) * np.radians(degrees)
    return (unit(normals + waves) * mask[..., None]).astype(np.float32)


def measure(found: LowOrderResult, mask: np.ndarray, normals: np.ndarray) -> float:
    return float(angle_degrees(found.normals[mask], normals[mask]).mean())


def find_light(
    images: np.ndarray, mask: np.ndarray, normals: np.ndarray, albedo: np.ndarray, hidden: Tensor
) -> np.ndarray:
    """Return the light (L, 9, 3) that explains images best, if all else is known."""
    values = np.ascontiguousarray(images[:, mask].transpose(1, 0, 2))
    ones, places = np.ones(len(images), np.float32), np.zeros((len(values), 3))
    pixels = light_fit.gather(values, np.full((len(images), 3), np.inf), ones, places, hidden)
    found = light_fit.start_fit(pixels)._replace(albedo=torch.from_numpy(albedo[mask].astype(np.float32)))
    basis = light_fit.spread(torch.from_numpy(normals[mask]), pixels)
    return light_fit.fit_light(pixels, basis, found)[..., :9].permute(0, 2, 1).numpy()


def test_light_is_found() -> None:
    images, mask, normals, light, albedo = draw_images()
    found = find_light(images, mask, normals, albedo, torch.zeros(int(mask.sum()), 9, 3))
    sideways = [1, 3, 4, 5, 7, 8]  # 1, z and z^2 are nearly dependent on the half of a ball that is seen
    np.testing.assert_allclose(found[:, sideways], light[:, sideways], atol=0.1 * np.abs(light).max())
    seen = harmonics(normals[mask].astype(np.float64)) * IRRADIANCE
    np.testing.assert_allclose(paint(mask, seen, found), paint(mask, seen, light), atol=0.02 * np.abs(light).max())


def test_true_normals_stay() -> None:
    images, mask, normals, light, albedo = draw_images()
    found = refine_low_order(images, mask, normals, config=EVERY)
    assert measure(found, mask, normals) < 2.0 and not found.doubt and found.misfit[0] < 2e-4
    size = np.mean(albedo[mask])
    assert np.abs(found.albedo[mask] / albedo[mask] * size - 1).mean() < 0.15
    assert found.albedo[mask].mean() == pytest.approx(1.0, rel=1e-4)
    assert (found.normals[~mask] == 0).all() and (found.expected[~mask] == 0).all()
    assert np.corrcoef(found.light.ravel(), light.ravel())[0, 1] > 0.7


@pytest.mark.parametrize("coarse", [SIDE**2, SIDE**2 // 4])
def test_a_disturbed_start_gets_better(coarse: int) -> None:
    images, mask, normals, *_ = draw_images()
    start = disturb(normals, mask)
    before = angle_degrees(start[mask], normals[mask]).mean()
    found = refine_low_order(images, mask, start, config=LowOrderConfig(coarse_pixels=coarse))
    assert before > 7.0 and measure(found, mask, normals) < 0.5 * before
    assert found.misfit[1] < 0.5 * found.misfit[0]


def test_exposure_of_an_image_changes_its_light_alone() -> None:
    images, mask, normals, *_ = draw_images()
    gains = np.linspace(0.2, 3.0, len(images)).astype(np.float32)
    one, two = (
        refine_low_order(each, mask, disturb(normals, mask), config=EVERY)
        for each in (images, images * gains[:, None, None, None])
    )
    assert angle_degrees(one.normals[mask], two.normals[mask]).mean() < 0.5
    np.testing.assert_allclose(one.light * gains[:, None, None], two.light, atol=0.1)


def test_clipped_observations_are_ignored() -> None:
    images, mask, normals, *_ = draw_images()
    limit = float(np.quantile(images[:, mask], 0.9))
    clipped = np.minimum(images, limit)
    known = refine_low_order(clipped, mask, disturb(normals, mask), saturation=limit, config=EVERY)
    unknown = refine_low_order(clipped, mask, disturb(normals, mask), config=EVERY)
    assert measure(known, mask, normals) < measure(unknown, mask, normals)


def test_of_many_images_some_are_taken() -> None:
    images, mask, normals, *_ = draw_images(count=40)
    found = refine_low_order(images, mask, normals, config=EVERY)
    assert (found.light[:, 0] != 0).any(axis=1).sum() == low_order.MOST


def test_tiles_are_what_the_whole_is(monkeypatch: pytest.MonkeyPatch) -> None:
    images, mask, normals, *_ = draw_images()
    config = LowOrderConfig(coarse_pixels=SIDE**2 // 4, fine_iterations=5)
    whole = refine_low_order(images, mask, disturb(normals, mask), config=config)
    monkeypatch.setattr(low_order, "TILE_PIXELS", 1000)
    tiled = refine_low_order(images, mask, disturb(normals, mask), config=config)
    assert angle_degrees(whole.normals[mask], tiled.normals[mask]).mean() < 0.1


def test_pixels_that_are_expected_to_be_off_move_further() -> None:
    images, mask, normals, *_ = draw_images()
    start = disturb(normals, mask)
    sure, unsure = (
        refine_low_order(images, mask, start, np.full(mask.shape, degrees, np.float32), config=EVERY)
        for degrees in (3.0, 30.0)
    )
    moved = [angle_degrees(each.normals[mask], start[mask]).mean() for each in (sure, unsure)]
    assert moved[0] < moved[1]


def bowl(side: int = 57, edge: float = 60.0) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return heights in pixels, mask, normals and what each pixel sees of each harmonic, (P, 9), of a bowl in a plate.

    A ray that leaves a point p of the unit sphere meets it again at p - 2 (p . w) w, and gets out above the rim.
    """
    wide, rim = np.sin(np.radians(edge)), -np.cos(np.radians(edge))
    y, x = np.mgrid[1.4 * wide : -1.4 * wide : side * 1j, -1.4 * wide : 1.4 * wide : side * 1j]
    mask, hollow = np.ones((side, side), bool), (np.hypot(x, y) <= wide)[..., None]
    sunk = np.stack([x, y, -np.sqrt(np.maximum(1 - x**2 - y**2, 0))], axis=-1)
    normals = np.where(hollow, -sunk, [0.0, 0.0, 1.0]).astype(np.float32)
    ways, height = spiral(3000), np.where(hollow[..., 0], sunk[..., 2], rim)
    along = normals[mask] @ ways.T  # (P, D)
    free = np.where(hollow[mask], height[mask][:, None] + 2 * along * ways[:, 2] > rim, True)
    seen = (np.maximum(along, 0) * free) @ harmonics(ways) * (4 / len(ways))
    return height * (side - 1) / (2.8 * wide), mask, normals, seen


def test_what_a_bowl_hides_is_that_of_the_closed_form() -> None:
    heights, mask, normals, seen = bowl()
    unit_normals = torch.from_numpy(normals[mask])
    found = visible_harmonics(unit_normals, find_hidden(heights, mask, normals[mask], count=512)).numpy()
    plain = visible_harmonics(unit_normals, torch.zeros(len(unit_normals), 9, 3)).numpy()
    assert np.abs(found - seen).mean() < 0.25 * np.abs(plain - seen).mean()


def test_a_ball_hides_nothing() -> None:
    mask, normals = sphere()
    heights = normals[..., 2] * (SIDE - 1) / 2
    inner = normals[mask][:, 2] > 0.5
    for camera in (Camera(), Camera(20.0 * SIDE)):
        assert np.abs(find_hidden(heights, mask, normals[mask], camera).numpy()[inner]).max() < 0.05


def test_what_a_bowl_hides_explains_its_images() -> None:
    heights, mask, normals, seen = bowl()
    light = draw_light()
    images, white = paint(mask, seen, light), np.ones((*mask.shape, 3))
    hidden, off, unexplained = find_hidden(heights, mask, normals[mask]), [], []
    for each in (hidden, torch.zeros_like(hidden)):
        found = find_light(images, mask, normals, white, each)
        shown = visible_harmonics(torch.from_numpy(normals[mask]), each).numpy()
        unexplained.append(np.abs(paint(mask, shown, found) - images).mean())
        off.append(np.abs(found - light).mean())
    assert off[0] < 0.4 * off[1] and unexplained[0] < 0.4 * unexplained[1]


def test_a_white_bowl_is_not_dark_inside() -> None:
    _, mask, normals, seen = bowl()
    images = paint(mask, seen, draw_light())
    found = [refine_low_order(images, mask, normals, config=replace(EVERY, visibility=used)) for used in (True, False)]
    uneven = [float(each.albedo[mask].std()) for each in found]
    assert uneven[0] < 0.7 * uneven[1]
    assert measure(found[0], mask, normals) < min(1.5, measure(found[1], mask, normals))


def test_flat_things_are_doubted() -> None:
    images, mask, normals, *_ = draw_images()
    flat = np.zeros_like(normals)
    flat[..., 2] = 1.0
    assert "flat" in refine_low_order(images, mask, flat, config=LowOrderConfig(iterations=1)).doubt


def test_a_misfit_that_grows_is_doubted() -> None:
    normals = sphere()[1].reshape(-1, 3)
    assert not low_order.find_doubt(normals, (0.02, 0.01))
    assert "no better" in low_order.find_doubt(normals, (0.02, 0.021))
    assert "no better" in low_order.find_doubt(normals, (0.02, float("nan")))


def test_bad_input_is_refused_in_one_line() -> None:
    images, mask, normals, *_ = draw_images()
    broken, black, lost = normals.copy(), images.copy(), images.copy()
    broken[SIDE // 2, SIDE // 2] = np.nan
    black[2] = 0.0
    lost[1, SIDE // 2, SIDE // 2] = np.nan
    cases = [
        ("at least 4 images, got 3", images[:3], normals, None),
        ("do not fit", images, normals[1:], None),
        ("do not fit", images, normals, np.zeros((3, 3), np.float32)),
        ("NaN or infinity", images, broken, None),
        ("black in an image", black, normals, None),
        ("NaN or infinite", lost, normals, None),
    ]
    for text, some, start, expected in cases:
        with pytest.raises(InputError, match=text) as caught:
            refine_low_order(some, mask, start, expected)
        assert "\n" not in str(caught.value)
    for wrong in ({"near": -1.0}, {"iterations": 0}, {"fine_iterations": -1}):
        with pytest.raises(InputError):
            LowOrderConfig(**wrong)
