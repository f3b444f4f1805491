"""RGL `.bsdf` files: reading with its errors, writing any BRDF for Mitsuba's `measured`, evaluation in kernels."""

import re
from functools import partial
from itertools import combinations

import numpy as np
import pytest
import render_support as support

from render.backend.jit import dr, mi
from render.materials import library, model, rgl
from render.materials.fit import spheres
from render.materials.kernels import rgl_bsdf
from render.shared.errors import InputError

NAMES = ("chrome", "red-plastic", "pink-fabric")
SPREAD = {  # percent of relative RMS error on a sphere, see docs/reference/material-model.md
    "chrome": 0.3, "steel": 0.3, "black-obsidian": 0.5, "brass": 0.3, "grease-covered-steel": 0.5, "hematite": 0.3,
    "gold-metallic-paint": 0.3, "specular-black-phenolic": 0.5, "white-marble": 0.5, "red-plastic": 1.0,
    "blue-fabric": 1.0, "pink-felt": 1.0, "polyethylene": 1.5,
}  # fmt: skip


def brdf(name: str):
    return partial(model.evaluate, library.load(name))


@pytest.fixture(scope="module")
def files(tmp_path_factory) -> list[rgl.RglMaterial]:
    folder = tmp_path_factory.mktemp("rgl")
    return [rgl.write(folder / f"{name}_rgb.bsdf", brdf(name), description=name) for name in NAMES]


@pytest.fixture(scope="module")
def packed(files) -> rgl_bsdf.PackedRgl:
    return rgl_bsdf.PackedRgl(files)


@pytest.fixture(scope="module")
def small(tmp_path_factory) -> dict[str, np.ndarray]:
    """Return the fields of a small valid file."""
    path = tmp_path_factory.mktemp("small") / "small.bsdf"
    rgl.write(path, lambda wi, wo: np.full((len(wi), 3), 0.1), slices=3, side=5)
    return rgl.read_fields(path)


def vectors(count: int, seed: int = 0) -> tuple:
    """Return two sets of directions above the horizon, half of the second close to mirror reflection."""
    rng = np.random.default_rng(seed)
    wi, wo = rng.normal(size=(2, count, 3))
    near = np.arange(count) % 2 == 0
    wo[near] = wi[near] * [-1, -1, 1] + rng.normal(scale=0.02, size=(near.sum(), 3))
    wi, wo = (np.abs(v * [0, 0, 1]) + v * [1, 1, 0] for v in (wi, wo))
    return tuple((v / np.linalg.norm(v, axis=1, keepdims=True)).astype(np.float32) for v in (wi, wo))


def vector(values: np.ndarray) -> "mi.Vector3f":
    return mi.Vector3f(np.ascontiguousarray(values.T, np.float32))


def test_loaded_material_is_named_after_its_file(files):
    material = library.load(files[1].path)
    assert (material.name, material.category, material.path) == ("red-plastic", "measured", files[1].path)
    assert material.description == "red-plastic"


def test_container_is_the_one_mitsuba_reads(files, capsys):
    from mitsuba.python import tensor_io

    ours, theirs = rgl.read_fields(files[0].path), tensor_io.read(str(files[0].path))
    capsys.readouterr()
    assert ours.keys() == theirs.keys()
    for name in ours:
        assert ours[name].dtype == theirs[name].dtype
        np.testing.assert_array_equal(ours[name], theirs[name])
    assert files[0].path.stat().st_size < 5e6


def test_fields_of_every_type_round_trip(tmp_path):
    fields = {f"f{kind}": np.arange(6).astype(kind).reshape(2, 3) for kind in ("u1", "i2", "<u8", "f2", "f4", "f8")}
    rgl.write_fields(tmp_path / "a.bsdf", {**fields, "one": np.float32(3)})
    read = rgl.read_fields(tmp_path / "a.bsdf")
    assert read.pop("one") == 3
    for name, values in fields.items():
        np.testing.assert_array_equal(read[name], values)


