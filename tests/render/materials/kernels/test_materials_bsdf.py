"""The kernels' form of the materials against the numpy form, and the Mitsuba plugin against Mitsuba's own tests."""

import numpy as np
import pytest
from brdf_support import directions, vector

from render.backend.jit import dr, mi
from render.materials import library, model
from render.materials.fit import spheres
from render.materials.kernels import bsdf, lobes, surface_bsdf
from render.shared.errors import InputError

NAMES = ("chrome", "steel", "pink-fabric", "specular-orange-phenolic", "lambertian:0.8/0.3/0.1")


@pytest.fixture(scope="module")
def packed() -> bsdf.PackedMaterials:
    return bsdf.PackedMaterials([library.load(name) for name in NAMES])


@pytest.mark.parametrize("index", range(len(NAMES)))
def test_kernel_equals_the_numpy_reference(packed, index):
    wi, wo = directions()
    value = np.array(packed.eval(mi.UInt32(index), vector(wi), vector(wo))).T
    material = library.load(NAMES[index])
    expected = model.evaluate(material, wi, wo) * np.maximum(wo[:, 2:], 0)
    np.testing.assert_allclose(value, expected, rtol=1e-4, atol=1e-6)
    assert not value[wo[:, 2] <= 0].any()


def test_prepared_coordinates_serve_every_material(packed):
    wi, wo = map(vector, directions(500))
    at = packed.prepare(wi, wo)
    for index in range(len(packed)):
        np.testing.assert_array_equal(
            np.array(packed.eval_at(mi.UInt32(index), at)), np.array(packed.eval(mi.UInt32(index), wi, wo))
        )


def test_inactive_lanes_are_zero(packed):
    wi, wo = map(vector, directions(200))
    value = np.array(packed.eval(mi.UInt32(2), wi, wo, dr.arange(mi.UInt32, 200) < 100))
    assert value[:, :100].any() and not value[:, 100:].any()


def test_symbolic_loop_over_materials_compiles_once_for_any_set(packed):
    wi, wo = map(vector, directions(1000))
    dr.eval(wi, wo)

    def total(materials: bsdf.PackedMaterials) -> "mi.Color3f":
        count = dr.opaque(mi.UInt32, len(materials))
        _, value = dr.while_loop(
            (mi.UInt32(0), mi.Color3f(0)),
            lambda index, value: index < count,
            lambda index, value: (index + 1, value + materials.eval(index, wi, wo) + materials.pdf(index, wi, wo)),
        )
        dr.eval(value)
        return value

    expected = sum(np.array(packed.eval(mi.UInt32(k), wi, wo) + packed.pdf(mi.UInt32(k), wi, wo)) for k in range(5))
    np.testing.assert_allclose(np.array(total(packed)), expected, rtol=1e-4, atol=1e-5)
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history_clear()
        for names in (["nickel"], ["brass", "teflon", "nylon"], list(library.names())[:40]):
            total(bsdf.PackedMaterials([library.load(name) for name in names]))
        history = [entry for entry in dr.kernel_history() if entry["type"] == dr.KernelType.JIT]
    assert len({entry["hash"] for entry in history}) == 2  # the copy into Dr.Jit's own memory, and the loop


@pytest.mark.parametrize(
    ("name", "incidence"),
    [("chrome", 20), ("steel", 70), ("pink-fabric", 45), ("gold-paint", 75), ("lambertian:0.5", 5)],
)
def test_sampling_follows_the_density(name, incidence):
    from mitsuba.chi2 import BSDFAdapter, ChiSquareTest, SphericalDomain

    surface_bsdf.register()
    angle = float(np.radians(incidence))
    wi = mi.Vector3f(dr.sin(angle), 0, dr.cos(angle))
    sample, density = BSDFAdapter("ps_surface", f'<string name="material" value="{name}"/>', wi=wi)
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


