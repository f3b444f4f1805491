"""Surfaces packed for the kernels: families, evaluation, mixtures of patterns, and which are glossy."""

import merl_support
import numpy as np
import pytest
import render_support as support

from render import shapes
from render.backend.jit import dr, mi
from render.materials import merl
from render.materials.kernels import surface_bsdf
from render.materials.kernels.bsdf import PackedMaterials
from render.materials.kernels.merl_bsdf import PackedMerl
from render.materials.kernels.packed import Part, pack
from render.shared.errors import InputError

COUNT = 4000


@pytest.fixture(scope="module")
def table(tmp_path_factory) -> str:
    path = tmp_path_factory.mktemp("merl") / "glossy.binary"
    merl.write(path, merl_support.values("glossy"))
    return str(path)


def vector(array: np.ndarray) -> "mi.Vector3f":
    return mi.Vector3f(np.ascontiguousarray(array.T, np.float32))


@pytest.fixture(scope="module")
def directions() -> tuple:
    return vector(merl_support.hemisphere(COUNT, 1)), vector(merl_support.hemisphere(COUNT, 2))


@pytest.fixture(scope="module")
def points() -> tuple:
    """Return points of the unit sphere and triangle numbers."""
    z = np.linspace(-1, 1, COUNT)
    phi = np.arange(COUNT) * 2.4
    place = np.stack([np.sqrt(1 - z**2) * np.cos(phi), np.sqrt(1 - z**2) * np.sin(phi), z], 1)
    return mi.Point3f(vector(place)), dr.arange(mi.UInt32, COUNT)


def test_each_material_is_packed_once_in_the_family_of_its_kind(table):
    names = ["chrome", table, "stripes:0:pink-felt+chrome", f"patches:1:{table}+lambertian:0.5+chrome"]
    surfaces = pack(names)
    assert surfaces.names == tuple(names) and len(surfaces) == 4
    fitted, tables = surfaces.families
    assert isinstance(fitted, PackedMaterials) and isinstance(tables, PackedMerl)
    assert fitted.names == ("chrome", "pink-felt", "lambertian:0.5") and len(tables) == 1
    assert surfaces.parts == (
        (Part(0, 0),), (Part(1, 0),), (Part(0, 1), Part(0, 0)), (Part(1, 0), Part(0, 2), Part(0, 0)),
    )  # fmt: skip


def test_surfaces_with_a_mirror_like_material_are_glossy():
    names = ("chrome", "pink-felt", "stripes:0:pink-felt+chrome", "stripes:0:pink-felt+lambertian:0.5", "lambertian:1")
    assert pack(names).glossy == (True, False, True, False, False)