CHANGES = {
    "spectral": (lambda f: {**f, "wavelengths": np.ones(4, np.float32)}, "spectral measurement; use the .*_rgb.bsdf"),
    "anisotropic": (
        lambda f: {k: np.repeat(v, 8, 0) if k in ("phi_i", "vndf", "luminance", "rgb") else v for k, v in f.items()},
        "phi_i: an anisotropic",
    ),
    "missing": (lambda f: {k: v for k, v in f.items() if k != "sigma"}, "sigma: no such field"),
    "type": (lambda f: {**f, "ndf": f["ndf"].astype(np.float64)}, "ndf: expected 2 dimensions of float32"),
    "rank": (lambda f: {**f, "rgb": f["rgb"][0]}, "rgb: expected 5 dimensions"),
    "shape": (lambda f: {**f, "luminance": f["luminance"][:, :, :-1]}, "luminance: expected the shape"),
    "angles": (lambda f: {**f, "theta_i": f["theta_i"][::-1]}, "theta_i: expected rising"),
    "finite": (lambda f: {**f, "rgb": f["rgb"] * np.float32(np.nan)}, "rgb: holds values that are not finite"),
    "jacobian": (lambda f: {**f, "jacobian": np.zeros(2, np.uint8)}, "jacobian: expected bytes"),
    "tiny": (lambda f: {**f, "ndf": np.ones((1, 4), np.float32)}, "ndf: expected at least 2x2"),
}


@pytest.mark.parametrize("change", CHANGES)
def test_unusable_files_are_refused_in_one_line(tmp_path, small, change):
    alter, message = CHANGES[change]
    path = tmp_path / "bad.bsdf"
    rgl.write_fields(path, alter(small))
    with pytest.raises(InputError, match=message) as caught:
        rgl.load(path)
    assert str(caught.value).startswith(str(path)) and "\n" not in str(caught.value)


def test_other_and_damaged_files_are_refused_in_one_line(tmp_path, files):
    data = files[0].path.read_bytes()
    for number, (content, message) in enumerate(
        [
            (b"\x89PNG" + bytes(100), "does not begin with 'tensor_file'"),
            (data[:14], "cut short"),
            (data[:200], "cut short"),
            (data[:-1000], "rgb lies beyond the end"),
            (data[:12] + b"\x02\x00" + data[14:], "version 2.0"),
        ]
    ):
        path = tmp_path / f"{number}.bsdf"
        path.write_bytes(content)
        with pytest.raises(InputError, match=message) as caught:
            library.load(path)
        assert "\n" not in str(caught.value)
    with pytest.raises(InputError, match="no such file"):
        rgl.load(tmp_path / "none.bsdf")


def test_a_brdf_with_bad_values_is_not_written(tmp_path):
    for value in (-1.0, np.nan):
        with pytest.raises(InputError, match="negative or not finite"):
            rgl.write(tmp_path / "bad.bsdf", lambda wi, wo, v=value: np.full((len(wi), 3), v), slices=3, side=5)
    assert not any(tmp_path.iterdir())


@pytest.mark.parametrize("name", SPREAD)
def test_measured_reproduces_the_material_on_a_sphere(tmp_path, name):
    """The metric of docs/studies/material-fits.md, camera as Mitsuba's wi."""
    samples = spheres.sphere_image(96, spheres.hemisphere_lights(12, np.random.default_rng(5)))
    written = rgl_bsdf.PackedRgl([rgl.write(tmp_path / "a.bsdf", brdf(name))])
    value = np.array(written.eval(mi.UInt32(0), vector(samples.wo), vector(samples.wi))).T
    assert value.min() >= 0
    reference = model.evaluate(library.load(name), samples.wi, samples.wo)
    assert 100 * spheres.sphere_error(value / samples.wi[:, 2:], reference, samples) < SPREAD[name]


