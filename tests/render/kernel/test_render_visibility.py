"""Shadow bits: right for every light, and shared among a pixel's samples only where they agree."""

import numpy as np
import pytest
import render_support as support

from render import shapes
from render.backend.jit import dr, mi
from render.kernel import many_lights, paths, scene
from render.kernel.emitters import DistantLights
from render.kernel.visibility import WORD, cells, group_visibility, probe_count, probe_visibility, visibility
from render.records.manifest import View

SIZE, SPP = 16, 32


class NoShadows(scene.Scene):
    """A scene in which no shadow ray meets anything."""

    def ray_test(self, *_):
        return mi.Bool(False)


def traced(
    built: scene.Scene, lights: np.ndarray, probe: bool, spp: int = SPP, view: View | None = None
) -> paths.Paths:
    return paths.trace(
        built, view or View(scale=0.95), support.packed("lambertian:0.5"), lights, size=SIZE, spp=spp, bounces=0,
        seed=3, probe=probe,
    )  # fmt: skip


def bits(words, count: int, lights: int) -> np.ndarray:
    """Return (lights, count) bool from the packed words."""
    words = np.array(words).reshape(-1, count)
    assert len(words) == -(-lights // WORD)
    unused = lights % WORD
    if unused:
        assert not (words[-1] >> unused).any()  # nothing beyond the last light
    number = np.arange(lights)
    return (words[number // WORD] >> (number % WORD)[:, None].astype(np.uint32)) & 1 != 0


def facing(found: paths.Paths) -> np.ndarray:
    """Return (L, N), whether a vertex faces a light."""
    return np.array(found.directions).T @ np.array(found.depths[0].normal) > 0


def both(built: scene.Scene, lights: np.ndarray, **settings) -> tuple:
    """Trace with probes and without; return the paths, and the bits of lights faced of either."""
    probed, asked = (traced(built, lights, probe, **settings) for probe in (True, False))
    count = asked.depths[0].count
    assert probed.depths[0].count == count
    faced = facing(asked)
    return asked, *(bits(found.depths[0].bitmask, count, len(lights)) & faced for found in (probed, asked)), faced


def pixel_of(found: paths.Paths) -> np.ndarray:
    """Return (N,) the number, among pixels with vertices, of each vertex's pixel."""
    return np.repeat(np.arange(dr.width(found.depths[0].pixels)), np.array(found.depths[0].length))


def test_probe_count():
    expected = {1: 1, 7: 7, 8: 8, 9: 8, 32: 8, 33: 8, 36: 16, 64: 16, 65: 16, 100: 32, 128: 32, 256: 64, 2048: 512}
    assert {spp: probe_count(spp) for spp in expected} == expected
    for spp in range(1, 600):
        count = probe_count(spp)
        assert count <= spp and (count == spp or (count >= 8 and count & (count - 1) == 0 and 4 * count >= spp - 3))


@pytest.mark.parametrize("lights", [1, 31, 32, 33, 64, 70])
def test_bits_tell_which_lights_a_vertex_sees(lights):
    """Against one ray per (vertex, light), cast without any packing."""
    built, directions = scene.build(support.bowl()), support.spread(lights, 0.02)
    found = traced(built, directions, probe=False)
    first = found.depths[0]
    seen = bits(first.bitmask, first.count, lights)
    for number in range(lights):
        towards = mi.Vector3f(*(float(c) for c in np.array(found.directions)[:, number]))
        # Off the surface along the exact normals: facets of the bowl are flat to 1e-3.
        start = mi.Ray3f(mi.Point3f(first.position + 1e-3 * first.normal), towards + dr.zeros(mi.Vector3f, first.count))
        expected = ~np.array(built.ray_test(start, True)) & facing(found)[number]
        assert (seen[number] != expected).mean() < 0.01
    assert 0.2 < seen.mean() < 0.5 and not (seen & ~facing(found)).any()


@pytest.mark.parametrize("lights", [1, 32, 33, 65])
def test_probing_changes_no_bit_where_nothing_casts_a_shadow(lights):
    directions = support.spread(lights, 0.02)
    _, probed, asked, faced = both(scene.build(support.plane()), directions, view=View(scale=1.5))
    assert asked.all() and probed.all() and faced.all()
    _, probed, asked, faced = both(NoShadows(shapes.load("sphere")), directions)
    np.testing.assert_array_equal(probed, asked)
    np.testing.assert_array_equal(asked, faced)


@pytest.mark.parametrize(("shape", "lights"), [("bowl", 33), ("sculpture:5", 64)])
def test_probing_follows_only_where_a_pixel_agrees(shape, lights):
    mesh = support.bowl() if shape == "bowl" else shapes.load(shape)
    found, probed, asked, faced = both(scene.build(mesh), support.spread(lights, 0.02))
    pixel, pixels = pixel_of(found), dr.width(found.depths[0].pixels)
    some, missing = (np.zeros((lights, pixels), bool) for _ in range(2))
    for number in range(lights):
        np.logical_or.at(some[number], pixel, asked[number])
        np.logical_or.at(missing[number], pixel, faced[number] & ~asked[number])
    uniform = ~(some & missing)[:, pixel]
    assert (~asked & faced).mean() > 0.03 and uniform.mean() < 0.999  # there are shadows, and edges of them
    np.testing.assert_array_equal(probed[uniform], asked[uniform])
    wrong = probed != asked
    assert wrong.mean() < 0.01 and wrong[~uniform].mean() < 0.1


def test_probing_keeps_the_light():
    """Slivers of shadow are missed a little more often than slivers of light; far less than the noise shows."""
    built, lights = scene.build(shapes.load("sculpture:5")), support.spread(32, 0.02)
    options = {"size": 64, "spp": 32, "bounces": 0, "seed": 0}
    probed, asked = (
        dict(many_lights.render(built, View(), support.packed("lambertian:0.8"), lights, probe=probe, **options)[1])[0]
        for probe in (True, False)
    )
    assert 0 < abs(probed.mean(dtype=np.float64) / asked.mean(dtype=np.float64) - 1) < 2e-3
    np.testing.assert_allclose(probed.mean((1, 2, 3)), asked.mean((1, 2, 3)), rtol=5e-3)


def test_samples_that_all_probe_change_nothing():
    built, directions = scene.build(support.bowl()), support.spread(40, 0.02)
    _, probed, asked, _ = both(built, directions, spp=8)
    np.testing.assert_array_equal(probed, asked)


def vertices(normals: np.ndarray, height: float) -> tuple:
    """Return position, normal and facet of vertices in a row over the plane z = 0."""
    count = len(normals)
    x = np.linspace(-0.5, 0.5, count).astype(np.float32)
    position = mi.Point3f(mi.Float(x), dr.zeros(mi.Float, count), dr.full(mi.Float, height, count))
    normal = mi.Vector3f(*(mi.Float(np.ascontiguousarray(column, np.float32)) for column in normals.T))
    dr.eval(position, normal)
    return position, normal, mi.Vector3f(0, 0, 1) + dr.zeros(mi.Vector3f, count)


def test_probes_that_do_not_face_a_light_decide_nothing():
    """Lights 0 and 1 are above and behind the plane; the probes of the first pixel face neither, all others both."""
    built = scene.build(support.plane())
    sideways, up = [0, 1, 0], [0.6, 0, 0.8]
    normals = np.array([sideways] * 4 + [up] * 4 + [up] * 8)
    at = vertices(normals, 0.5)
    lights = DistantLights(mi.Vector3f([0.0, 0.8], [0.0, 0.0], [1.0, -0.6]))  # up: seen; down into the plane: hidden
    probes = mi.Bool([True, True, True, True, False, False, False, False] * 2)
    segments = (mi.UInt32([0, 8]), mi.UInt32([8, 8]))
    expected = bits(visibility(built, *at, lights, 2, True), 16, 2)
    found = bits(probe_visibility(built, *at, lights, 2, probes, segments), 16, 2)
    np.testing.assert_array_equal(found[0], [False] * 4 + [True] * 12)
    assert not found[1].any()
    np.testing.assert_array_equal(found, expected)
    none = probe_visibility(built, *at, lights, 2, mi.Bool([False] * 16), segments)  # nobody probes: all ask
    np.testing.assert_array_equal(bits(none, 16, 2), expected)
    # A pixel none of whose samples probes, beside one that does.
    mixed = probe_visibility(built, *at, lights, 2, mi.Bool([False] * 8 + [True] * 4 + [False] * 4), segments)
    np.testing.assert_array_equal(bits(mixed, 16, 2), expected)


def test_other_lights_shapes_and_counts_compile_nothing():
    def go(mesh, lights: int, spp: int) -> None:
        traced(scene.build(mesh), support.spread(lights, 0.02), True, spp)

    bowl, sculpture = support.bowl(), shapes.load("sculpture:5")
    go(bowl, 20, 32)
    go(sculpture, 40, 32)
    assert support.compiled(lambda: (go(bowl, 70, 64), go(sculpture, 33, 16), go(shapes.load("blobby:2"), 64, 32))) == 0


@pytest.fixture(scope="module")
def heap() -> tuple:
    """Return a composition, and the vertices behind the camera's hits: position, normal and facet."""
    mesh = shapes.load("composition:15")
    built, surfaces = scene.build(mesh), support.packed("lambertian:0.9")
    found = paths.trace(built, View(), surfaces, support.spread(8, 0.02), size=64, spp=32, bounces=1, seed=3)
    return built, found.depths[1]


def test_cells_hold_vertices_that_are_close_and_face_one_way(heap):
    _, later = heap
    positions, facets = np.array(later.position), np.array(later.facet)
    order, (start, length) = cells(positions, facets)
    assert sorted(order) == [*range(later.count)] and length.sum() == later.count
    assert later.count / len(start) > 10  # enough of them to share
    for first, number in zip(start, length, strict=True):
        members = order[first : first + number]
        assert np.ptp(positions[:, members], axis=1).max() <= 0.0801
        assert (np.argmax(np.abs(facets[:, members]), axis=0) == np.abs(facets[:, members[0]]).argmax()).all()


@pytest.mark.parametrize("lights", [31, 64])
def test_groups_share_what_they_would_see(heap, lights):
    built, later = heap
    emitters = DistantLights(mi.Vector3f(*support.spread(lights, 0.02).T.astype(np.float32)))
    at = later.position, later.normal, later.facet, emitters, lights
    asked = bits(visibility(built, *at, coherent=False), later.count, lights)
    columns = [np.array(column) for column in at[:3]]
    shared = bits(group_visibility(built, *columns, emitters, lights), later.count, lights)
    faced = support.spread(lights, 0.02) @ np.array(later.normal) > 0
    wrong = (asked != shared) & faced
    assert 0.2 < asked[faced].mean() < 0.8  # much is in shadow
    assert 0 < wrong.sum() / faced.sum() < 0.02
    assert shared[faced].mean() == pytest.approx(asked[faced].mean(), abs=2e-3)  # light is missed as often as added
    free = bits(group_visibility(NoShadows(built.mesh), *columns, emitters, lights), later.count, lights)
    np.testing.assert_array_equal(free & faced, faced)


def test_sharing_in_groups_is_far_below_the_noise(monkeypatch):
    mesh, lights = shapes.load("composition:15"), support.spread(32, 0.02)
    built, surfaces = scene.build(mesh), support.packed("blue-acrylic")

    def rendered(seed: int) -> np.ndarray:
        options = {"size": 64, "spp": 32, "bounces": 3, "seed": seed}
        return dict(many_lights.render(built, View(), surfaces, lights, **options)[1])[0]

    shared, other = rendered(0), rendered(1)
    monkeypatch.setattr(paths, "group_visibility", asked_one_by_one)
    asked = rendered(0)
    assert 0 < abs(shared.mean(dtype=np.float64) / asked.mean(dtype=np.float64) - 1) < 2e-4
    np.testing.assert_allclose(shared.mean((1, 2, 3)), asked.mean((1, 2, 3)), rtol=1e-3)
    noise = np.sqrt(((other - shared) ** 2).mean() / 2)
    assert np.sqrt(((shared - asked) ** 2).mean()) < noise / 10


def asked_one_by_one(built, positions, normals, facets, emitters, lights):
    """Give what `group_visibility` gives, by a ray for every vertex and light."""
    at = (mi.Vector3f(*rows) for rows in (positions, normals, facets))
    return visibility(built, *at, emitters, lights, coherent=False)


def test_compositions_compile_nothing():
    def go(seed: int, lights: int, spp: int) -> None:
        mesh = shapes.load(f"composition:{seed}")
        surfaces = support.packed("lambertian:0.9")
        directions = support.spread(lights, 0.02)
        paths.trace(scene.build(mesh), View(), surfaces, directions, size=SIZE, spp=spp, bounces=3, seed=seed)

    go(0, 20, 32)
    go(1, 40, 32)
    assert support.compiled(lambda: (go(2, 70, 64), go(3, 33, 16))) == 0
