"""The many-light renderer against Mitsuba's `path` integrator, pixel by pixel and statistically.

Both render seeded scenes over shapes, materials and bounces with many independent seeds. A Welch t-test per pixel and
light, Sidak-corrected as in Mitsuba's own render tests (Subr and Arvo 2007), must not reject equal means at the 1 %
level over all scenes; with any one part of the light transport taken away it must.
"""

import logging
from dataclasses import dataclass, replace
from functools import cache, partial

import merl_support
import numpy as np
import pytest
import render_support as support
import textures_support
from scipy import stats
from scipy.spatial.transform import Rotation

from render import shapes
from render.backend.jit import dr, mi
from render.kernel import bounces, emitters, highlights, many_lights, reference, scene, shading, visibility
from render.materials import merl
from render.materials.kernels.packed import pack
from render.materials.kernels.textures import cover, gloss
from render.planning import light_sets
from render.records.manifest import View
from render.shared.seeds import generator

_log = logging.getLogger(__name__)

FAMILY_SIGNIFICANCE = 0.01
REPEATS = 24


@dataclass(frozen=True)
class Case:
    """One scene.

    Mirror-like materials need more samples before `path` meets their highlights, and shapes without flat spots: where a
    highlight falls on one, the values of `path` are so rarely drawn that no t-test holds (docs/studies/renderer.md).
    They also need all repeats of `path`; the others do with half of them.
    """

    shape: str
    material: str
    bounces: int
    size: int = 12
    spp: int = 144
    camera: float | None = None  # distance
    near: tuple[float, ...] = ()  # distances of the lights
    slow: bool = False

    @property
    def seed(self) -> int:
        return CASES.index(self)

    @property
    def repeats_of_path(self) -> int:
        return REPEATS if self.spp > 1000 else REPEATS // 2

    def __str__(self) -> str:
        words = f"{self.shape} {self.material} {self.bounces} bounces"
        return words + " near lights" * bool(self.near) + " perspective" * bool(self.camera)


NEAR = (2.2, 2.6, 3.4)
CASES = [
    Case("bowl", "lambertian:0.9", 2, spp=324),  # a density 10 % too high must show
    Case("bowl", "gold-metallic-paint", 2),
    Case("sculpture:5", "white-acrylic", 2),
    Case("sphere", "lambertian:0.8/0.3/0.1", 0),
    Case("sphere", "chrome", 0, 6, 2048),
    Case("bowl", "steel", 1, 8, 2048, slow=True),
    Case("blobby:8", "nickel", 2, 6, 1024),
    Case("bowl", "black-obsidian", 1, 8, 2048, slow=True),
    Case("bowl", "aluminium", 2, 8, 1024, slow=True),
    Case("bowl", "chrome", 1, 6, 2048),
    Case("blobby:4", "white-fabric", 3),
    Case("blobby:5", "blue-acrylic", 1),
    Case("sculpture:7", "specular-red-phenolic", 2),
    Case("sculpture:9", "pearl-paint", 3),
    Case("sculpture:11", "pink-felt", 1),
    Case("bunny", "alum-bronze", 1),
    Case("bunny", "delrin", 2),
    Case("bunny", "polyethylene", 0),
    Case("bowl", "stripes:3:lambertian:0.9+red-plastic", 2),
    Case("bowl", "patches:2:gold-paint+lambertian:0.7+black-fabric", 2),
    Case("blobby:6", "noise:5:chrome+white-fabric", 1, 6, 2048),
    Case("sculpture:4", "gradient:1:lambertian:0.9+specular-blue-phenolic", 3),
    Case("sculpture:6", "parts:0:yellow-paint+two-layer-silver", 2),
    Case("bowl", "merl:silver-metallic-paint", 2),
    Case("bowl", "lambertian:0.9", 2, near=NEAR),
    Case("bowl", "gold-metallic-paint", 2, camera=3.5),
    Case("bowl", "lambertian:0.9", 2, camera=3.0, near=NEAR),
    Case("sculpture:5", "patches:2:gold-paint+lambertian:0.7+black-fabric", 2, camera=2.5, near=NEAR),
    Case("sphere", "steel", 1, 6, 2048, camera=2.5, near=NEAR),
    Case("sphere", "chrome", 0, 8, 2048, camera=2.5, slow=True),
    Case("bowl", "chrome", 1, 8, 2048, near=NEAR, slow=True),
    Case("blobby:8", "nickel", 2, 8, 1024, camera=2.5, near=NEAR, slow=True),
    Case("bowl", "procedural:tiles:5", 2),
    Case("blobby:4", "procedural:weave:2", 1, spp=900),
    Case("sculpture:4", "procedural:noise:3", 2),
    Case("bowl", "procedural:print:4:gold-metallic-paint+lambertian:0.8", 2),
    Case("bowl", "maps:rough", 2),
    Case("composition:8", "parts:0:lambertian:0.9+gold-metallic-paint", 3),
    Case("composition:0", "parts:1:lambertian:0.9+white-acrylic", 2, near=NEAR),
]
load = cache(shapes.load)
ALSO_EQUAL = 6  # comparisons below that must not be told apart either
LEVEL = -np.expm1(np.log1p(-FAMILY_SIGNIFICANCE) / (len(CASES) + ALSO_EQUAL))
"""Sidak once more, over everything that must agree. What differs must lie far below, at 1e-4 or less."""