@pytest.mark.parametrize("light", [(0.2, 0.1, 1), (1.2, 0.3, 0.5)])
def test_the_narrowest_highlight_keeps_its_light(packed, light):
    """Integral over the normals of a sphere lit from `light`, in rings about the half vector, of chrome."""
    (light,) = support.unit(light).astype(np.float64)
    half = light + np.array([0.0, 0.0, 1.0])
    half /= np.linalg.norm(half)
    rings = np.concatenate([[0], np.geomspace(1e-6, 0.3, 2000)])
    angle, azimuth = (rings[1:, None] + rings[:-1, None]) / 2, np.arange(48) * np.pi / 24
    tangent = np.cross(half, [0, 1, 0]) / np.linalg.norm(np.cross(half, [0, 1, 0]))
    side = np.cos(azimuth)[:, None] * tangent + np.sin(azimuth)[:, None] * np.cross(half, tangent)
    normals = (np.cos(angle)[..., None] * half + np.sin(angle)[..., None] * side).reshape(-1, 3)
    area = np.repeat(np.diff(rings) * np.sin(angle[:, 0]), 48)
    wi, wo = spheres.shading_frame(normals, light)
    lit = (wi[:, 2] > 0) & (wo[:, 2] > 0)
    got = np.array(packed.eval(mi.UInt32(0), vector(wo[lit]), vector(wi[lit]))).T
    expected = model.evaluate(library.load("chrome"), wi, wo)[lit] * wi[lit, 2:]
    np.testing.assert_allclose(area[lit] @ got, area[lit] @ expected, rtol=0.002)


@pytest.mark.parametrize("number", range(len(NAMES)))
def test_packed_files_evaluate_as_their_plugin(packed, files, number):
    wi, wo = map(vector, vectors(3000))
    plugin = mi.load_dict({"type": "measured", "filename": str(files[number].path)})
    si = dr.zeros(mi.SurfaceInteraction3f, 3000)
    si.wi = wi
    expected = np.array(plugin.eval(mi.BSDFContext(), si, wo, True))
    index = dr.full(mi.UInt32, number, 3000)
    # Not to the bit: `measured` leaves `m_reduction` of isotropic files unset, and its value changes the rounding.
    close = partial(np.testing.assert_allclose, rtol=1e-3, atol=1e-6)
    close(np.array(packed.eval(index, wi, wo)), expected)
    close(np.array(packed.eval_at(index, packed.prepare(wi, wo))), expected)
    close(np.array(packed.pdf(index, wi, wo)), np.array(plugin.pdf(mi.BSDFContext(), si, wo, True)))
    assert not np.array(packed.eval(index, wi, -wo)).any() and not np.array(packed.pdf(index, wi, -wo)).any()
    assert not np.array(packed.eval(index, wi, wo, mi.Bool(False))).any()
    assert packed.names == NAMES and len(packed) == 3


def test_highlights_are_distinguished_from_matt_materials(packed):
    chrome, plastic, fabric = packed.highlight
    assert packed.highlight.dtype == np.float64
    assert 1 > chrome > plastic > fabric >= 0 and chrome > 0.5 and fabric < 0.1


def test_data_dependent_loops_select_the_file_in_each_lane(packed):
    """A symbolic loop of a different length in every lane, over a different material in every lane."""
    count = 999
    wi, wo = map(vector, vectors(count))
    index = dr.arange(mi.UInt32, count) % 3
    length = dr.arange(mi.UInt32, count) % 5
    dr.eval(wi, wo, index, length)

    def body(i, total):
        chosen = (index + i) % 3
        drawn = packed.sample_lobe(chosen, wi, 0.5, mi.Point2f(0.3, 0.6))
        return i + 1, total + packed.eval(chosen, wi, wo) + packed.pdf(chosen, wi, drawn)

    _, total = dr.while_loop((mi.UInt32(0), mi.Color3f(0)), lambda i, _: i < length, body)
    single = []
    for number in range(3):
        drawn = packed.sample_lobe(mi.UInt32(number), wi, 0.5, mi.Point2f(0.3, 0.6))
        single.append(np.array(packed.eval(mi.UInt32(number), wi, wo) + packed.pdf(mi.UInt32(number), wi, drawn)))
    lane = np.arange(count)
    expected = sum(
        np.where(step < lane % 5, np.stack(single)[(lane % 3 + step) % 3, :, lane].T, 0) for step in range(4)
    )
    np.testing.assert_allclose(np.array(total), expected, rtol=1e-3, atol=1e-6)


