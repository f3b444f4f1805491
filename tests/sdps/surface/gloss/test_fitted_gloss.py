"""Materials of glTF found again: in lobes made of them, and in photographs that are refined."""

import numpy as np
import pytest
from scipy.optimize import nnls
from sdps_scenes import hemisphere_lights, sphere_normals

from render.shared.errors import InputError
from sdps.refinement.refine import RefineConfig, refine
from sdps.refinement.reflectance import LOBES, MODES, SHAPES
from sdps.surface.gloss.fitted_gloss import BRIGHTEST, Materials, Surface, fit_materials, match_photographs
from sdps.surface.gloss.metallic_roughness import (
    evaluate_highlight,
    measure_cosines,
    reflect_gltf,
    shade_gltf,
)

QUICK = RefineConfig(coarse_pixels=400, iterations=250, bounces=0, fine_iterations=0)


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
    red, grey = (match_photographs(found, shining, front, lights).base[0] for lights in (aside, front))
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


def refined(base: tuple[float, ...], metallic: float, roughness: float) -> Materials:
    """Return the materials of a ball that is photographed with them under 16 known lights, and refined."""
    normals, mask = sphere_normals(40)
    lights = hemisphere_lights(16, np.random.default_rng(0), 0.4)
    images = np.stack([shade_gltf(normals, light, np.array(base), metallic, roughness) for light in lights])
    images = (images * mask[..., None]).astype(np.float32)
    gains = np.ones(len(lights), np.float32)
    found = refine(images, mask, normals, lights, gains, directions_given=True, config=QUICK, stray=False)
    parts = found.body, found.modes, found.amplitudes, found.sharpness
    return fit_materials(Surface(found.albedo[mask], found.strength[mask], *parts, found.intensities.mean(axis=0)))


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