@pytest.fixture(scope="module")
def material(tmp_path_factory):
    """Return the function that names a case's material; MERL tables and folders of maps are written."""

    @cache
    def name(text: str) -> str:
        kind, _, source = text.partition(":")
        if kind == "maps":
            folder = tmp_path_factory.mktemp("maps")
            textures_support.write_maps(folder)
            return f"maps:0.8:{folder}"
        if kind != "merl":
            return text
        path = tmp_path_factory.mktemp("merl") / f"{source}.binary"
        merl.write(path, merl_support.values(source))
        return str(path)

    return name


def parts(case: Case) -> tuple:
    """Return mesh, pose and lights of a case."""
    rng = generator(7, "reference", case.seed)
    if case.shape == "bowl":
        rotation, mesh = Rotation.from_euler("yx", rng.uniform(-35, 35, 2), degrees=True), support.bowl()
    elif case.shape.startswith("composition"):  # from its open side and from above
        angles = [rng.uniform(-30, 30), rng.uniform(15, 50)]
        rotation, mesh = Rotation.from_euler("yx", angles, degrees=True), load(case.shape)
    else:
        rotation, mesh = Rotation.from_euler("yx", rng.uniform(-60, 60, 2), degrees=True), load(case.shape)
    scale = float(rng.uniform(0.9, 1.3))
    view = View(rotation=tuple(rotation.as_matrix().ravel()), scale=scale, camera_distance=case.camera)
    return mesh, view, light_sets.draw("near-uniform", 3, rng).astype(np.float32)


def ours(
    case: Case, name: str, change=None, index: int = 0, extra: tuple = (), scene_parts: tuple = (), **settings
) -> np.ndarray:
    """Return (REPEATS, L, H, W) mean radiance of the channels, one repeat per seed."""
    mesh, view, directions = scene_parts or parts(case)
    built, surfaces = scene.build(mesh), pack([name, *extra], mesh)
    if change:
        built, surfaces = change(built, surfaces)
    images = []
    for seed in range(REPEATS):
        options = {"size": case.size, "spp": case.spp, "bounces": case.bounces, "seed": seed, "only": [index]}
        options["distances"] = np.array(case.near) if case.near else None
        _, stacks = many_lights.render(built, view, surfaces, directions, **options | settings)
        images.append(next(stacks)[1].mean(-1))
    return np.stack(images)


@cache
def expected(case: Case, name: str) -> np.ndarray:
    """Render a case with `path`, `repeats_of_path` seeds for each light."""
    mesh, view, directions = parts(case)
    repeated = np.tile(directions, (case.repeats_of_path, 1))
    shape = None if case.shape == "bowl" else case.shape
    options = {"size": case.size, "spp": case.spp, "bounces": case.bounces, "seed": 1000, "shape": shape}
    options["distances"] = np.tile(case.near, case.repeats_of_path) if case.near else None
    stack = np.stack(list(reference.render_each_light(mesh, view, name, repeated, **options)))
    return stack.mean(-1).reshape(case.repeats_of_path, len(directions), *stack.shape[1:3])


def p_value(first: np.ndarray, second: np.ndarray) -> float:
    """Return the Sidak-corrected p-value of the least probable pixel, given equal means."""
    seen = (first.var(0) + second.var(0)) > 1e-14
    np.testing.assert_allclose(first.mean(0)[~seen], second.mean(0)[~seen], atol=1e-5)
    p = stats.ttest_ind(first[:, seen], second[:, seen], equal_var=False).pvalue
    worst = float(-np.expm1(p.size * np.log1p(-min(p.min(), 1 - 1e-12))))
    _log.info("p = %.2g over %d pixels and lights", worst, p.size)
    return worst


@pytest.mark.parametrize("case", [pytest.param(case, marks=[pytest.mark.slow] * case.slow) for case in CASES], ids=str)
def test_agrees_with_path(case, material):
    name = material(case.material)
    assert p_value(ours(case, name), expected(case, name)) > LEVEL


