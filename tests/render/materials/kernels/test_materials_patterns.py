"""Patterns of spatially-varying surfaces: partitions of unity, seeded, attached to the object, and named clearly."""

import numpy as np
import pytest
import render_support as support

from render import shapes
from render.backend.jit import dr, mi
from render.materials import surfaces
from render.materials.kernels import patterns
from render.materials.kernels.patterns import Evaluator, part_labels
from render.materials.surfaces import PATTERNS, Pattern
from render.records.manifest import View
from render.shared.errors import InputError

BALLS = support.joined(support.ball(0.3, (-0.5, 0, 0)), support.ball(0.25, (0.5, 0, 0)), support.ball(0.2, (0, 0.7, 0)))


def weights(pattern: Pattern, points: np.ndarray, mesh=BALLS, triangles: np.ndarray | None = None) -> np.ndarray:
    """Return the (N, M) weights at (N, 3) points, by default on triangles spread over the mesh."""
    if triangles is None:
        triangles = np.arange(len(points)) * 7919 % len(mesh.faces)
    columns = (mi.Float(np.ascontiguousarray(column, np.float32)) for column in points.T)
    found = Evaluator(pattern, mesh).weights(mi.Point3f(*columns), mi.UInt32(triangles.astype(np.uint32)))
    return np.stack([np.array(weight) for weight in found], axis=1)


def in_the_unit_sphere(count: int = 4000) -> np.ndarray:
    rng = np.random.default_rng(3)
    points = rng.normal(size=(count, 3))
    return points / np.linalg.norm(points, axis=1, keepdims=True) * rng.uniform(size=(count, 1)) ** (1 / 3)


def line(seed: int, count: int = 20000) -> np.ndarray:
    """Return points along a diameter of the unit sphere, closely spaced."""
    direction = np.random.default_rng(seed).normal(size=3)
    return np.linspace(-1, 1, count)[:, None] * direction / np.linalg.norm(direction)


@pytest.mark.parametrize("count", [2, 3, 4])
@pytest.mark.parametrize("kind", PATTERNS)
def test_weights_are_shares_that_sum_to_one(kind, count):
    points = in_the_unit_sphere()
    for seed in (0, 1, 2):
        value = weights(Pattern(kind, seed, count), points)
        assert value.shape == (len(points), count) and value.min() >= 0 and value.max() <= 1
        np.testing.assert_allclose(value.sum(1), 1, atol=1e-6)
        assert (value.max(0) > 0.5).all() and (value.mean(0) > 0.01).all()  # every material is seen


@pytest.mark.parametrize("kind", PATTERNS)
def test_the_seed_decides_and_nothing_else(kind):
    points = in_the_unit_sphere()
    first, again = (weights(Pattern(kind, 0, 3), points) for _ in range(2))
    np.testing.assert_array_equal(first, again)
    part = weights(Pattern(kind, 0, 3), points[100:200], triangles=np.arange(100, 200) * 7919 % len(BALLS.faces))
    np.testing.assert_allclose(part, first[100:200], atol=1e-6)  # a point's weights do not depend on its company
    assert any(np.abs(weights(Pattern(kind, seed, 3), points) - first).max() > 0.5 for seed in (1, 2, 3))


@pytest.mark.parametrize("kind", ["patches", "stripes", "parts"])
def test_sharp_patterns_have_one_material_at_a_point(kind):
    value = weights(Pattern(kind, 5, 4), in_the_unit_sphere())
    assert set(np.unique(value)) == {0, 1}


@pytest.mark.parametrize("kind", ["noise", "gradient"])
def test_smooth_patterns_have_no_edges(kind):
    for seed in range(4):
        value = weights(Pattern(kind, seed, 3), line(seed))
        assert np.abs(np.diff(value, axis=0)).max() < 0.02


@pytest.mark.parametrize("count", [2, 3, 4])
def test_stripes_follow_each_other_in_order_over_and_over(count):
    repeats = []
    for seed in range(6):
        label = weights(Pattern("stripes", seed, count), line(seed)).argmax(1)
        steps = np.diff(label)
        assert set(np.unique(steps[steps != 0] % count)) <= {1, count - 1}  # only neighbours meet
        repeats.append(np.count_nonzero(steps))
    assert max(repeats) > count  # more than one period


def test_a_gradient_runs_from_the_first_material_to_the_last():
    for seed in range(4):
        points = line(seed)
        value = weights(Pattern("gradient", seed, 4), points)
        place = value @ np.arange(4)
        steps = np.diff(place)
        assert (steps >= -1e-5).all() or (steps <= 1e-5).all()
        assert ((value > 1e-6).sum(1) <= 2).all()  # neighbours alone are mixed


