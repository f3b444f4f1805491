"""The kernels' form of MERL tables against the numpy form, and the plugin `merl` against Mitsuba's own tests."""

import numpy as np
import pytest
from brdf_support import directions, vector
from merl_support import of_library, values

from render.backend.jit import dr, mi
from render.materials import library, merl, model
from render.materials.fit import spheres
from render.materials.kernels import bsdf, lobes, merl_bsdf, surface_bsdf
from render.shared.errors import InputError

NAMES = ("chrome", "glossy", "lambertian:1")


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """Paths of tables of a mirror-like metal, a glossy BRDF and white."""
    folder = tmp_path_factory.mktemp("merl")
    paths = {name: folder / f"{name.partition(':')[0]}.binary" for name in NAMES}
    for name, path in paths.items():
        merl.write(path, values(name))
    return paths


@pytest.fixture(scope="module")
def tables(files):
    return [library.load(files[name]) for name in NAMES]


@pytest.fixture(scope="module")
def packed(tables):
    return merl_bsdf.PackedMerl(tables)


@pytest.fixture
def plugin(files):
    """Return a function that loads the plugin with one of the tables."""
    surface_bsdf.register()
    return lambda name: mi.load_dict({"type": "ps_surface", "material": str(files[name])})


@pytest.mark.parametrize("index", range(len(NAMES)))
def test_kernel_equals_the_numpy_reference(packed, tables, index):
    wi, wo = directions()
    value = np.array(packed.eval(mi.UInt32(index), vector(wi), vector(wo))).T
    expected = merl.evaluate(tables[index], wi, wo) * np.maximum(wo[:, 2:], 0)
    np.testing.assert_allclose(value, expected, rtol=2e-4, atol=1e-6)
    assert not value[wo[:, 2] <= 0].any()


def test_kernel_meets_the_degenerate_directions(packed, tables):
    """theta_h = 0, theta_d = 0 and the normal itself, where angles are undefined."""
    wi = np.array([[0, 0, 1], [0.6, 0, 0.8], [0.6, 0, 0.8], [0, -0.28, 0.96]], np.float32)
    wo = np.array([[0, 0, 1], [-0.6, 0, 0.8], [0.6, 0, 0.8], [0, 0.28, 0.96]], np.float32)
    for index, table in enumerate(tables):
        value = np.array(packed.eval(mi.UInt32(index), vector(wi), vector(wo))).T
        np.testing.assert_allclose(value, merl.evaluate(table, wi, wo) * wo[:, 2:], rtol=2e-3)


def test_kernel_is_reciprocal(packed):
    wi, wo = directions()
    above = (wo[:, 2] > 0.01) & (wi[:, 2] > 0.01)
    there = np.array(packed.eval(mi.UInt32(0), vector(wi), vector(wo))).T[above] / wo[above, 2:]
    back = np.array(packed.eval(mi.UInt32(0), vector(wo), vector(wi))).T[above] / wi[above, 2:]
    np.testing.assert_allclose(there, back, rtol=1e-4)


def test_prepared_coordinates_serve_every_table_and_inactive_lanes_are_zero(packed):
    wi, wo = map(vector, directions(400))
    at = packed.prepare(wi, wo)
    for index in range(len(packed)):
        whole = np.array(packed.eval(mi.UInt32(index), wi, wo))
        np.testing.assert_array_equal(np.array(packed.eval_at(mi.UInt32(index), at)), whole)
    half = np.array(packed.eval(mi.UInt32(1), wi, wo, dr.arange(mi.UInt32, 400) < 200))
    assert half[:, :200].any() and not half[:, 200:].any()


def test_a_symbolic_loop_compiles_once_for_any_tables(packed, tables):
    wi, wo = map(vector, directions(1000))
    dr.eval(wi, wo)

    def total(family: merl_bsdf.PackedMerl) -> "mi.Color3f":
        count = dr.opaque(mi.UInt32, len(family))
        _, value = dr.while_loop(
            (mi.UInt32(0), mi.Color3f(0)),
            lambda index, value: index < count,
            lambda index, value: (index + 1, value + family.eval(index, wi, wo) + family.pdf(index, wi, wo)),
        )
        dr.eval(value)
        return value

    expected = sum(np.array(packed.eval(mi.UInt32(k), wi, wo) + packed.pdf(mi.UInt32(k), wi, wo)) for k in range(3))
    np.testing.assert_allclose(np.array(total(packed)), expected, rtol=1e-4, atol=1e-5)
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history_clear()
        for chosen in (tables[:1], tables[1:]):
            total(merl_bsdf.PackedMerl(chosen))
        history = [entry for entry in dr.kernel_history() if entry["type"] == dr.KernelType.JIT]
    assert len({entry["hash"] for entry in history}) == 2  # the copy into Dr.Jit's own memory, and the loop


@pytest.mark.parametrize(("name", "incidence"), [("chrome", 20), ("glossy", 70), ("lambertian:1", 45)])
def test_sampling_follows_the_density(files, name, incidence):
    from mitsuba.chi2 import BSDFAdapter, ChiSquareTest, SphericalDomain

    surface_bsdf.register()
    angle = float(np.radians(incidence))
    wi = mi.Vector3f(dr.sin(angle), 0, dr.cos(angle))
    sample, density = BSDFAdapter("ps_surface", f'<string name="material" value="{files[name]}"/>', wi=wi)
    # Fine bins: the test's own quadrature of the density misses sub-degree steps otherwise.
    test = ChiSquareTest(
        domain=SphericalDomain(),
        sample_func=sample,
        pdf_func=density,
        sample_dim=3,
        sample_count=1_000_000,
        res=401,
        ires=32,
    )
    assert test.run(test_count=5, quiet=True), test.messages