class Changed:
    """A family of materials with something wrong; everything else is passed on."""

    def __init__(self, inner) -> None:
        self.inner = inner

    def __len__(self) -> int:
        return len(self.inner)

    def __getattr__(self, name):
        return getattr(self.inner, name)


class NoCosine(Changed):
    """Without the cosine of the light."""

    def eval_at(self, index, at):
        return self.inner.eval_at(index, at) / dr.maximum(at.cos_o, 1e-3)


class WrongDensity(Changed):
    """Bounce directions weighted by a density 10 % too high."""

    def pdf(self, *arguments):
        return 1.1 * self.inner.pdf(*arguments)


class NoShadows(scene.Scene):
    """A scene in which no shadow ray meets anything."""

    def ray_test(self, *_):
        return mi.Bool(False)


def with_family(kind):
    def change(built, surfaces):
        surfaces.families = tuple(kind(family) for family in surfaces.families)
        return built, surfaces

    return change


def first_material_only(built, surfaces):
    surfaces._patterns = [None]
    return built, surfaces


MUTATIONS = {
    "direct light only": {"bounces": 0},
    "one bounce dropped": {"bounces": 1},
    "no shadows": {"change": lambda built, surfaces: (NoShadows(built.mesh), surfaces)},
    "no cosine": {"change": with_family(NoCosine)},
    "wrong density": {"change": with_family(WrongDensity)},
}


@pytest.mark.parametrize("mutation", MUTATIONS)
def test_notices_what_is_missing(mutation):
    case = CASES[0]
    assert p_value(ours(case, case.material, **MUTATIONS[mutation]), expected(case, case.material)) < 1e-4


class NoFalloff(emitters.NearLights):
    """Near lights whose irradiance is pi everywhere."""

    def reach(self, light, position):
        reach = super().reach(light, position)
        return lambda at: (reach(at)[0], mi.Float(1))


class FromTheCentre(emitters.NearLights):
    """Near lights seen everywhere in the direction that the object's centre sees them in."""

    def reach(self, light, position):
        reach, direction = super().reach(light, position), dr.gather(mi.Vector3f, mi.Vector3f(self.positions), light)
        return lambda at: (dr.normalize(direction), reach(at)[1])


class ShadowsFromTheCentre(emitters.NearLights):
    """Near lights that cast the shadows of distant ones."""

    def shadow_ray(self, start, number):
        return super().shadow_ray(start, number)[0], start.spawn_ray(
            dr.normalize(dr.gather(mi.Vector3f, mi.Vector3f(self.positions), number))
        )


NEAR_CASE = CASES[26]
NEAR_MUTATIONS = {
    "direct light only": {"bounces": 0},
    "no cosine": {"change": with_family(NoCosine)},
    "distant lights": {"distances": None},
    "no falloff": {"lights": NoFalloff},
    "directions of the centre": {"lights": FromTheCentre},
    "shadows of distant lights": {"lights": ShadowsFromTheCentre},
    "orthographic rays": {"camera": None},
}


@pytest.mark.parametrize("mutation", NEAR_MUTATIONS)
def test_notices_what_is_wrong_with_near_lights_and_perspective(mutation, monkeypatch):
    case, wrong = NEAR_CASE, dict(NEAR_MUTATIONS[mutation])
    if kind := wrong.pop("lights", None):
        monkeypatch.setattr(emitters, "NearLights", kind)
    mesh, view, directions = parts(case)
    seen = replace(view, camera_distance=wrong.pop("camera", view.camera_distance))
    assert p_value(ours(case, case.material, scene_parts=(mesh, seen, directions), **wrong),
                   expected(case, case.material)) < 1e-4  # fmt: skip


def test_an_unchanged_family_passes_without_the_fast_path():
    """The general kernel, which tables and bounces take, gives what the one for fitted materials gives."""
    case = CASES[1]
    assert p_value(ours(case, case.material, change=with_family(Changed)), expected(case, case.material)) > LEVEL


@pytest.mark.parametrize("case", [CASES[4], CASES[28]], ids=str)
def test_notices_highlights_counted_twice(case, monkeypatch):
    monkeypatch.setattr(highlights, "partition", lambda spread, s, size, spp: dr.full(mi.Float, 0.6, 1))
    assert p_value(ours(case, case.material), expected(case, case.material)) < 1e-4


def test_notices_a_missing_pattern():
    case = CASES[18]
    assert p_value(ours(case, case.material, change=first_material_only), expected(case, case.material)) < 1e-4


TEXTURED, MAPS = (next(case for case in CASES if case.material.startswith(kind)) for kind in ("procedural", "maps"))