def test_parts_follow_the_pieces_of_a_mesh():
    pieces = np.repeat([0, 1, 2], len(BALLS.faces) // 3)
    for count in (2, 3):
        label = part_labels(BALLS, Pattern("parts", 0, count))
        assert label.shape == (len(BALLS.faces),) and label.dtype == np.uint32
        own = [np.unique(label[pieces == piece]) for piece in range(3)]
        assert all(len(names) == 1 for names in own)
        assert {int(names[0]) for names in own} == set(range(count))
    assert len({tuple(part_labels(BALLS, Pattern("parts", seed, 3))[:: len(pieces) // 3]) for seed in range(12)}) > 1


def test_split_vertices_still_join_their_pieces():
    """Meshes with hard edges have each corner more than once."""
    mesh = BALLS.faces
    apart = patterns.TriangleMesh(
        vertices=BALLS.vertices[mesh].reshape(-1, 3), normals=BALLS.normals[mesh].reshape(-1, 3),
        faces=np.arange(mesh.size).reshape(-1, 3),
    )  # fmt: skip
    pattern = Pattern("parts", 4, 3)
    np.testing.assert_array_equal(part_labels(apart, pattern), part_labels(BALLS, pattern))


@pytest.mark.parametrize("count", [2, 3, 4])
def test_parts_of_one_piece_are_large_regions(count):
    mesh = shapes.load("sphere")
    for seed in range(3):
        label = part_labels(mesh, Pattern("parts", seed, count))
        share = np.bincount(label, minlength=count) / len(label)
        assert (share > 0.3 / count).all()
        shared = np.sort(mesh.faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2).astype(np.int64), axis=1)
        edge = shared[:, 0] * len(mesh.vertices) + shared[:, 1]
        order = np.argsort(edge, kind="stable")
        both = np.flatnonzero(np.diff(edge[order]) == 0)
        owner = np.repeat(label, 3)[order]
        assert (owner[both] != owner[both + 1]).mean() < 0.05  # few edges lie between two materials


def test_parts_need_a_mesh():
    with pytest.raises(InputError, match="needs the mesh"):
        Evaluator(Pattern("parts", 0, 2))


def truth_weights(mesh, view: View) -> np.ndarray:
    name = "noise:2:lambertian:0.9+lambertian:0.2"
    truth, _ = support.render(mesh, name, lights=support.unit([0, 0, 1]), view=view, size=32, spp=64)
    assert truth.mask.any()
    return truth.weights[0]


def test_the_pattern_turns_and_grows_with_the_object():
    mesh = shapes.load("sphere")
    straight = truth_weights(mesh, View(scale=0.5))
    turned = truth_weights(mesh, View(scale=0.5, rotation=(0, -1, 0, 1, 0, 0, 0, 0, 1)))  # a quarter, anti-clockwise
    np.testing.assert_allclose(turned, np.rot90(straight, axes=(1, 2)), atol=0.1)
    moved = truth_weights(mesh, View(scale=0.5, offset=(0.25, 0.25)))
    np.testing.assert_allclose(moved[:, 4:20, 12:28], straight[:, 8:24, 8:24], atol=0.1)
    larger = truth_weights(mesh, View(scale=1.0))
    halved = larger.reshape(2, 16, 2, 16, 2).mean((2, 4))
    np.testing.assert_allclose(halved[:, 4:12, 4:12], straight[:, 8:24, 8:24][:, 4:12, 4:12], atol=0.1)
    behind = truth_weights(mesh, View(scale=0.5, rotation=(-1, 0, 0, 0, 1, 0, 0, 0, -1)))
    assert np.abs(behind - straight).max() > 0.3


def test_another_seed_or_mesh_compiles_nothing():
    # As the renderer gathers them: Dr.Jit compiles plain loads by the alignment of NumPy's memory.
    uploaded, lane = mi.Float(in_the_unit_sphere(1000).ravel()), dr.arange(mi.UInt32, 1000)
    points = mi.Point3f(*(dr.gather(mi.Float, uploaded, 3 * lane + axis) for axis in range(3)))
    dr.eval(points)
    other = support.joined(support.ball(0.4, (-0.5, 0, 0)), support.ball(0.3, (0.5, 0, 0)))

    def go(seed: int, mesh) -> None:
        for kind in PATTERNS:
            Evaluator(Pattern(kind, seed, 2), mesh).weights(points, lane)

    go(0, BALLS)
    assert support.compiled(lambda: [go(seed, mesh) for seed, mesh in ((1, BALLS), (2, other), (3, other))]) == 0


# ---- Names ------------------------------------------------------------------------------------------


def test_a_name_gives_components_and_pattern():
    surface = surfaces.load("stripes:7:chrome+lambertian:0.8/0.3/0.1 + blue-fabric")
    assert surface.pattern == Pattern("stripes", 7, 3)
    assert [material.name for material in surface.components] == ["chrome", "lambertian:0.8/0.3/0.1", "blue-fabric"]
    plain = surfaces.load("lambertian:0.5")
    assert plain.pattern is None and [material.name for material in plain.components] == ["lambertian:0.5"]


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("stipes:7:chrome+nylon", "did you mean 'stripes'"),
        ("stripes:x:chrome+nylon", "expected stripes:<seed>:<material>"),
        ("stripes:-1:chrome+nylon", "expected stripes:<seed>:<material>"),
        ("stripes:²:chrome+nylon", "expected stripes:<seed>:<material>"),
        ("stripes:7", "expected stripes:<seed>:<material>"),
        ("stripes", "expected stripes:<seed>:<material>"),
        ("noise:7:chrome", "2 to 8 materials"),
        ("noise:7:chrome+", "2 to 8 materials"),
        ("noise:7:", "2 to 8 materials"),
        ("noise:7:" + "+".join(["chrome"] * 9), "2 to 8 materials"),
        ("noise:7:chrme+nylon", "did you mean 'chrome'"),
        ("noise:7:chrome+absent.binary", "absent.binary"),
        ("noise:7:lambertian:2+nylon", "albedo"),
        ("parts:7:stripes:1:chrome+nylon", "stripes"),
    ],
)
def test_a_wrong_name_is_one_line(name, message):
    with pytest.raises(InputError, match=message) as caught:
        surfaces.load(name)
    assert "\n" not in str(caught.value)
