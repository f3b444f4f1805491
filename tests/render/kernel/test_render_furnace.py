"""White furnaces: energy is neither lost nor made, in sampled directions, in direct light and between surfaces."""

import numpy as np
import pytest
import render_support as support

from render import shapes
from render.backend.jit import dr, mi
from render.materials import library, model
from render.records.manifest import View

MATERIALS = (
    "chrome", "steel", "nickel", "gold-metallic-paint", "white-acrylic", "white-fabric", "pink-felt", "pearl-paint",
    "specular-red-phenolic", "black-obsidian", "lambertian:1",
)  # fmt: skip
ALBEDO = 0.9
ANGLE = 75.0  # of the cap
SELF = (1 - np.cos(np.radians(ANGLE))) / 2  # form factor of the cap to itself: its share of the whole sphere


def sampled_albedo(names: tuple, cosine: float, count: int) -> list[tuple]:
    """Return per surface the mean (3,) of f cos / density over drawn directions, and its standard error."""
    surfaces = support.packed(*names)
    rng = mi.PCG32(size=count)
    chosen, lobe, u, v = (rng.next_float32() for _ in range(4))
    wi = mi.Vector3f(float(np.sqrt(1 - cosine**2)), 0, cosine) + dr.zeros(mi.Vector3f, count)
    dr.eval(chosen, lobe, u, v, wi)
    wo, density = surfaces.sample((None,) * len(surfaces), wi, chosen, lobe, mi.Point2f(u, v))
    found = []
    for number in range(len(surfaces)):
        weight = np.array(dr.select(density > 0, surfaces.eval(number, wi, wo, None) / density, 0), np.float64).T
        found.append((weight.mean(0), weight.std(0) / np.sqrt(count)))
    return found


@pytest.mark.parametrize("cosine", [0.95, 0.4])
@pytest.mark.parametrize("name", MATERIALS)
def test_sampled_weights_have_the_mean_of_the_albedo(name, cosine):
    expected = model.directional_albedo(library.load(name), np.array([cosine]), points=9)[0]
    ((mean, error),) = sampled_albedo((name,), cosine, 1 << 18)
    assert expected.max() <= 1.0001
    assert (np.abs(mean - expected) < 4.5 * error + 2e-3 * expected).all()
    assert (mean <= 1 + 4.5 * error + 1e-4).all()
    assert (error < 0.005 * expected.max()).all()  # importance sampling: no material needs more


def test_each_surface_of_a_mixture_has_the_albedo_it_has_alone():
    expected = [model.directional_albedo(library.load(name), np.array([0.7]), points=9)[0] for name in MATERIALS]
    for (mean, error), albedo in zip(sampled_albedo(MATERIALS, 0.7, 1 << 20), expected, strict=True):
        assert (np.abs(mean - albedo) < 4.5 * error + 2e-3 * albedo).all()


def under_uniform_light(mesh, name: str, lights: np.ndarray, solid_angle: float, **settings) -> tuple:
    """Return ground truth and radiance (H, W, 3) under radiance 1 from all `lights`, which share a solid angle."""
    truth, images = support.render(mesh, name, lights=lights, **settings)
    return truth, images[0].astype(np.float64).sum(0) * solid_angle / len(lights) / np.pi


@pytest.mark.parametrize("bounces", [0, 2])
def test_a_white_sphere_vanishes_in_a_white_room(bounces):
    truth, image = under_uniform_light(
        shapes.load("sphere"), "lambertian:1", support.spread(1024), 4 * np.pi, size=24, spp=16, bounces=bounces
    )
    inside = truth.coverage == 1
    assert np.abs(image[inside] - 1).max() < 0.01
    np.testing.assert_allclose(image[inside].mean(), 1, atol=1e-3)
    np.testing.assert_allclose(image[..., 1], truth.coverage, atol=0.01)  # at the silhouette, too