@pytest.mark.parametrize("case", [TEXTURED, MAPS], ids=["procedural", "maps"])
def test_notices_a_missing_relief(case, material, monkeypatch):
    name = material(case.material)
    truth = expected(case, name)
    monkeypatch.setattr(cover, "turn", lambda normal, slope, wi: normal)
    assert p_value(ours(case, name), truth) < 1e-4


def test_notices_light_on_a_relief_whose_surface_faces_away(monkeypatch):
    case = next(case for case in CASES if case.material == "procedural:weave:2")
    monkeypatch.setattr(shading, "_carrier_faces", lambda *_: mi.Bool(True))
    assert p_value(ours(case, case.material), expected(case, case.material)) < 1e-4


@pytest.mark.parametrize("part", ["roughness", "metallic", "base"])
def test_notices_a_missing_map(part, material, monkeypatch):
    name = material(MAPS.material)
    truth, prepare = expected(MAPS, name), gloss.Gloss.prepare
    constant = {"roughness": 0.5, "metallic": 0.5, "base": mi.Color3f(0.4)}[part]
    monkeypatch.setattr(
        gloss.Gloss,
        "prepare",
        lambda look, cosine: prepare(look._replace(**{part: constant + look.metallic * 0}), cosine),
    )
    assert p_value(ours(MAPS, name), truth) < 1e-4


COMPOSED = next(case for case in CASES if case.shape.startswith("composition"))


def without_weight(reach, throughput, sample, seed, *, real):
    """Russian roulette whose survivors carry what they did."""
    return real(reach, throughput, sample, seed)[0], throughput


def shuffled(positions, facets):
    """Groups of vertices that have nothing in common."""
    start = np.arange(0, positions.shape[1], 50)
    order = np.random.default_rng(0).permutation(positions.shape[1]).astype(np.uint32)
    return order, (start, np.diff(start, append=len(order)))


@pytest.mark.parametrize(
    "mutation",
    [
        "an object moved",
        "materials exchanged",
        "two bounces dropped",
        "paths end unweighted",
        "strangers share shadows",
    ],
)
def test_notices_what_is_wrong_with_a_composition(mutation, monkeypatch):
    mesh, view, directions = parts(COMPOSED)
    settings = {"bounces": 1} if mutation == "two bounces dropped" else {}
    assert mesh.objects is not None
    if mutation == "an object moved":
        moved = np.zeros_like(mesh.vertices)
        moved[np.unique(mesh.faces[mesh.objects == 1])] = (0.04, 0, 0)
        mesh = replace(mesh, vertices=mesh.vertices + moved)
    name = COMPOSED.material
    if mutation == "materials exchanged":
        first, second = name.removeprefix("parts:0:").split("+")
        name = f"parts:0:{second}+{first}"
    if mutation == "paths end unweighted":
        monkeypatch.setattr(bounces, "_FULL", 0.5)  # or few would end: nine tenths of the light go on here
        unweighted = partial(without_weight, real=bounces.roulette)
        weighted = ours(COMPOSED, name, scene_parts=(mesh, view, directions))
        assert p_value(weighted, expected(COMPOSED, COMPOSED.material)) > LEVEL
        monkeypatch.setattr(bounces, "roulette", unweighted)
    if mutation == "strangers share shadows":
        monkeypatch.setattr(visibility, "cells", shuffled)
        monkeypatch.setattr(visibility, "_LEAST_PROBES", 1)
    changed = ours(COMPOSED, name, scene_parts=(mesh, view, directions), **settings)
    assert p_value(changed, expected(COMPOSED, COMPOSED.material)) < 1e-4


def test_surfaces_with_relief_share_rays_with_others():
    """Frames of their own change no expectation: a textured surface beside a plain one and another textured one."""
    case = TEXTURED
    others = ("gold-metallic-paint", "procedural:wood:1", "lambertian:0.9")
    assert p_value(ours(case, case.material, extra=others), expected(case, case.material)) > LEVEL
    plain = ours(CASES[0], "lambertian:0.9", extra=("procedural:wood:1", "gold-metallic-paint"))
    assert p_value(plain, expected(CASES[0], "lambertian:0.9")) > LEVEL


@pytest.mark.parametrize("index", [0, 1])
def test_sharing_rays_does_not_change_the_expectation(index):
    """Two materials on one view: each has the image it has alone, though bounces are drawn from both."""
    case, name = CASES[0], ("lambertian:0.9", "gold-metallic-paint")[index]
    both = ours(case, "lambertian:0.9", index=index, extra=("gold-metallic-paint",))
    assert p_value(both, expected(case, name)) > LEVEL
