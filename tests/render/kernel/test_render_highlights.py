"""Highlights sampled from the lights' side: where the points lie, how many, and that nothing is counted twice."""

import numpy as np
import pytest
import render_support as support
from scipy import stats

from render import shapes
from render.backend.jit import dr, mi
from render.kernel import highlights, many_lights, scene
from render.kernel.camera import Camera
from render.kernel.emitters import DistantLights
from render.materials import library, model
from render.records.manifest import View

SIZE, SPP = 24, 64
LIGHTS = support.unit([0, 0, 1], [0.5, 0.2, 0.8], [-0.4, 0.7, 0.6], [0.9, -0.3, 0.2])
VIEW = View(rotation=(0, 0, 1, 0, 1, 0, -1, 0, 0), scale=0.9, offset=(0.05, -0.02))


class Recorder:
    """Surfaces that remember the points they were asked about."""

    def weights(self, position, prim) -> tuple:
        self.position, self.prim = np.array(position).T.astype(np.float64), np.array(prim)
        return (None,)


def found(mesh, lights=LIGHTS, view: View = VIEW, seed: int = 0) -> tuple:
    """Return the points of a mesh, and where they lie."""
    camera, points = Camera.of(view, SIZE), Recorder()
    directions = camera.to_object(*(mi.Float(np.ascontiguousarray(row)) for row in lights.T))
    dr.eval(directions)
    emitters = DistantLights(directions)
    halves = highlights.half_vectors(camera, emitters, parallel=True)
    return highlights.find(scene.build(mesh), camera, emitters, halves, len(lights), points, SPP, seed, 0), points


def halves(lights=LIGHTS, view: View = VIEW) -> np.ndarray:
    """Return (L, 3) half vectors in the object frame."""
    half = lights + np.array([0, 0, 1])
    return half / np.linalg.norm(half, axis=1, keepdims=True) @ view.matrix()


NORMALS = highlights.normals(SPP)


def heights(values: np.ndarray) -> np.ndarray:
    return np.array(highlights.density(mi.Float(values.astype(np.float32))), np.float64)


def test_density_is_a_density():
    s = np.concatenate([[0.0], np.geomspace(1e-12, highlights._RIM, 20000)])
    middle = (s[1:] + s[:-1]) / 2
    integral = 2 * np.pi * (heights(middle) * np.diff(s)).sum()
    assert integral == pytest.approx(1, rel=1e-4)
    assert not heights(np.array([highlights._RIM * 1.01, 0.5, 2.0])).any()
    assert (np.diff(heights(s[:-1])) <= 0).all()


def test_numbers_of_normals_count_the_density():
    """`_share` inverts the mapping that normals are drawn by, and is the distribution of `density`."""
    u = np.linspace(0, 1, 300)
    s = highlights._CORE * ((1 - u * highlights._TAIL) ** -2 - 1)
    number = NORMALS * np.array(highlights._share(mi.Float(s.astype(np.float32))))
    np.testing.assert_allclose(number, u * NORMALS, atol=0.01)
    fine = np.linspace(0, s[150], 20001)
    below = 2 * np.pi * heights((fine[1:] + fine[:-1]) / 2).sum() * (fine[1] - fine[0])
    assert below == pytest.approx(number[150] / NORMALS, rel=1e-3)


def test_points_lie_on_the_mesh_where_the_normal_is_the_one_drawn():
    mesh = shapes.load("blobby:3")
    glints, points = found(mesh)
    normal, light = np.array(glints.normal).T.astype(np.float64), np.array(glints.light)
    assert len(normal) > 500 and set(light) == set(range(len(LIGHTS)))
    away = np.arccos(np.clip((normal * halves()[light]).sum(1), -1, 1))
    assert away.max() < np.radians(4.05) and np.median(away) < np.radians(0.5)
    corner = mesh.vertices[mesh.faces[points.prim]].astype(np.float64)
    e1, e2, moved = corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0], points.position - corner[:, 0]
    gram = np.stack([np.stack([(a * b).sum(1) for b in (e1, e2)], 1) for a in (e1, e2)], 1)
    b = np.linalg.solve(gram, np.stack([(e1 * moved).sum(1), (e2 * moved).sum(1)], 1)[..., None])[..., 0]
    assert b.min() > -1e-3 and b.sum(1).max() < 1 + 1e-3
    assert np.abs(b[:, :1] * e1 + b[:, 1:] * e2 - moved).max() < 1e-5  # in the triangle's plane
    corners = mesh.normals[mesh.faces[points.prim]].astype(np.float64)
    shading = corners[:, 0] + b[:, :1] * (corners[:, 1] - corners[:, 0]) + b[:, 1:] * (corners[:, 2] - corners[:, 0])
    shading /= np.linalg.norm(shading, axis=1, keepdims=True)
    assert np.degrees(np.linalg.norm(shading - normal, axis=1)).max() < 0.05