def test_exchanging_files_compiles_nothing_again(tmp_path, packed):
    wi, wo = map(vector, vectors(1000))
    dr.eval(wi, wo)

    def total(family) -> None:
        count = dr.opaque(mi.UInt32, len(family))
        state = (mi.UInt32(0), mi.Color3f(0))
        dr.eval(dr.while_loop(state, lambda k, _: k < count, lambda k, v: (k + 1, v + family.eval(k, wi, wo))))

    total(packed)
    names = ("nickel", "nylon", "brass", "teflon", "pvc", "steel", "delrin")
    written = [rgl.write(tmp_path / f"{name}.bsdf", brdf(name)) for name in names]
    hashes, pieces = set(), set()
    for pair in combinations(written, 2):
        family = rgl_bsdf.PackedRgl(list(pair))
        with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
            dr.kernel_history_clear()
            total(family)
            kernels = dr.kernel_history([dr.KernelType.JIT])
        hashes |= {kernel["hash"] for kernel in kernels}
        pieces.update(*(re.findall(r"define fastcc .*@(func_\w+)", kernel["ir"].getvalue()) for kernel in kernels))
    # Mitsuba leaves `m_reduction` of isotropic files unset, so each is one of three pieces of code: below 2, 4, others.
    # The kernel of a pair holds one piece twice, or two, and which comes first orders its arguments: up to 9 of them.
    assert 1 <= len(pieces) <= 3 and len(hashes) <= len(pieces) ** 2, (hashes, pieces)


@pytest.mark.parametrize(("number", "incidence"), [(0, 30), (1, 75), (2, 45)])
def test_sampling_follows_the_density(files, number, incidence):
    from mitsuba.chi2 import BSDFAdapter, ChiSquareTest, SphericalDomain

    angle = float(np.radians(incidence))
    sample, density = BSDFAdapter(
        "measured",
        f'<string name="filename" value="{files[number].path}"/>',
        wi=mi.Vector3f(dr.sin(angle), 0, dr.cos(angle)),
    )
    # Fine bins: the test's own quadrature of the density misses sub-degree peaks otherwise.
    settings = {"sample_dim": 3, "sample_count": 500_000, "res": 201, "ires": 32}
    test = ChiSquareTest(domain=SphericalDomain(), sample_func=sample, pdf_func=density, **settings)
    assert test.run(test_count=3, quiet=True), test.messages


@pytest.mark.parametrize("number", range(len(NAMES)))
def test_importance_sampling_estimates_the_directional_albedo(packed, number):
    count, index = 200_000, mi.UInt32(number)
    rng = mi.PCG32(size=count)
    wi = mi.Vector3f(0.6, 0, 0.8)
    wo = packed.sample_lobe(index, wi, 0.0, mi.Point2f(rng.next_float32(), rng.next_float32()))
    density = packed.pdf(index, wi, wo)
    weight = np.array(dr.select(density > 0, packed.eval(index, wi, wo) / density, 0)).T
    expected = model.directional_albedo(library.load(NAMES[number]), np.array([0.8]))[0]
    np.testing.assert_allclose(weight.mean(0), expected, rtol=0.01)
    assert weight.std() < weight.mean()  # no fireflies, mirror-like metals included


def test_the_renderer_takes_files(files):
    """Same seed, same camera paths: with direct light only the images differ by the tables' interpolation."""
    settings = {"lights": support.unit([0.2, 0.1, 1], [1, 0.3, 0.5]), "size": 16, "spp": 16}
    _, fitted = support.render(support.bowl(), "red-plastic", **settings)
    _, tabled = support.render(support.bowl(), str(files[1].path), **settings)
    assert np.linalg.norm(tabled[0] - fitted[0]) < 0.02 * np.linalg.norm(fitted[0])


def test_nothing_to_pack_is_an_error():
    with pytest.raises(InputError, match="at least one"):
        rgl_bsdf.PackedRgl([])
