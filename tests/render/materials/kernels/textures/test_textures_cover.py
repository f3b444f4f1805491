"""Procedural materials: seeded, bounded, with a relief whose normals are those of the height's exact slope."""

import numpy as np
import pytest
import render_support as support

from render import shapes
from render.backend.jit import dr, mi
from render.materials import library, surfaces
from render.materials.kernels.packed import pack
from render.materials.kernels.textures import cover
from render.materials.kernels.textures.cover import Cover, Place
from render.materials.textures import textured
from render.materials.textures.textured import KINDS
from render.records.manifest import View
from render.shared.errors import InputError

COUNT = 3000
VIEWER = np.array([0.0, 0.0, 1.0])


def points() -> np.ndarray:
    """Return points of the unit sphere, (N, 3), which are their normals."""
    return support.spread(COUNT).astype(np.float64)


def vectors(array: np.ndarray) -> "mi.Vector3f":
    return mi.Vector3f(*(mi.Float(np.ascontiguousarray(column, np.float32)) for column in array.T))


def place(position: np.ndarray, normal: np.ndarray | None = None) -> Place:
    normal = position if normal is None else normal
    return Place(vectors(position), vectors(normal), dr.zeros(mi.UInt32, len(position)), mi.Point2f(0))


@pytest.mark.parametrize("kind", KINDS)
def test_the_slope_is_the_derivative_of_the_height(kind):
    """Differences of the height along the axes, but where the pattern has an edge between them."""
    texture, at, step = Cover(kind, 3), points(), 2e-4
    slope = np.array(texture.slope(place(at)), np.float64).T
    heights = [[np.array(texture.height(place(at + sign * step * axis, at)), np.float64) for sign in (1, -1)]
               for axis in np.eye(3)]  # fmt: skip
    differences = np.stack([(above - below) / (2 * step) for above, below in heights], 1)
    wrong = np.linalg.norm(differences - slope, axis=1)
    assert np.median(wrong) < 2e-3 and np.percentile(wrong, 90) < 0.02
    size = np.linalg.norm(slope, axis=1)
    assert 0.02 < np.sqrt((size**2).mean()) < 0.6  # there is a relief, and it is no wall


def test_normals_are_turned_against_the_slope():
    """Of a height a.x over a plane, the normal is that of the tilted plane."""
    slope, normal = np.array([[0.3, -0.2, 5.0]]), np.array([[0.0, 0.0, 1.0]])
    found = np.array(cover.turn(vectors(normal), vectors(slope), vectors(VIEWER[None])))[:, 0]
    np.testing.assert_allclose(found, np.array([-0.3, 0.2, 1]) / np.linalg.norm([0.3, 0.2, 1]), atol=1e-6)


def test_no_facet_that_is_seen_faces_away():
    at = points()
    rng = np.random.default_rng(0)
    normal = np.array(cover.turn(vectors(at), vectors(rng.normal(size=at.shape) * 3), vectors(VIEWER[None]))).T
    seen = at[:, 2] > 0
    assert (normal[seen, 2] > 0).all()
    np.testing.assert_allclose(normal[~seen], at[~seen], atol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(normal, axis=1), 1, atol=1e-5)


@pytest.mark.parametrize("kind", ["wood", "weave"])
def test_the_ground_truth_has_the_normals_of_the_relief(kind):
    """A plane facing the camera: the truth is the mean over a pixel of (-dh/dx, -dh/dy, 1), normalised."""
    name, size, fine = f"procedural:{kind}:5", 48, 12
    truth, _ = support.render(support.plane(), name, lights=support.unit([0, 0, 1]), view=View(scale=1.0), size=size,
                              spp=64)  # fmt: skip
    axis = (np.arange(size * fine) + 0.5) / (size * fine) * 2 - 1
    x, y = (grid.ravel() for grid in np.meshgrid(axis, -axis))
    at = np.stack([x, y, np.zeros_like(x)], 1)
    slope = np.array(Cover(kind, 5).slope(place(at, np.tile(VIEWER, (len(at), 1)))), np.float64).T
    normal = np.stack([-slope[:, 0], -slope[:, 1], np.ones_like(x)], 1)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    expected = normal.reshape(size, fine, size, fine, 3).mean((1, 3))
    expected /= np.linalg.norm(expected, axis=-1, keepdims=True)
    angle = np.degrees(np.arccos(np.clip((truth.normals_of(0) * expected).sum(-1), -1, 1)))
    tilt = np.degrees(np.arccos(expected[..., 2]))
    assert tilt.mean() > 1 and np.median(angle) < 0.15 * np.median(tilt) + 0.1
    np.testing.assert_allclose(truth.normals[..., 2], 1, atol=1e-6)  # the geometry stays