def test_points_are_seen_by_camera_and_light_in_the_pixel_they_count_for():
    mesh = shapes.load("sculpture:5")
    built = scene.build(mesh)
    glints, points = found(mesh)
    matrix, light = VIEW.matrix(), np.array(glints.light)
    moved = points.position @ matrix.T * VIEW.scale + np.array([*VIEW.offset, 0])
    column, row = ((moved[:, 0] + 1) / 2 * SIZE).astype(int), ((1 - moved[:, 1]) / 2 * SIZE).astype(int)
    expected = (light * SIZE + row) * SIZE + column
    assert (glints.target == expected).mean() > 0.995 and glints.target.max() < len(LIGHTS) * SIZE**2  # rounding
    normal = np.array(glints.normal).T
    for towards in (np.broadcast_to(matrix[2], normal.shape), LIGHTS[light] @ matrix):
        assert ((normal * towards).sum(1) > 0).all()
        origin = (points.position + 2e-3 * normal).astype(np.float32)
        ray = mi.Ray3f(mi.Point3f(np.ascontiguousarray(origin.T)), mi.Vector3f(np.ascontiguousarray(towards.T)))
        assert np.array(built.ray_test(ray, False)).mean() < 0.03


def test_as_many_points_as_were_drawn_where_nothing_hides_them():
    """A sphere has every normal once."""
    glints, _ = found(shapes.load("sphere"), view=View(scale=0.9))
    light = np.array(glints.light)
    counts = np.bincount(light, minlength=len(LIGHTS))
    assert abs(counts - NORMALS).max() < 0.15 * NORMALS
    normal = np.array(glints.normal).T.astype(np.float64)
    s = 1 - (normal * halves(view=View())[light]).sum(1)
    share = np.array(highlights._share(mi.Float(s.astype(np.float32))))
    near = share > 0.1  # of smaller ones float32 normals do not tell the angle
    assert stats.kstest((share[near] - 0.1) / 0.9, "uniform").pvalue > 1e-3
    azimuth = np.cross(normal, halves(view=View())[light])
    assert np.abs(azimuth[near].mean(0)).max() < 3 * np.abs(azimuth[near]).std() / np.sqrt(near.sum())


def test_weights_are_shares_of_a_camera_sample():
    glints, _ = found(shapes.load("sphere"))
    factor = np.array(glints.factor)
    assert factor.min() > 0 and factor.max() <= 1
    spread, s = mi.Float([0.0, 1.0, 10.0]), mi.Float([0.0, 1e-5, 1e-4])
    weight = np.array(highlights.partition(spread, s, SIZE, SPP), np.float64)
    area = (2 / SIZE) ** 2  # of a pixel
    density = NORMALS * np.array(highlights.density(s), np.float64) * np.array(spread)  # over image area
    np.testing.assert_allclose(weight, SPP / (SPP + area * density), rtol=1e-5)


def test_seeds_draw_other_points():
    mesh = shapes.load("sphere")
    first, again, other = (np.array(found(mesh, seed=seed)[0].normal) for seed in (1, 1, 2))
    assert first.tobytes() == again.tobytes()
    assert first.shape != other.shape or (first != other).mean() > 0.9


@pytest.mark.parametrize(("shape", "view"), [("sphere", View(scale=0.9)), ("bowl", View(scale=0.95))])
def test_highlights_are_counted_once(shape, view):
    """With and without the points, chrome has the same expectation, but by no means the same noise."""
    built = scene.build(support.bowl() if shape == "bowl" else shapes.load(shape))
    lights = LIGHTS[:3]

    def means(glossy: bool, spp: int, seeds: range) -> np.ndarray:
        surfaces = support.packed("chrome")
        assert surfaces.glossy == (True,)
        surfaces.glossy = (glossy,)
        rendered = []
        for seed in seeds:
            _, images = many_lights.render(built, view, surfaces, lights, size=8, spp=spp, bounces=0, seed=seed)
            rendered.append(next(images)[1].mean((1, 2, 3), dtype=np.float64))
        return np.stack(rendered)

    plain, sampled = means(False, 4096, range(12)), means(True, 256, range(12, 24))
    p = stats.ttest_ind(plain, sampled, equal_var=False).pvalue
    assert (p > 1e-3).all()
    assert sampled.var(0).sum() * 256 < 0.5 * plain.var(0).sum() * 4096


def test_a_flat_mesh_has_no_such_points_and_the_right_image():
    mesh, view, lights = support.plane(), View(scale=1.2), support.unit([0.3, 0.2, 0.93], [0.001, 0, 1])
    assert found(mesh, lights=lights, view=view)[0] is None
    _, images = support.render(mesh, "chrome", lights=lights, view=view, size=16)
    towards = np.tile([0.0, 0.0, 1.0], (2, 1))
    expected = np.pi * model.evaluate(library.load("chrome"), towards, lights.astype(np.float64)) * lights[:, 2:]
    np.testing.assert_allclose(images[0], np.broadcast_to(expected[:, None, None], images[0].shape), rtol=2e-3)


def test_same_bytes_with_one_thread_and_two():
    threads, results = dr.thread_count(), []
    try:
        for count in (1, 2, 2):
            dr.set_thread_count(count)
            _, images = support.render(
                support.bowl(), "chrome", "stripes:1:nickel+pink-felt", lights=LIGHTS, bounces=1, size=16, spp=8
            )
            results.append([image.tobytes() for image in images.values()])
    finally:
        dr.set_thread_count(threads)
    assert results[0] == results[1] == results[2]


def test_an_object_outside_the_frame_gives_none():
    assert found(shapes.load("sphere"), view=View(scale=0.1, offset=(4.0, 0.0)))[0] is None
