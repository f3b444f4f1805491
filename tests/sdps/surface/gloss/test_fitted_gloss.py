"""Materials of glTF found again: in lobes made of them, and in photographs that are refined."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from saved_results import sphere
from scipy.optimize import nnls
from sdps_scenes import hemisphere_lights, sphere_normals

from render.shared.errors import InputError
from sdps.core.first_normals import turn_to_sight
from sdps.core.geometry import ORTHOGRAPHIC, UNKNOWN, Camera, Capture, Rig, reach
from sdps.refinement.refine import RefineConfig, refine
from sdps.refinement.reflectance import LOBES, MODES, SHAPES
from sdps.surface.gloss.fitted_gloss import BRIGHTEST, Materials, Surface, fit_materials, match_photographs
from sdps.surface.gloss.metallic_roughness import (
    evaluate_highlight,
    measure_cosines,
    reflect_gltf,
    shade_gltf,
)
from sdps.surface.gloss.pixel_lights import PixelLights

QUICK = RefineConfig(coarse_pixels=400, iterations=250, bounces=0, fine_iterations=0)
NEAR = replace(QUICK, bounces=1, iterations_before=100)  # where the pixels lie is found after the first iterations


def lobed(roughness: float) -> tuple[np.ndarray, np.ndarray]:
    """Return amplitudes and sharpness (K,) of spherical Gaussians like the highlight of f0 = 1, seen from the front."""
    tilt = np.radians(50.0) * np.linspace(0.0, 1.0, 200) ** 2
    lights = np.stack([np.sin(tilt), np.zeros(200), np.cos(tilt)], axis=1)
    half = lights + np.array([0.0, 0.0, 1.0])
    half /= np.linalg.norm(half, axis=1, keepdims=True)
    front = np.array([0.0, 0.0, 1.0])
    wanted = evaluate_highlight(measure_cosines(np.broadcast_to(front, lights.shape), lights), roughness)
    sharpness = np.geomspace(3.0, 20000.0, 2 * LOBES)
    shapes = np.exp(-sharpness * (1.0 - half[:, 2:])) * 2.0 / (1.0 + lights[:, 2:])
    return nnls(shapes, wanted)[0], sharpness


def surface(albedo: np.ndarray, strength: np.ndarray, roughness: float) -> Surface:
    amplitudes, sharpness = lobed(roughness)
    return Surface(
        albedo, strength, np.zeros(SHAPES), np.zeros(MODES), amplitudes, sharpness, np.array([1.2, 1.0, 0.8])
    )


@pytest.mark.parametrize("roughness", [0.12, 0.2, 0.35, 0.5, 0.7])
def test_lobes_of_a_dielectric_give_its_roughness_and_base_colour(roughness: float) -> None:
    base = np.tile([0.6, 0.3, 0.1], (20, 1))
    found = fit_materials(surface(5.0 * 0.96 * base, np.full(20, 5.0 * 0.04), roughness))
    assert np.abs(found.roughness - roughness).max() < 0.04
    assert found.metallic.max() == 0.0
    assert found.base == pytest.approx(base, rel=0.3, abs=0.12)
    assert found.scale == pytest.approx(5.0, rel=0.35)


def test_lobes_without_a_body_are_metal_in_the_lamps_colour() -> None:
    found = fit_materials(surface(np.full((20, 3), 0.001), np.linspace(3.0, 6.0, 20), 0.4))
    assert found.metallic.min() == 1.0
    assert np.abs(found.roughness - 0.4).max() < 0.03
    assert found.base[-1] == pytest.approx(BRIGHTEST * np.array([1.0, 1.0 / 1.2, 0.8 / 1.2]), rel=0.05)
    assert found.base[0, 0] / found.base[-1, 0] == pytest.approx(0.5, rel=0.05)


def test_an_inlay_of_metal_in_plastic_is_told_from_it() -> None:
    albedo, strength = np.full((100, 3), 4.0 * 0.4), np.full(100, 4.0 * 0.04)
    albedo[:20], strength[:20] = 0.02, 4.0 * 0.6
    found = fit_materials(surface(albedo, strength, 0.4))
    assert (found.metallic == (np.arange(100) < 20)).all()
    assert found.base[:20, 0] == pytest.approx(0.6, rel=0.3)


def test_without_highlights_the_brightest_is_nearly_white_and_rough() -> None:
    found = fit_materials(surface(np.tile([[3.0, 2.0, 1.0]], (10, 1)), np.full(10, 1e-6), 0.4))
    assert found.base[0] == pytest.approx(BRIGHTEST * np.array([1.0, 2 / 3, 1 / 3]), rel=0.1)
    assert found.roughness.min() > 0.9
    assert found.metallic.max() == 0.0


def test_base_colour_follows_what_the_lights_of_the_photographs_show() -> None:
    """Of a dull metal whose colour is in its body too, lights far from the highlight show the body alone."""
    shining = surface(np.array([[0.6, 0.02, 0.02]]), np.array([4.0]), 0.4)._replace(gains=np.ones(3))
    found = Materials(np.zeros((1, 3)), np.ones(1), np.full(1, 0.4), 1.0)
    front, aside = np.array([[0.0, 0.0, 1.0]]), np.array([[0.9, 0.0, np.sqrt(0.19)], [-0.9, 0.0, np.sqrt(0.19)]])
    here = Capture.of(np.ones((1, 1), bool)), np.ones((1, 1), bool), np.zeros((1, 1))
    red, grey = (
        match_photographs(found, shining, front, PixelLights.of(*here, lights)).base[0] for lights in (aside, front)
    )
    assert red[0] > 1.6 * red[1]
    assert grey[0] < 1.2 * grey[1]


def test_a_surface_without_pixels_is_refused() -> None:
    with pytest.raises(InputError, match="no pixels"):
        fit_materials(surface(np.zeros((0, 3)), np.zeros(0), 0.4))


def test_energy_is_kept() -> None:
    """A white matt surface that faces its light is 1, a little less for what the highlight takes."""
    front = np.array([[0.0, 0.0, 1.0]])
    assert shade_gltf(front, front[0], np.ones((1, 3)), 0.0, 1.0)[0] == pytest.approx(0.96 + 0.04 / 4, abs=1e-6)
    mirror = reflect_gltf(measure_cosines(front, front), np.full((1, 3), 0.5), 1.0, 0.5)
    assert mirror[0] == pytest.approx(0.5 / (4 * 0.25**2), rel=1e-6)  # f0 / (4 alpha^2) at the peak


def refined(
    base: tuple[float, ...], metallic: float, roughness: float, *, distance: float = np.inf,
    camera: Camera = ORTHOGRAPHIC, config: RefineConfig = QUICK,
) -> Materials:  # fmt: skip
    """Return the materials of a ball that is photographed with them under 16 known lights, and refined.

    Args:
        base, metallic, roughness: Of it.
        distance: Of the lamps, in half image widths; the ball fills the picture.
        camera: What sees it.
        config: Of refinement.
    """
    if camera.is_perspective:
        normals, mask, heights = sphere(40, 19.0, camera)
    else:
        normals, mask = sphere_normals(40)
        heights = np.where(mask, np.ptp(np.nonzero(mask)[0]) / 2 * normals[..., 2], 0.0)
    heights -= heights[mask].mean()
    lights = hemisphere_lights(16, np.random.default_rng(0), 0.4)
    capture, nearness = Capture.of(mask, camera), np.full(len(lights), 1.0 / distance)
    towards, falloff = reach(capture.places(heights)[mask], lights, nearness)
    turns = turn_to_sight(torch.from_numpy(camera.sights(mask.shape)[mask])).numpy()
    turned = np.einsum("pij,pj->pi", turns, normals[mask])
    images = np.zeros((len(lights), *mask.shape, 3), np.float32)
    for number, image in enumerate(images):
        own = np.einsum("pij,pj->pi", turns, towards[:, number])
        reflected = reflect_gltf(measure_cosines(turned, own), np.array(base), metallic, roughness)
        image[mask] = reflected * (np.clip((turned * own).sum(-1), 0.0, None) * falloff[:, number])[:, None]
    gains = np.ones(len(lights), np.float32)
    rig = UNKNOWN if np.isinf(distance) and not camera.is_perspective else Rig(camera, nearness)
    start = normals.astype(np.float32)
    found = refine(images, mask, start, lights, gains, directions_given=True, config=config, stray=False, rig=rig)
    parts = found.body, found.modes, found.amplitudes, found.sharpness
    whole = Surface(found.albedo[mask], found.strength[mask], *parts, found.intensities.mean(axis=0))
    seen = PixelLights.of(capture, mask, heights, lights, nearness)
    return match_photographs(fit_materials(whole), whole, found.normals[mask], seen)


def test_photographs_of_plastic_give_its_roughness_and_base_colour() -> None:
    found = refined((0.6, 0.4, 0.2), 0.0, 0.4)
    assert np.median(found.roughness) == pytest.approx(0.4, abs=0.03)
    assert np.median(found.base, axis=0) == pytest.approx(np.array([0.6, 0.4, 0.2]), rel=0.3)
    assert found.metallic.max() == 0.0


def test_photographs_of_gold_give_metal_of_its_colour() -> None:
    found = refined((1.0, 0.77, 0.34), 1.0, 0.35)
    assert found.metallic.min() == 1.0
    assert np.median(found.roughness) == pytest.approx(0.35, abs=0.04)
    colour = np.median(found.base, axis=0)
    assert colour / colour[0] == pytest.approx(np.array([1.0, 0.77, 0.34]), rel=0.1)


@pytest.mark.parametrize("camera", [ORTHOGRAPHIC, Camera(100.0)])
@pytest.mark.parametrize("distance", [5.0, 2.5])
def test_near_lamps_do_not_change_what_plastic_is_of(distance: float, camera: Camera) -> None:
    found = refined((0.6, 0.4, 0.2), 0.0, 0.4, distance=distance, camera=camera, config=NEAR)
    assert np.median(found.roughness) == pytest.approx(0.4, abs=0.02)
    assert np.median(found.base, axis=0) == pytest.approx(np.array([0.6, 0.4, 0.2]), rel=0.12)


def test_near_lamps_paint_no_changes_of_brightness_on_metal() -> None:
    """Far lamps 0.19 of the mean; near ones 0.17, and 0.27 where they count as far."""
    found = refined((1.0, 0.77, 0.34), 1.0, 0.35, distance=2.5, config=NEAR)
    assert np.median(found.roughness) == pytest.approx(0.35, abs=0.02)
    assert (found.base.std(axis=0) / found.base.mean(axis=0)).max() < 0.22
