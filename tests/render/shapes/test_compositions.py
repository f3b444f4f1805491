"""Objects of compositions touch, do not pass through each other, and are numbered as rays find them."""

from dataclasses import replace

import numpy as np
import pytest
import render_support as support
import trimesh
from scipy.spatial import cKDTree

from render import shapes
from render.backend.jit import dr, mi
from render.kernel import many_lights, scene
from render.materials.kernels.packed import pack
from render.materials.kernels.patterns import part_labels
from render.materials.surfaces import Pattern
from render.planning import plan as planning
from render.planning.data_config import DataConfig
from render.records.manifest import SceneSpec, View
from render.records.shards import read_shard, write_shard
from render.running.rendered_view import trace_views
from render.shapes import compositions
from render.shapes.files.mesh_file import from_trimesh
from render.shapes.geometry.contact import CLEARANCE, free_path
from render.shapes.geometry.mesh import TriangleMesh, join
from render.shared.errors import InputError
from render.shared.seeds import generator

FIRST = {compositions.kind(seed): seed for seed in reversed(range(60))}
DOWN = np.array([0.0, -1, 0])


@pytest.fixture(scope="module")
def built():
    """The first composition of each kind."""
    return {kind: shapes.load(f"composition:{seed}") for kind, seed in FIRST.items()}


def objects(mesh: TriangleMesh) -> list[TriangleMesh]:
    """Return the objects of a composition as meshes of their own."""
    found = []
    for number in range(int(mesh.objects.max()) + 1):
        used, faces = np.unique(mesh.faces[mesh.objects == number], return_inverse=True)
        found.append(TriangleMesh(vertices=mesh.vertices[used], faces=faces.reshape(-1, 3), normals=mesh.normals[used]))
    return found


def inside(points: np.ndarray, solid: TriangleMesh) -> np.ndarray:
    """Tell which points (N, 3) lie in a closed mesh: most of three rays leave it through a face's back."""
    target, votes = scene.build(solid), np.zeros(len(points), int)
    for way in ((0.31, 0.83, 0.46), (-0.62, 0.41, 0.67), (0.23, -0.52, -0.82)):
        ray = mi.Ray3f(mi.Point3f(points.T), dr.normalize(mi.Vector3f(*way)))
        hit = target._scene.ray_intersect(ray)
        votes += np.array(hit.is_valid() & (dr.dot(hit.n, ray.d) > 0))
    return votes >= 2


def box(extents, turn=None, at=(0, 0, 0)) -> TriangleMesh:
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = np.eye(3) if turn is None else turn, at
    return from_trimesh(trimesh.creation.box(extents, matrix))


def test_spheres_meet_where_geometry_says():
    upper, lower = support.ball(0.5, (0.3, 3, 0.1)), support.ball(1.0, (0, 0, 0))
    expected = 3 - np.sqrt(1.5**2 - 0.1)
    assert free_path(upper, lower, DOWN) == pytest.approx(expected, abs=2e-4)  # facets lie within the spheres
    assert free_path(upper, lower, -DOWN) == np.inf
    assert free_path(upper, lower, DOWN, 0.25) == pytest.approx(0.25)
    assert free_path(support.ball(0.5, (1.6, 3, 0)), lower, DOWN) == np.inf


def test_edges_corners_and_faces_meet_exactly():
    cube = box((1, 1, 1))
    diagonal = compositions.sdf.rotation("z", 45)
    crossed = box((1, 1, 1), compositions.sdf.rotation("y", 90) @ diagonal, (0, 4, 0))  # an edge along x ...
    edge = box((1, 1, 1), diagonal)  # ... above one along z
    assert free_path(crossed, edge, DOWN) == pytest.approx(4 - np.sqrt(2) - CLEARANCE, abs=1e-6)
    assert free_path(box((1, 1, 1), at=(0.9, 4, 0.2)), cube, DOWN) == pytest.approx(3 - CLEARANCE, abs=1e-6)
    assert free_path(box((1, 1, 1), diagonal, (0, 4, 0)), cube, DOWN) == pytest.approx(
        3.5 - np.sqrt(0.5) - CLEARANCE, abs=1e-6
    )
    other = box((1, 1, 1), at=(1.5, 0.2, 0))
    assert free_path(other, cube, np.array([-1.0, 0, 0])) == pytest.approx(0.5 - CLEARANCE, abs=1e-6)
    assert free_path(other, cube, np.array([1.0, 0, 0])) == np.inf


def test_every_kind_is_drawn():
    assert set(FIRST) == set(compositions.KINDS)


@pytest.mark.parametrize("kind", list(compositions.KINDS))
def test_objects_touch_and_do_not_pass_through_each_other(built, kind):
    mesh = built[kind]
    parts = objects(mesh)
    assert np.linalg.norm(mesh.vertices, axis=1).max() == pytest.approx(1, abs=1e-6)
    assert all(trimesh.Trimesh(part.vertices, part.faces, process=False).is_watertight for part in parts)
    for number, part in enumerate(parts):
        others = [other for place, other in enumerate(parts) if place != number]
        assert not any(inside(part.vertices, other).any() for other in others)
        if others:
            nearest = min(cKDTree(other.vertices).query(part.vertices)[0].min() for other in others)
            assert nearest < 0.03  # less than an edge of a triangle
    if kind != "links":  # what fell rests on something, to the clearance, which scaling may have grown
        for number, part in enumerate(parts[1:], start=1):
            others = [other for place, other in enumerate(parts) if place != number]
            assert min(free_path(part, other, DOWN) for other in others) < CLEARANCE