def test_values_are_the_sum_of_the_components(table, directions, points):
    surfaces = pack([f"noise:2:chrome+{table}+pink-felt", "blue-acrylic"])
    weights = surfaces.weights(*points)
    assert weights[1] is None and len(weights[0]) == 3
    chrome, glossy, felt, blue = (pack([name]).eval(0, *directions, None) for name in
                                  ("chrome", table, "pink-felt", "blue-acrylic"))  # fmt: skip
    first, second, third = weights[0]
    expected = np.array(first * chrome + second * glossy + third * felt)
    np.testing.assert_allclose(np.array(surfaces.eval(0, *directions, weights[0])), expected, rtol=1e-4, atol=1e-7)
    np.testing.assert_allclose(np.array(surfaces.eval(1, *directions, None)), np.array(blue), rtol=1e-5)
    half = np.array(surfaces.eval(0, *directions, weights[0], dr.arange(mi.UInt32, COUNT) < COUNT // 2))
    assert half[:, : COUNT // 2].any() and not half[:, COUNT // 2 :].any()


@pytest.mark.parametrize(
    "names",
    [("chrome",), ("lambertian:1", "chrome", "pink-felt"), ("gradient:0:chrome+pink-felt",),
     ("patches:3:chrome+table+lambertian:1", "table", "noise:4:gold-metallic-paint+pink-felt")],
)  # fmt: skip
def test_directions_are_drawn_with_the_density_they_come_with(names, table):
    """At one point: the density is that of the lobes in equal shares by surface, and integrates what it draws."""
    surfaces, count = pack([name.replace("table", table) for name in names]), 1 << 18
    at = mi.Point3f(0.3, -0.2, 0.9) + dr.zeros(mi.Point3f, count)
    weights = surfaces.weights(at, dr.zeros(mi.UInt32, count))
    rng = mi.PCG32(size=count)
    wi = mi.Vector3f(0.6, 0, 0.8) + dr.zeros(mi.Vector3f, count)
    chosen, lobe, u, v = (rng.next_float32() for _ in range(4))
    dr.eval(wi, chosen, lobe, u, v)
    wo, density = surfaces.sample(weights, wi, chosen, lobe, mi.Point2f(u, v))
    expected = mi.Float(0)
    for number, parts in enumerate(surfaces.parts):
        for k, part in enumerate(parts):
            share = 1 if weights[number] is None else weights[number][k]
            expected += share * surfaces.families[part.family].pdf(mi.UInt32(part.member), wi, wo) / len(surfaces)
    np.testing.assert_allclose(np.array(density), np.array(expected), rtol=1e-4, atol=1e-7)
    above = np.array(wo.z) > 0
    assert (np.array(density)[above] > 0).all()
    # An integral over the hemisphere by these directions: of the cosine, pi; weighted by it, 2 pi / 3.
    cosine, density = np.array(wo.z, np.float64)[above], np.array(density, np.float64)[above]
    if any("lambertian" in name or "felt" in name for name in names):  # lobes that reach everywhere
        for power, integral in ((1, np.pi), (2, 2 * np.pi / 3)):
            terms = np.zeros(count)
            terms[: above.sum()] = cosine**power / density
            assert abs(terms.mean() - integral) < 4.5 * terms.std() / np.sqrt(count)


def test_other_materials_or_numbers_of_them_compile_nothing(directions, points):
    rng = mi.PCG32(size=COUNT)
    chosen, lobe, u, v = (rng.next_float32() for _ in range(4))
    dr.eval(chosen, lobe, u, v, *directions, *points)

    def go(*names: str) -> None:
        surfaces = pack(names)
        weights = surfaces.weights(*points)
        wo, density = surfaces.sample(weights, directions[0], chosen, lobe, mi.Point2f(u, v))
        dr.eval(density, [surfaces.eval(number, directions[0], wo, weights[number]) for number in range(2)])

    go("chrome", "brass")
    go("stripes:1:chrome+brass", "nickel")
    others = (("steel", "pvc"), ("nylon", "pink-felt"))
    assert support.compiled(lambda: [go(*names) for names in others]) == 0
    assert support.compiled(lambda: go("stripes:9:nylon+pvc", "chrome")) == 0


def test_nothing_to_pack_and_unknown_names_are_errors():
    with pytest.raises(InputError, match="at least one"):
        pack([])
    with pytest.raises(InputError, match="did you mean 'chrome'"):
        pack(["lambertian:1", "crome"])
    with pytest.raises(InputError, match="needs the mesh"):
        pack(["parts:0:chrome+nylon"])
    assert pack(["parts:0:chrome+nylon"], shapes.load("sphere")).parts == ((Part(0, 0), Part(0, 1)),)


# ---- The Mitsuba plugin of whole surfaces -------------------------------------------------------------


@pytest.mark.parametrize("name", ["chrome", "gradient:0:chrome+pink-felt", "patches:3:chrome+table+lambertian:1"])
def test_the_plugin_is_the_surface(name, table, directions, points):
    surface_bsdf.register()
    surface = name.replace("table", table)
    plugin, surfaces = mi.load_dict({"type": "ps_surface", "material": surface}), pack([surface])
    si = dr.zeros(mi.SurfaceInteraction3f, COUNT)
    si.wi, si.p, si.prim_index = directions[0], points[0], points[1]
    weights, context = surfaces.weights(*points), mi.BSDFContext()
    value = np.array(plugin.eval(context, si, directions[1], True))
    np.testing.assert_allclose(value, np.array(surfaces.eval(0, *directions, weights[0])), rtol=1e-4, atol=1e-7)
    both = plugin.eval_pdf(context, si, directions[1], True)
    np.testing.assert_array_equal(np.array(both[0]), value)
    np.testing.assert_array_equal(np.array(both[1]), np.array(plugin.pdf(context, si, directions[1], True)))
    rng = mi.PCG32(size=COUNT)
    point = mi.Point2f(rng.next_float32(), rng.next_float32())
    sample, weight = plugin.sample(context, si, rng.next_float32(), point, True)
    drawn = np.array(sample.pdf) > 0
    assert drawn.mean() > 0.5
    density, value = (np.array(found) for found in (plugin.pdf(context, si, sample.wo, True),
                                                    plugin.eval(context, si, sample.wo, True)))  # fmt: skip
    np.testing.assert_allclose(density[drawn], np.array(sample.pdf)[drawn], rtol=1e-4)
    ratio = value / np.maximum(density, 1e-20)
    np.testing.assert_allclose(ratio[:, drawn], np.array(weight)[:, drawn], rtol=1e-3, atol=1e-6)
    assert not np.array(weight)[:, ~drawn].any()
    assert surface in str(plugin)
    exposed = {key.rsplit(".", 1)[-1] for key in mi.traverse(plugin).keys()}  # noqa: SIM118
    assert {"family0_lobes", "family1_tables"} <= exposed if "table" in name else {"lobes", "shadowing"} <= exposed


def test_the_plugin_is_black_from_below():
    surface_bsdf.register()
    plugin = mi.load_dict({"type": "ps_surface", "material": "gradient:0:chrome+pink-felt"})
    si = dr.zeros(mi.SurfaceInteraction3f, 3)
    si.wi = mi.Vector3f([0.6, 0.6, 0.6], 0, [-0.8, 0.8, 0.8])
    si.p = mi.Point3f(0, 0, 1)
    wo = mi.Vector3f(0, 0.6, [0.8, -0.8, 0.8])
    value, density = plugin.eval_pdf(mi.BSDFContext(), si, wo, True)
    assert not np.array(value)[:, :2].any() and not np.array(density)[:2].any()
    assert np.array(value)[:, 2].all() and np.array(density)[2] > 0