@pytest.mark.parametrize("kind", KINDS)
def test_the_seed_decides_and_values_stay_in_range(kind):
    at, wi = place(points()), vectors(VIEWER[None])
    found = []
    for seed in (0, 0, 1):
        values, normal = Cover(kind, seed).at(at, wi)
        found.append(np.stack([*(np.broadcast_to(np.array(value), COUNT) for value in values), *np.array(normal)]))
    np.testing.assert_array_equal(found[0], found[1])
    assert np.abs(found[0] - found[2]).max() > 0.05
    assert np.isfinite(found[0]).all() and found[0][3:6].min() >= 0.03 and found[0][3:6].max() <= 1
    assert (textured.palette(kind, 0) >= 0).all() and (textured.palette(kind, 0) <= 1).all()


@pytest.mark.parametrize("count", [1, 2, 3])
def test_materials_fill_the_regions(count):
    names = "+".join(("chrome", "pink-felt", "lambertian:0.5")[:count])
    surface = pack([f"procedural:rust:4:{names}"])
    weights, normals = surface.at(place(points()), vectors(VIEWER[None]))
    assert normals[0] is not None and surface.glossy == (False,)
    if count == 1:
        assert weights == (None,)
        return
    shares = np.stack([np.array(weight) for weight in weights[0]])
    np.testing.assert_allclose(shares.sum(0), 1, atol=1e-5)
    assert shares.min() >= 0 and (shares.max(1) > 0.5).all()


def test_no_kernel_is_compiled_for_another_seed():
    def go(names: tuple, seed: int, shape: str) -> None:
        lights = support.unit([0, 0, 1], [1, 0, 1], [0, 1, 2])
        support.render(shapes.load(shape), *names, lights=lights, size=24, spp=4, bounces=2, seed=seed)

    kinds = tuple(f"procedural:{kind}:{{}}" for kind in ("wood", "tiles", "print"))
    pairs = [(*(kind.format(seed) for kind in kinds), f"procedural:weave:{seed}:chrome+brass") for seed in (1, 2, 3)]
    go(pairs[0], 0, "sphere")
    go(pairs[1], 1, "sculpture:1")
    assert support.compiled(lambda: go(pairs[2], 2, "blobby:1")) == 0


def test_light_is_conserved_over_a_furnace():
    """A rough white texture under light from everywhere: no pixel of a convex object reflects more than it receives."""
    lights = support.spread(400)
    truth, images = support.render(
        shapes.load("sphere"), "procedural:marble:3", lights=lights, size=16, spp=64, bounces=2
    )
    radiance = images[0].astype(np.float64).sum(0) * (4 * np.pi / len(lights)) / np.pi
    assert radiance[truth.mask].max() < 1.05


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("procedural:wod:1", "did you mean.*wood"),
        ("procedural:wood:x", "procedural:wood:<seed>"),
        ("procedural:wood", "add a seed"),
        ("procedural", "add a seed"),
        ("procedural:wood:1:a+b+c+d", "1 to 3 materials"),
        ("procedural:wood:1:procedural:rust:2", "is textured itself"),
        ("stripes:1:procedural:wood:1+chrome", "covers an object alone"),
        ("maps:x:folder", "maps:<repeats>:<folder>"),
        ("maps:2:no-such-folder", "no such folder of maps"),
    ],
)
def test_bad_names_end_in_a_line_that_says_what_to_do(name, message):
    with pytest.raises(InputError, match=message):
        surfaces.load(name)


def test_names():
    assert library.load("procedural:wood:7").category == "procedural-wood"
    kinds = {library.load(f"procedural:{seed}").kind for seed in range(60)}
    assert kinds == set(KINDS)  # a seed alone draws the kind
    pattern, names = surfaces.split_name("procedural:tiles:7:chrome+brass")
    assert pattern.texture == "tiles" and pattern.seed == 7 and names == ("chrome", "brass")
    assert textured.without_seed("procedural:wood:7") == "procedural:wood"
    assert textured.without_seed("chrome") == "chrome"
    rng = np.random.default_rng(0)
    assert textured.complete("chrome", rng) == "chrome"
    surfaces.load(textured.complete("procedural:rust", rng))
    surfaces.load(textured.complete("procedural", rng))