def test_an_object_sunk_in_is_noticed(built):
    base, *_ = parts = objects(built["heap"])
    sunk = replace(parts[1], vertices=parts[1].vertices + np.array([0, -0.01, 0], np.float32))
    assert inside(sunk.vertices, base).any() or inside(base.vertices, sunk).any()


def test_links_hang_in_each_other(built):
    """A ring that could be pulled out in either direction would not be linked."""
    first, second, *_ = objects(built["links"])
    ways = [way / np.linalg.norm(way) for way in np.random.default_rng(0).normal(size=(8, 3))]
    assert max(free_path(second, first, way) for way in ways) < 2


def test_object_ids_are_what_rays_meet_first(built):
    mesh, size = built["heap"], 32
    view = View(rotation=tuple(compositions.sdf.rotation("yx", 20, 40).ravel()), scale=1.1)
    truth, _ = support.render(mesh, "lambertian:0.5", lights=support.unit([0, 0, 1]), view=view, size=size, spp=16)
    posed = [part.pose(view) for part in objects(mesh)]
    fine = 4 * size
    axis = (np.arange(fine) + 0.5) / fine * 2 - 1
    x, y = np.meshgrid(axis, -axis)
    origins = mi.Point3f(np.stack([x.ravel(), y.ravel(), np.full(x.size, 5.0)]))
    rays = mi.Ray3f(origins, mi.Vector3f(0, 0, -1))
    ways = []
    for part in posed:
        found = scene.build(part)._scene.ray_intersect(rays)
        ways.append(np.where(np.array(found.is_valid()), np.array(found.t), np.inf))
    number = np.where(np.isfinite(np.min(ways, axis=0)), np.argmin(ways, axis=0) + 1, 0).reshape(size, 4, size, 4)
    same = number.max((1, 3)) == number.min((1, 3))  # away from outlines, where samples differ
    assert same.mean() > 0.5 and len(np.unique(number)) > 3
    np.testing.assert_array_equal(truth.objects[same], number.max((1, 3))[same])
    np.testing.assert_array_equal(truth.objects > 0, truth.mask)


def test_materials_are_dealt_by_object(built):
    mesh = built["heap"]
    labels = part_labels(mesh, Pattern("parts", 3, 3))
    per_object = [np.unique(labels[mesh.objects == number]) for number in range(int(mesh.objects.max()) + 1)]
    assert all(len(found) == 1 for found in per_object)
    assert len(np.unique(np.concatenate(per_object))) == 3
    name = "parts:3:lambertian:0.9+lambertian:0.5+lambertian:0.1"
    _, images = many_lights.render(
        scene.build(mesh), View(), pack([name], mesh), support.unit([0, 0, 1]), size=16, spp=4, bounces=0, seed=0
    )
    assert next(images)[1].max() > 0


def test_passes_share_their_votes(built, monkeypatch):
    settings = {"lights": support.unit([0, 0, 1]), "size": 16, "spp": 16}
    whole, _ = support.render(built["links"], "lambertian:0.5", **settings)
    monkeypatch.setattr(many_lights, "SAMPLES_PER_PASS", 16 * 16 * 4)
    apart, _ = support.render(built["links"], "lambertian:0.5", **settings)
    assert (whole.objects == apart.objects).mean() > 0.95
    np.testing.assert_array_equal(apart.objects > 0, apart.mask)


def test_a_plan_gives_compositions_their_bounces_and_materials():
    config = DataConfig(families={"composition": 6, "blobby": 2}, bounces=1, size=16, composition_materials=(2, 3))
    scenes = planning.plan(config)
    composed = [spec for spec in scenes if spec.shape.startswith("composition:")]
    assert {spec.bounces for spec in composed} == {3}
    assert {spec.bounces for spec in scenes if spec not in composed} == {1}
    assert all(spec.material.startswith("parts:") for spec in composed)
    assert {spec.material.count("+") + 1 for spec in composed} == {2, 3}
    views = [planning.random_view(config, "composition", generator(seed, "view")) for seed in range(50)]
    up = np.array([view.matrix()[2] for view in views])  # the direction to the camera, in the scene's frame
    assert (up[:, 1] > 0.05).all() and (up[:, 2] > 0).all()


@pytest.mark.parametrize(
    ("change", "message"),
    [({"composition_bounces": 17}, "composition_bounces must be in 0..16"),
     ({"composition_materials": (3, 2)}, "composition_materials must be two rising numbers")],
)  # fmt: skip
def test_bad_settings_are_named(change, message):
    with pytest.raises(InputError, match=message):
        DataConfig(families={"composition": 1}, **change)


def test_the_shard_keeps_the_ids(built, tmp_path):
    for name, mesh in (("links", built["links"]), ("sphere", shapes.load("sphere"))):
        spec = SceneSpec(
            id=name, seed=1, split="train", shape=name, material="lambertian:0.5", view=View(),
            lights=((0.0, 0.0, 1.0),), size=16, spp=4, bounces=0,
        )  # fmt: skip
        (view,) = trace_views(scene.build(mesh), [spec], pack([spec.material]), [0])
        write_shard(tmp_path / f"{name}.exr", view.shard())
        found = read_shard(tmp_path / f"{name}.exr", spec).objects
        if name == "sphere":
            assert found is None
        else:
            np.testing.assert_array_equal(found, view.objects)
            assert found.max() >= 2


def test_joined_meshes_keep_their_faces():
    first, second = support.plane(), support.ball(0.5, (0, 0, 1))
    whole = join([first, second])
    np.testing.assert_array_equal(np.bincount(whole.objects), [len(first.faces), len(second.faces)])
    np.testing.assert_allclose(whole.vertices[whole.faces[2:]], second.vertices[second.faces])
