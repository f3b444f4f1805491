"""The many-light renderer against Mitsuba's `path` integrator, pixel by pixel and statistically.

Both render scenes full of interreflections with many independent seeds. A Welch t-test per pixel and light,
Sidak-corrected as in Mitsuba's own render tests (Subr and Arvo 2007), must not reject equal means at the 1 % level;
with any one part of the light transport taken away it must.
"""

import logging

import drjit as dr
import numpy as np
import pytest
import render_support as support
from scipy import stats

from render import many_lights, reference, scene, shapes
from render.manifest import View
from render.materials import library
from render.materials.bsdf import PackedMaterials

_log = logging.getLogger(__name__)

SIGNIFICANCE = 0.01
REPEATS = 24
LIGHTS = support.unit([0.2, 0.1, 1], [1.2, 0.3, 0.5], [-0.4, -1.5, 0.8])
SETTINGS = {"size": 12, "spp": 144}
VIEW = View(rotation=(0.8, 0, 0.6, 0, 1, 0, -0.6, 0, 0.8), scale=0.95)
SCENES = {
    "bright bowl": (support.bowl(), "lambertian:0.9"),
    "metallic bowl": (support.bowl(), "gold-metallic-paint"),
    "plastic sculpture": (shapes.load("sculpture:5"), "white-acrylic"),
}


class NoShadows:
    """A scene in which no shadow ray meets anything."""

    def __init__(self, built) -> None:
        self.ray_intersect = built.ray_intersect

    def ray_test(self, *_):
        return many_lights.mi.Bool(False)


class NoCosine(PackedMaterials):
    """Materials evaluated without the cosine of the light."""

    def eval(self, index, wi, wo, active=True):
        return super().eval(index, wi, wo, active) / dr.maximum(wo.z, 1e-3)


class WrongDensity(PackedMaterials):
    """Materials whose bounce directions are weighted by a density 10 % too high."""

    def pdf(self, index, wi, wo, active=True):
        return 1.1 * super().pdf(index, wi, wo, active)


def ours(mesh, materials, bounces=2, proxy=None, index=0) -> np.ndarray:
    """Return (REPEATS, L, H, W) mean radiance of the channels, one repeat per seed."""
    built = scene.build(mesh)
    traced = proxy(built) if proxy else built
    images = []
    for seed in range(REPEATS):
        _, stacks = many_lights.render(
            traced, VIEW, materials, LIGHTS, bounces=bounces, seed=seed, only=[index], **SETTINGS
        )
        images.append(next(stacks)[1].mean(-1))
    return np.stack(images)


@pytest.fixture(scope="module")
def expected() -> dict[str, np.ndarray]:
    """Render every scene with `path`, REPEATS seeds for each light."""
    found = {}
    for name, (mesh, material) in SCENES.items():
        repeated = np.tile(LIGHTS, (REPEATS, 1))
        stack = np.stack(
            list(reference.render_each_light(mesh, VIEW, material, repeated, bounces=2, seed=1000, **SETTINGS))
        )
        found[name] = stack.mean(-1).reshape(REPEATS, len(LIGHTS), *stack.shape[1:3])
    return found


def p_value(first: np.ndarray, second: np.ndarray) -> float:
    """Return the Sidak-corrected p-value of the least probable pixel, given equal means."""
    seen = (first.var(0) + second.var(0)) > 1e-14
    np.testing.assert_allclose(first.mean(0)[~seen], second.mean(0)[~seen], atol=1e-5)
    p = stats.ttest_ind(first[:, seen], second[:, seen], equal_var=False).pvalue
    worst = float(-np.expm1(p.size * np.log1p(-min(p.min(), 1 - 1e-12))))
    _log.info("p = %.2g over %d pixels and lights", worst, p.size)
    return worst


@pytest.mark.parametrize("name", SCENES)
def test_agrees_with_path(expected, name):
    mesh, material = SCENES[name]
    assert p_value(ours(mesh, support.packed(material)), expected[name]) > SIGNIFICANCE


MUTATIONS = {
    "direct light only": {"bounces": 0},
    "one bounce dropped": {"bounces": 1},
    "no shadows": {"proxy": NoShadows},
    "no cosine": {"kind": NoCosine},
    "wrong density": {"kind": WrongDensity},
}


@pytest.mark.parametrize("mutation", MUTATIONS)
def test_notices_what_is_missing(expected, mutation):
    mesh, material = SCENES["bright bowl"]
    changes = dict(MUTATIONS[mutation])
    kind = changes.pop("kind", PackedMaterials)
    assert p_value(ours(mesh, kind([library.load(material)]), **changes), expected["bright bowl"]) < 1e-4


@pytest.mark.parametrize("index", [0, 1])
def test_sharing_rays_does_not_change_the_expectation(expected, index):
    """Two materials on one view: each has the image it has alone, though bounces are drawn from both."""
    name = ("bright bowl", "metallic bowl")[index]
    materials = support.packed("lambertian:0.9", "gold-metallic-paint")
    assert p_value(ours(support.bowl(), materials, index=index), expected[name]) > SIGNIFICANCE