def sampled(plugin: "mi.BSDF", wi: tuple, count: int = 200_000) -> tuple:
    """Draw directions; return the surface interaction, the BSDF sample and the (count, 3) weights."""
    si = dr.zeros(mi.SurfaceInteraction3f, count)
    si.wi = mi.Vector3f(*wi)
    rng = mi.PCG32(size=count)
    point = mi.Point2f(rng.next_float32(), rng.next_float32())
    sample, weight = plugin.sample(mi.BSDFContext(), si, rng.next_float32(), point, True)
    return si, sample, np.array(weight).T


@pytest.mark.parametrize("name", ["chrome", "lambertian:1"])
def test_importance_sampling_estimates_the_directional_albedo(plugin, name):
    bsdf_of_table = plugin(name)
    si, sample, weight = sampled(bsdf_of_table, (0.6, 0, 0.8))
    expected = model.directional_albedo(library.load(name), np.array([0.8]))[0]
    np.testing.assert_allclose(weight.mean(0), expected, rtol=0.05)  # chrome's table itself is 1 % off
    assert weight.std() < 2 * weight.mean()
    value, density = bsdf_of_table.eval_pdf(mi.BSDFContext(), si, sample.wo, True)
    np.testing.assert_array_equal(np.array(value), np.array(bsdf_of_table.eval(mi.BSDFContext(), si, sample.wo, True)))
    np.testing.assert_array_equal(np.array(density), np.array(bsdf_of_table.pdf(mi.BSDFContext(), si, sample.wo, True)))
    drawn = np.array(sample.pdf) > 0
    np.testing.assert_allclose(np.array(density)[drawn], np.array(sample.pdf)[drawn], rtol=1e-5)
    ratio = (np.array(value) / np.maximum(np.array(density), 1e-20)).T
    np.testing.assert_allclose(ratio[drawn], weight[drawn], rtol=1e-4, atol=1e-7)


@pytest.mark.parametrize("incidence", [0, 60, 85, 89.5])
def test_white_returns_all_light_and_no_more(plugin, incidence):
    angle = np.radians(incidence)
    _, _, weight = sampled(plugin("lambertian:1"), (float(np.sin(angle)), 0, float(np.cos(angle))), 50_000)
    np.testing.assert_allclose(weight, 1, rtol=1e-4)


def test_plugin_is_black_from_behind(plugin):
    behind = plugin("lambertian:1")
    si, sample, weight = sampled(behind, (0.6, 0, -0.8), 1000)
    assert not weight.any() and not np.array(sample.pdf).any()
    assert not np.array(behind.eval(mi.BSDFContext(), si, mi.Vector3f(0, 0, 1), True)).any()


def test_plugin_renders_a_directly_lit_sphere_as_the_material_it_tabulates(plugin):
    light = np.array([0.48, 0.36, 0.8])
    scene = mi.load_dict(
        {
            "type": "scene",
            "sphere": {"type": "sphere", "bsdf": plugin("chrome")},
            "light": {"type": "directional", "direction": list(-light), "irradiance": float(np.pi)},
        }
    )
    _, normals = spheres.sphere_normals(40)
    wi, wo = spheres.shading_frame(normals, light)
    origin = mi.Point3f(*(np.ascontiguousarray(axis, np.float32) for axis in (normals * [1, 1, 0] + [0, 0, 3]).T))
    ray = mi.RayDifferential3f(mi.Ray3f(origin, mi.Vector3f(0, 0, -1)))
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(0, len(normals))
    radiance, _, _ = mi.load_dict({"type": "path", "max_depth": 2}).sample(scene, sampler, ray)
    expected = np.pi * of_library("chrome")(wi, wo) * np.maximum(wi[:, 2:], 0)
    inside = (wo[:, 2] > 0.1) & (np.abs(wi[:, 2]) > 0.02)
    error = np.abs(np.array(radiance).T - expected)[inside] / np.maximum(expected[inside], 1e-4)
    assert np.median(error) < 3e-3 and np.percentile(error, 95) < 0.05  # of the table, not of its evaluation


def test_plugin_exposes_its_table_and_names_itself(plugin):
    surface_bsdf.register()  # a second time does nothing
    shown = plugin("glossy")
    assert {"tables", "lobes"} <= {key.rsplit(".", 1)[-1] for key in mi.traverse(shown).keys()}  # noqa: SIM118
    assert "glossy.binary" in str(shown)


def test_the_coarse_form_gives_a_lobe_where_there_is_a_highlight(tables, packed):
    own = bsdf.PackedMaterials([library.load("chrome")])
    np.testing.assert_allclose(packed.highlight[[0, 2]], [own.highlight[0], 0], atol=0.05)
    probability = [lobes.lobe_distribution(merl_bsdf.coarse_form(table))[0] for table in tables]
    assert probability[0] > 0.5 > probability[1] > 0.05 and probability[2] == 0


def test_missing_files_and_nothing_to_pack_are_errors(tmp_path):
    surface_bsdf.register()
    with pytest.raises(InputError, match="MERL tables can be packed"):
        merl_bsdf.PackedMerl([])
    with pytest.raises(Exception, match="no such file"):
        mi.load_dict({"type": "ps_surface", "material": str(tmp_path / "absent.binary")})
