"""Edges of meshes from files: sharp where the surface turns sharply, round where it is a coarse curve."""

import numpy as np
import pytest
import trimesh

import render
from render.shapes import primitives
from render.shapes.files.mesh_file import from_trimesh, load_mesh
from render.shapes.geometry import creases


def degrees(one, other):
    return np.degrees(np.arccos(np.clip((one * other).sum(-1), -1, 1)))


def flat(mesh):
    """Return the normals of the triangles (F, 3)."""
    corners = mesh.vertices[mesh.faces].astype(float)
    return trimesh.unitize(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]))


def errors_of_a_cylinder(mesh):
    """Return the largest angles between normals and those of a true cylinder about z: on its ends, on its wall."""
    ends = np.abs(flat(mesh)[:, 2]) > 0.9
    normals, points = mesh.normals[mesh.faces], mesh.vertices[mesh.faces] * [1.0, 1, 0]
    wall = trimesh.unitize(points[~ends].reshape(-1, 3)).reshape(-1, 3, 3)
    return degrees(normals[ends], flat(mesh)[ends, None]).max(), degrees(normals[~ends], wall).max()


@pytest.mark.parametrize("sections", [10, 12, 24, 64])
def test_a_cylinder_has_sharp_rims_and_a_round_wall(sections):
    mesh = from_trimesh(trimesh.creation.cylinder(1, 2, sections=sections))
    assert max(errors_of_a_cylinder(mesh)) < 0.1


@pytest.mark.parametrize("sections", [4, 6, 8])
def test_prisms_and_chamfers_stay_flat(sections):
    mesh = from_trimesh(trimesh.creation.cylinder(1, 2, sections=sections))
    assert degrees(mesh.normals[mesh.faces], flat(mesh)[:, None]).max() < 0.1


@pytest.mark.parametrize(
    "ball", [trimesh.creation.icosphere(subdivisions=1), trimesh.creation.icosphere(subdivisions=3),
             trimesh.creation.uv_sphere(count=[7, 12])]
)  # fmt: skip
def test_coarse_spheres_stay_round(ball):
    mesh = from_trimesh(ball)
    assert len(mesh.vertices) == len(ball.vertices)
    assert degrees(mesh.normals, trimesh.unitize(mesh.vertices)).max() < 2


def test_a_cone_is_round_up_to_its_tip():
    """At the tip the triangles share a vertex, not a normal: the mean of all would point along the axis."""
    mesh = from_trimesh(trimesh.creation.cone(1, 2, sections=24))
    side = np.abs(flat(mesh)[:, 2]) < 0.9
    assert degrees(mesh.normals[mesh.faces][side], flat(mesh)[side, None]).max() < 360 / 24 / 2 + 0.1
    assert degrees(mesh.normals[mesh.faces][~side], flat(mesh)[~side, None]).max() < 0.1


def test_the_bunny_as_a_file_stays_smooth_and_the_bunny_by_name_as_it_was():
    named, read = primitives.bunny(), load_mesh(primitives.bunny_file())
    assert len(named.vertices) == 50_000
    assert len(read.vertices) < 50_050 and len(read.faces) == len(named.faces)


def test_specks_of_noise_are_no_creases():
    """A single bump of a scan, and the edge of a fold."""
    grid = np.array([(x, y, 0.0) for y in range(201) for x in range(201)]) / 200
    corner = np.array([k for k in range(200 * 201) if k % 201 != 200])
    faces = np.concatenate(
        [np.stack([corner, corner + 1, corner + 202], 1), np.stack([corner, corner + 202, corner + 201], 1)]
    )
    bumpy = grid.copy()
    bumpy[100 * 201 + 100, 2] = 0.004  # slopes of 39 degrees up and down: six edges turn by more than 40, two by less
    assert len(from_trimesh(trimesh.Trimesh(bumpy, faces, process=False)).vertices) <= len(grid) + 6
    folded = grid.copy()
    folded[:, 2] = np.maximum(grid[:, 0] - 0.5, 0) * 2
    assert len(from_trimesh(trimesh.Trimesh(folded, faces, process=False)).vertices) == len(grid) + 201


def test_two_sheets_that_cross_keep_their_normals_at_the_common_edge():
    points = np.array([[-1, 0, 0], [1, 0, 0], [0, 0, 1], [0, 0, -1], [0, -1, 0], [0, 1, 0]], float)
    faces = [[4, 5, 0], [5, 4, 1], [4, 5, 2], [5, 4, 3]]
    mesh = from_trimesh(trimesh.Trimesh(points, faces, process=False))
    assert degrees(mesh.normals[mesh.faces], flat(mesh)[:, None]).max() < 0.1


