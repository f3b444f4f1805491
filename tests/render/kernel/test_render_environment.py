"""Mixed light against a direct render with Mitsuba's `path` under that light.

Under the stage's own lights all at once, both must have equal means: a Welch t-test per pixel. Under an environment map
the two differ by the stage's cells as well, a few per cent; a mirrored map, or weights that leave the solid angle out,
differ by far more.
"""

import logging
from functools import cache

import numpy as np
import pytest
import render_support as support
from scipy import stats
from scipy.spatial.transform import Rotation

from render.backend.jit import mi
from render.kernel import many_lights, reference, scene
from render.materials.kernels import surface_bsdf
from render.materials.kernels.packed import pack
from render.planning import light_sets
from render.records.manifest import View
from render.shared.imaging import environments
from render.shared.imaging.mixing import LightMix, LightStage, mix
from render.shared.seeds import generator

_log = logging.getLogger(__name__)

SIZE, SPP, BOUNCES, REPEATS = 12, 64, 2, 16
VIEW = View(rotation=tuple(Rotation.from_euler("yx", [25, -20], degrees=True).as_matrix().ravel()), scale=1.1)
MATERIALS = ("lambertian:0.9", "gold-metallic-paint")
LIGHTS = light_sets.load("stage:256").astype(np.float32)


@cache
def stage_images(material: str, seed: int) -> np.ndarray:  # (L, P, 3)
    surfaces = pack([material], support.bowl())
    _, stacks = many_lights.render(
        scene.build(support.bowl()), VIEW, surfaces, LIGHTS, size=SIZE, spp=SPP, bounces=BOUNCES, seed=seed
    )
    return next(stacks)[1].reshape(len(LIGHTS), -1, 3)


def rendered(material: str, emitters: dict, spp: int, seed: int) -> np.ndarray:  # (P, 3)
    """Render the bowl with `path` under emitters instead of the one light."""
    surface_bsdf.register()
    described = reference.scene_dict(support.bowl(), VIEW, material, SIZE, spp, BOUNCES)
    described.pop("light")
    return np.array(mi.render(mi.load_dict(described | emitters), seed=seed)).reshape(-1, 3)


def envmap(radiance: np.ndarray) -> dict:
    """Return the upper hemisphere of a map as Mitsuba's emitter, in the frame of the pages."""
    above = radiance * (environments.directions(len(radiance))[..., 2:] > 0)
    return {"light": {"type": "envmap", "bitmap": mi.Bitmap(above.astype(np.float32)), "scale": 1.0}}


def p_value(first: np.ndarray, second: np.ndarray) -> float:
    """Return the Sidak-corrected p-value of the least probable pixel (R, P), given equal means."""
    seen = (first.var(0) + second.var(0)) > 1e-14
    np.testing.assert_allclose(first.mean(0)[~seen], second.mean(0)[~seen], atol=1e-5)
    p = stats.ttest_ind(first[:, seen], second[:, seen], equal_var=False).pvalue
    return float(-np.expm1(p.size * np.log1p(-min(p.min(), 1 - 1e-12))))


@cache
def all_at_once(material: str, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the weights of a drawn mixture (L, 3), and REPEATS renders (R, P) under all its lights at once."""
    weights = LightMix(environments=("studio", "room")).draw(LightStage(LIGHTS, "bowl"), 1, generator(seed, "mix"))[0][
        0
    ]
    lit = np.flatnonzero(weights.any(1))
    emitters = {
        f"light{number}": {
            "type": "directional", "direction": (-LIGHTS[number]).tolist(),
            "irradiance": {"type": "rgb", "value": (np.pi * weights[number]).tolist()},
        }
        for number in lit
    }  # fmt: skip
    return weights, np.stack([rendered(material, emitters, 1024, 900 + k).mean(-1) for k in range(REPEATS)])


def mixed(material: str, weights: np.ndarray) -> np.ndarray:  # (R, P)
    return np.stack([mix(stage_images(material, seed), weights[None])[0].mean(-1) for seed in range(REPEATS)])


@pytest.mark.slow
@pytest.mark.parametrize("material", MATERIALS)
def test_mixed_images_equal_a_render_under_the_same_lights_at_once(material):
    weights, expected = all_at_once(material, 3)
    assert p_value(mixed(material, weights), expected) > 0.005


@pytest.mark.slow
@pytest.mark.parametrize("mutation", ["mirrored", "one light left out", "a fifth too bright"])
def test_the_comparison_under_lights_notices(mutation):
    weights, expected = all_at_once(MATERIALS[0], 3)
    if mutation == "mirrored":
        nearest = (LIGHTS @ (LIGHTS * [-1, 1, 1]).T).argmax(1)
        wrong = np.zeros_like(weights)
        np.add.at(wrong, nearest, weights)
    elif mutation == "one light left out":
        wrong = weights.copy()
        wrong[weights.mean(1).argmax()] = 0
    else:
        wrong = 1.2 * weights
    assert p_value(mixed(MATERIALS[0], wrong), expected) < 1e-4


def _difference(found: np.ndarray, expected: np.ndarray) -> float:
    """Return the mean absolute difference over the mean."""
    return float(np.abs(found - expected).mean() / expected.mean())


@pytest.mark.parametrize(
    ("name", "most"), [("gradient:2", 0.04), ("constant", 0.04), ("studio:1", 0.08), ("room:3", 0.08)]
)
def test_mixed_images_equal_a_render_under_the_map(name, most):
    """To the few per cent by which light from 256 places differs from light from everywhere; small ones more."""
    radiance = environments.load(name)
    expected = rendered(MATERIALS[0], envmap(radiance), 2048, 5)
    found = mix(stage_images(MATERIALS[0], 0), LightStage(LIGHTS, "bowl").under(radiance)[None])[0]
    difference = _difference(found, expected)
    _log.info("%s: mean difference %.3f, of the mean %.4f", name, difference, found.mean() / expected.mean() - 1)
    assert difference < most


@pytest.mark.parametrize(
    ("name", "mutation", "least"),
    [("gradient:2", "mirrored", 0.08), ("gradient:2", "upside down", 0.08),
     ("gradient:2", "no solid angles", 0.06), ("constant", "no solid angles", 0.06)],
)  # fmt: skip
def test_the_comparison_under_maps_notices(name, mutation, least):
    radiance, stage = environments.load(name), LightStage(LIGHTS, "bowl")
    if mutation == "no solid angles":
        vectors = environments.directions(64)
        above, flat = (
            vectors[..., 2] > 1e-9,
            environments.solid_angles(64).mean(),
        )  # every pixel as large as every other
        owner, power = stage.nearest(vectors[above]), radiance[above] * flat / np.pi
        wrong = np.stack([np.bincount(owner, power[:, k], len(LIGHTS)) for k in range(3)], axis=1)
    else:
        wrong = stage.under(radiance[:, ::-1] if mutation == "mirrored" else radiance[::-1])
    expected = rendered(MATERIALS[0], envmap(radiance), 2048, 5)
    assert _difference(mix(stage_images(MATERIALS[0], 0), wrong[None])[0], expected) > least