def test_density_integrates_to_the_share_of_directions_above_the_horizon(packed):
    """Integrating steel's density with chrome's samples must give the fraction of steel's own that are usable."""
    count, chrome, steel = 1_000_000, mi.UInt32(0), mi.UInt32(1)
    rng = mi.PCG32(size=count)
    wi = mi.Vector3f(dr.sin(1.2), 0, dr.cos(1.2))
    other = packed.sample_lobe(chrome, wi, rng.next_float32(), mi.Point2f(rng.next_float32(), rng.next_float32()))
    density = packed.pdf(chrome, wi, other)
    integral = dr.mean(dr.select(density > 0, packed.pdf(steel, wi, other) / density, 0))
    own = packed.sample_lobe(steel, wi, rng.next_float32(), mi.Point2f(rng.next_float32(), rng.next_float32()))
    np.testing.assert_allclose(integral, dr.mean(dr.select(own.z > 0, mi.Float(1), 0)), rtol=0.004)


@pytest.mark.parametrize("name", ["chrome", "gold-metallic-paint", "white-marble", "lambertian:0.5"])
def test_importance_sampling_estimates_the_directional_albedo(name):
    surface_bsdf.register()
    plugin = mi.load_dict({"type": "ps_surface", "material": name})
    count = 200_000
    si = dr.zeros(mi.SurfaceInteraction3f, count)
    si.wi = mi.Vector3f(0.6, 0, 0.8)
    rng = mi.PCG32(size=count)
    point = mi.Point2f(rng.next_float32(), rng.next_float32())
    sample, weight = plugin.sample(mi.BSDFContext(), si, rng.next_float32(), point, True)
    weight = np.array(weight).T
    expected = model.directional_albedo(library.load(name), np.array([0.8]))[0]
    np.testing.assert_allclose(weight.mean(0), expected, rtol=0.02)
    assert weight.std() < 2 * weight.mean()  # importance sampling: no fireflies, mirror-like metals included
    value, density = plugin.eval_pdf(mi.BSDFContext(), si, sample.wo, True)
    np.testing.assert_array_equal(np.array(value), np.array(plugin.eval(mi.BSDFContext(), si, sample.wo, True)))
    np.testing.assert_array_equal(np.array(density), np.array(plugin.pdf(mi.BSDFContext(), si, sample.wo, True)))
    drawn = np.array(sample.pdf) > 0
    np.testing.assert_allclose(np.array(density)[drawn], np.array(sample.pdf)[drawn], rtol=1e-5)
    ratio = (np.array(value) / np.maximum(np.array(density), 1e-20)).T
    np.testing.assert_allclose(ratio[drawn], weight[drawn], rtol=1e-4, atol=1e-7)


@pytest.mark.parametrize("name", ["chrome", "red-plastic"])
def test_plugin_renders_a_directly_lit_sphere_as_the_reference(name):
    surface_bsdf.register()
    light = np.array([0.48, 0.36, 0.8])
    scene = mi.load_dict(
        {
            "type": "scene",
            "sphere": {"type": "sphere", "bsdf": {"type": "ps_surface", "material": name}},
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
    expected = np.pi * model.evaluate(library.load(name), wi, wo) * np.maximum(wi[:, 2:], 0)
    inside = (wo[:, 2] > 0.1) & (np.abs(wi[:, 2]) > 0.02)
    np.testing.assert_allclose(np.array(radiance).T[inside], expected[inside], rtol=5e-3, atol=1e-6)


def test_plugin_exposes_its_tables_and_names_itself():
    surface_bsdf.register()
    surface_bsdf.register()
    plugin = mi.load_dict({"type": "ps_surface", "material": "brass"})
    assert {"tables", "shadowing", "lobes"} <= {key.rsplit(".", 1)[-1] for key in mi.traverse(plugin).keys()}  # noqa: SIM118
    assert "brass" in str(plugin)


def test_lobe_distribution_is_a_distribution():
    for name in ("chrome", "pink-felt"):
        table = lobes.lobe_distribution(library.load(name))
        assert 0 <= table[0] <= 0.9 and table[1] == 0 and table[-1] == pytest.approx(1)
        assert (np.diff(table[1:]) >= 0).all()
    assert lobes.lobe_distribution(library.load("lambertian:0.5"))[0] == 0


def test_nothing_to_pack_is_an_error():
    with pytest.raises(InputError, match="at least one"):
        bsdf.PackedMaterials([])