@pytest.mark.parametrize("name", ["pink-felt", "white-acrylic", "chrome"])
def test_a_sphere_in_a_white_room_shows_the_albedo(name):
    """Mirror-like metals would need a light for each pixel; their mean over the picture does not."""
    truth, image = under_uniform_light(shapes.load("sphere"), name, support.spread(1024), 4 * np.pi, size=24, spp=64)
    inside = truth.normals[..., 2] > 0.35
    cosines = np.linspace(0.3, 1, 15)
    albedo = model.directional_albedo(library.load(name), cosines)
    expected = np.stack([np.interp(truth.normals[..., 2], cosines, column) for column in albedo.T], axis=-1)
    np.testing.assert_allclose(image[inside].mean(0), expected[inside].mean(0), rtol=0.01)
    if name == "pink-felt":
        np.testing.assert_allclose(image[inside], expected[inside], rtol=0.03)


def inside_cap(size: int, scale: float) -> tuple[np.ndarray, np.ndarray]:
    """Return normals (H, W, 3) of the cap at pixel centres, and the pixels that lie well inside it."""
    axis = ((np.arange(size) + 0.5) / size * 2 - 1) / scale
    x, y = np.meshgrid(axis, -axis)
    square = x**2 + y**2
    normals = np.stack([-x, -y, np.sqrt(np.maximum(1 - square, 0))], axis=-1)
    return normals, square < (0.95 * np.sin(np.radians(ANGLE))) ** 2


@pytest.mark.parametrize("bounces", [0, 1, 2, 4])
def test_interreflections_in_a_spherical_cap_are_a_geometric_series(bounces):
    """Light of irradiance pi through the opening leaves the mean radiance rho cos (1 + cos a) / 2 on the cap, and each
    bounce spreads rho F of it evenly, with F the cap's form factor to itself."""
    lights = support.unit([0, 0, 1], [1, 0, 0.6], [-1, 1, 0.6])
    truth, images = support.render(
        support.cap(ANGLE), f"lambertian:{ALBEDO}", lights=lights, view=View(scale=1.0), size=24, spp=1024,
        bounces=bounces,
    )  # fmt: skip
    first = ALBEDO * lights[:, 2] * (1 + np.cos(np.radians(ANGLE))) / 2
    indirect = first * sum((ALBEDO * SELF) ** k for k in range(1, bounces + 1))
    normals, inside = inside_cap(24, 1.0)
    direct = ALBEDO * np.maximum(np.einsum("hwc,lc->lhw", normals, lights), 0)
    image = images[0][..., 1]
    np.testing.assert_allclose(image[0][inside], (direct[0] + indirect[0])[inside], atol=0.03)
    np.testing.assert_allclose(image[0][inside].mean(), (direct[0] + indirect[0])[inside].mean(), rtol=0.003)
    for number in (1, 2):
        # The opening's edge, a circle of radius sin a at height -cos a, shadows what lies beyond it towards the light.
        place = -normals
        reach = (-np.cos(np.radians(ANGLE)) - place[..., 2]) / lights[number, 2]
        entry = place[..., :2] + reach[..., None] * lights[number, :2]
        beyond = np.linalg.norm(entry, axis=-1) - np.sin(np.radians(ANGLE))
        shadowed, lit = inside & (beyond > 0.1), inside & (beyond < -0.1)
        assert shadowed.sum() > 20 and lit.sum() > 50
        np.testing.assert_allclose(image[number][shadowed].mean(), indirect[number], rtol=0.01, atol=1e-3)
        expected = (direct[number] + indirect[number])[lit]
        np.testing.assert_allclose(image[number][lit].mean(), expected.mean(), rtol=0.005)
    assert truth.mask[inside].all()


def test_a_white_cavity_vanishes_as_bounces_are_added():
    """Under radiance 1 from the whole opening, b bounces show 1 - F^(b + 1) everywhere in a white cap."""
    _, inside = inside_cap(16, 1.0)
    for bounces, tolerance in ((0, 0.02), (1, 0.08), (4, 0.2)):  # of a pixel, for its noise
        _, image = under_uniform_light(
            support.cap(ANGLE), "lambertian:1", support.spread(512, 0.0), 2 * np.pi, size=16, spp=64, bounces=bounces,
            view=View(scale=1.0),
        )  # fmt: skip
        expected = 1 - SELF ** (bounces + 1)
        assert np.abs(image[inside] - expected).max() < tolerance
        np.testing.assert_allclose(image[inside].mean(), expected, rtol=0.008)