@pytest.mark.parametrize("suffix", ["ply", "obj", "glb"])
def test_normals_of_a_file_are_used(tmp_path, suffix):
    """Those of a true sphere on a coarse one, whose own would be a few degrees off; also placed by a node."""
    ball = trimesh.creation.icosphere(subdivisions=1)
    points = ball.vertices * [1, 1.2, 1.5]  # an ellipsoid
    exact = trimesh.unitize(points / np.array([1, 1.2, 1.5]) ** 2)
    made = trimesh.Trimesh(points, ball.faces, vertex_normals=exact, process=False)
    turn = trimesh.transformations.rotation_matrix(0.7, [1, 2, 3])
    scene = trimesh.Scene()
    scene.add_geometry(made, transform=turn if suffix == "glb" else np.eye(4))
    (scene if suffix == "glb" else made).export(tmp_path / f"a.{suffix}")
    mesh = load_mesh(tmp_path / f"a.{suffix}")
    expected = exact @ turn[:3, :3].T if suffix == "glb" else exact
    place = trimesh.transform_points(points, turn if suffix == "glb" else np.eye(4))
    nearest = np.linalg.norm(mesh.vertices[:, None] - place, axis=2).argmin(1)
    assert degrees(mesh.normals, expected[nearest]).max() < 0.1
    computed = from_trimesh(trimesh.Trimesh(points, ball.faces, process=False))
    assert degrees(computed.normals, trimesh.unitize(computed.vertices / np.array([1, 1.2, 1.5]) ** 2)).max() > 0.8


def test_a_file_with_normals_may_be_rounder_or_flatter_than_our_angle(tmp_path):
    """An eight-sided cylinder whose file says it is round, and a fine one whose file says it has facets."""
    for sections, round_ in ((8, True), (24, False)):
        made = trimesh.creation.cylinder(1, 2, sections=sections)
        corners, face = made.vertices[made.faces], np.repeat(made.face_normals[:, None], 3, 1)
        radial = trimesh.unitize((corners * [1, 1, 0]).reshape(-1, 3)).reshape(-1, 3, 3)
        given = np.where(round_ & (np.abs(face[..., 2:]) < 0.9), radial, face)
        soup = trimesh.Trimesh(corners.reshape(-1, 3), np.arange(3 * len(corners)).reshape(-1, 3),
                               vertex_normals=given.reshape(-1, 3), process=False)  # fmt: skip
        soup.export(tmp_path / "a.ply")
        mesh = load_mesh(tmp_path / "a.ply")
        assert errors_of_a_cylinder(mesh)[0] < 0.1
        assert (errors_of_a_cylinder(mesh)[1] < 0.1) == round_
        assert (degrees(mesh.normals[mesh.faces], flat(mesh)[:, None]).max() < 0.1) != round_


@pytest.mark.parametrize("suffix", ["ply", "obj", "glb"])
@pytest.mark.parametrize("made", [trimesh.creation.box, lambda: trimesh.creation.cylinder(1, 2, sections=24)])
def test_means_over_edges_are_not_taken_from_a_file(tmp_path, suffix, made):
    """Programs write such normals for any mesh: a cube with them is a pillow."""
    solid = made()
    assert len(solid.vertex_normals)  # trimesh computes them, and writes what it has computed
    (trimesh.Scene(solid) if suffix == "glb" else solid).export(tmp_path / f"a.{suffix}")
    mesh = load_mesh(tmp_path / f"a.{suffix}")
    assert degrees(mesh.normals[mesh.faces], flat(mesh)[:, None]).max() < 360 / 24 / 2 + 0.1
    assert len(mesh.vertices) == (24 if len(solid.faces) == 12 else 98)


def test_inward_and_broken_normals_of_a_file_do_no_harm(tmp_path):
    ball = trimesh.creation.icosphere(subdivisions=2)
    normals = -ball.vertices.copy()
    normals[::7] = 0
    normals[1::7] = normals[1::7, ::-1] * [1, -1, 1]
    trimesh.Trimesh(ball.vertices, ball.faces, vertex_normals=normals, process=False).export(tmp_path / "a.ply")
    mesh = load_mesh(tmp_path / "a.ply")
    assert (
        degrees(mesh.normals, trimesh.unitize(mesh.vertices)).max() < creases.CREASE + 15
    )  # of the triangle, which may be as far from the ball's
    assert np.median(degrees(mesh.normals, trimesh.unitize(mesh.vertices))) < 0.1


def test_a_cube_is_rendered_flat_and_so_is_its_truth(tmp_path):
    """Three faces of a cube seen along its diagonal: one normal and one brightness each. A pillow has all between."""
    trimesh.creation.box().export(tmp_path / "cube.stl")
    rotation = trimesh.geometry.align_vectors([1, 1, 1], [0, 0, 1])[:3, :3]
    lights = [[0, 0, 1], [0.6, 0.2, 0.8]]
    view = render.render_view(
        tmp_path / "cube.stl", "lambertian:0.5", lights, size=32, spp=16, bounces=0, rotation=rotation
    )
    inner = view.mask & (view.coverage > 0.999)
    nearest = degrees(view.normals[inner][:, None], rotation.T[None]).min(1)
    assert np.median(nearest) < 0.01 and (nearest < 1).mean() > 0.85  # the others are pixels on an edge
    shading = (view.normals[inner] @ np.array([0, 0, 1.0])) * 0.5
    np.testing.assert_allclose(view.images[0][inner][nearest < 1][:, 0], shading[nearest < 1], atol=0.01)
