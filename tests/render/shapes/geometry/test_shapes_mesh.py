"""TriangleMesh and reading meshes from files."""

import gzip

import numpy as np
import pytest
import trimesh

from render import shapes
from render.shapes.files.mesh_file import load_mesh
from render.shapes.geometry import mesh as mesh_module
from render.shapes.geometry.mesh import TriangleMesh, vertex_normals
from render.shared.errors import InputError
from render.shared.seeds import generator

CUBE = trimesh.creation.box()


def triangle(**changes):
    arrays = {
        "vertices": np.eye(3, dtype=np.float32),
        "faces": np.array([[0, 1, 2]]),
        "normals": np.eye(3, dtype=np.float32),
    }
    return TriangleMesh(**(arrays | changes))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"faces": np.zeros((0, 3), dtype=int)}, "at least one triangle"),
        ({"faces": np.array([[0, 1, 3]])}, "index 3 is out of range"),
        ({"faces": np.array([[0, 1, -1]])}, "index -1 is out of range"),
        ({"faces": np.array([[0.0, 1.0, 2.0]])}, "integer"),
        ({"vertices": np.full((3, 3), np.nan)}, "not finite"),
        ({"vertices": np.zeros((3, 2))}, r"\(V, 3\)"),
        ({"normals": np.eye(3)[:2]}, "2 for 3 vertices"),
        ({"normals": 2 * np.eye(3)}, "unit length"),
    ],
)
def test_construction_refuses(changes, message):
    with pytest.raises(InputError, match=message):
        triangle(**changes)


def test_arrays_get_their_dtypes():
    mesh = triangle(vertices=np.eye(3))
    assert (mesh.vertices.dtype, mesh.faces.dtype, mesh.normals.dtype) == (np.float32, np.uint32, np.float32)


def test_normalised_centres_on_the_bounding_sphere():
    ball = trimesh.creation.icosphere(subdivisions=3, radius=2.5)
    points = np.asarray(ball.vertices) + np.array([4.0, -1.0, 2.0])
    mesh = TriangleMesh(vertices=points, faces=ball.faces, normals=vertex_normals(points, ball.faces)).normalise()
    radii = np.linalg.norm(mesh.vertices, axis=1)
    assert radii.max() == pytest.approx(1, abs=1e-6)
    assert radii.min() > 0.98


def test_rotated_turns_positions_and_normals():
    quarter = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])  # about z: x to y
    mesh = triangle().rotate(quarter)
    np.testing.assert_allclose(mesh.vertices[0], [0, 1, 0], atol=1e-7)
    np.testing.assert_allclose(mesh.normals[0], [0, 1, 0], atol=1e-7)
    with pytest.raises(InputError, match="mirrors"):
        triangle().rotate(np.diag([1.0, 1, -1]))
    with pytest.raises(InputError, match="orthonormal"):
        triangle().rotate(2 * np.eye(3))


def test_area_weights_follow_the_larger_face():
    # Two faces share the origin: one in the plane z = 0 of area 2, one in the plane x = 0 of area 1/2.
    points = np.array([[0.0, 0, 0], [2, 0, 0], [0, 2, 0], [0, 1, 0], [0, 0, 1]])
    normals = vertex_normals(points, np.array([[0, 1, 2], [0, 3, 4]]))
    np.testing.assert_allclose(normals[0], np.array([1, 0, 4]) / np.sqrt(17), atol=1e-6)


@pytest.mark.parametrize("suffix", ["obj", "ply", "stl", "glb", "off"])
def test_formats_read_as_one_closed_mesh_with_the_edges_of_a_cube(tmp_path, suffix):
    path = tmp_path / f"cube.{suffix}"
    trimesh.Scene([CUBE]).export(path) if suffix == "glb" else CUBE.export(path)
    mesh = shapes.load(str(path))
    assert len(mesh.vertices) == 24 and len(mesh.faces) == 12
    np.testing.assert_allclose(np.linalg.norm(mesh.vertices, axis=1), 1, atol=1e-5)
    corners = mesh.vertices[mesh.faces].astype(float)
    flat = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    np.testing.assert_allclose(mesh.normals[mesh.faces], np.repeat(trimesh.unitize(flat)[:, None], 3, 1), atol=1e-6)
    assert ((mesh.normals * mesh.vertices).sum(axis=1) > 0.5).all()


def test_scene_parts_are_joined_where_the_scene_places_them(tmp_path):
    scene = trimesh.Scene()
    for offset in (0.0, 5.0):
        scene.add_geometry(CUBE, transform=trimesh.transformations.translation_matrix([offset, 0, 0]))
    path = tmp_path / "two.glb"
    scene.export(path)
    mesh = load_mesh(path)
    assert len(mesh.faces) == 24
    assert np.ptp(mesh.vertices[:, 0]) == pytest.approx(6)


def test_nested_nodes_turn_scale_and_move_their_parts(tmp_path):
    turn = trimesh.transformations.rotation_matrix(np.pi / 2, [0, 0, 1])  # x to y
    grow = np.diag([1.0, 3.0, 1.0, 1.0])
    scene = trimesh.Scene(CUBE)
    scene.graph.update("arm", matrix=trimesh.transformations.translation_matrix([10, 0, 0]) @ turn)
    scene.add_geometry(CUBE, node_name="hand", parent_node_name="arm", transform=grow)
    path = tmp_path / "nested.glb"
    scene.export(path)
    # The arm's cube, 3 long in y, lies along x after the turn, and is then moved to x = 10.
    low, high = load_mesh(path).vertices.min(0), load_mesh(path).vertices.max(0)
    np.testing.assert_allclose(low, [-0.5, -0.5, -0.5], atol=1e-6)
    np.testing.assert_allclose(high, [11.5, 0.5, 0.5], atol=1e-6)


STRIPPED = "\n".join([
    "ply", "format {} 1.0", "element vertex 6", *(f"property float {axis}" for axis in "xyz"),
    "element tristrips 1", "property list int int vertex_indices", "end_header", "",
])  # fmt: skip
PLACES = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0], [0, 2, 0], [5, 5, 1]])
STRIPS = [0, 1, 2, 3, 4, -1, 3, 5, 4, -1, 1, 2]  # the last one is no triangle


def wound(triangles):
    return {tuple(map(tuple, np.roll(corners, -np.lexsort(corners.T)[0], axis=0).tolist())) for corners in triangles}


@pytest.mark.parametrize("kind", ["ascii", "binary_little_endian", "binary_big_endian", "packed"])
def test_triangle_strips_alternate_their_winding(tmp_path, kind):
    order = ">" if "big" in kind else "<"
    body = PLACES.astype(f"{order}f4").tobytes() + np.array([len(STRIPS), *STRIPS], f"{order}i4").tobytes()
    if kind == "ascii":
        rows = [*PLACES.tolist(), [len(STRIPS), *STRIPS]]
        body = "\n".join(" ".join(map(str, row)) for row in rows).encode()
    content = STRIPPED.format("binary_little_endian" if kind == "packed" else kind).encode() + body
    path = tmp_path / ("scan.ply.gz" if kind == "packed" else "scan.ply")
    path.write_bytes(gzip.compress(content) if kind == "packed" else content)
    mesh = load_mesh(path)
    assert len(mesh.faces) == 4
    # The same corners in the same order round each triangle, whichever comes first.
    assert wound(mesh.vertices[mesh.faces]) == wound(PLACES[[[0, 1, 2], [2, 1, 3], [2, 3, 4], [3, 5, 4]]])


def test_inside_out_and_mixed_windings_are_repaired(tmp_path):
    for flipped in (np.arange(12), np.arange(5)):
        faces = np.array(CUBE.faces)
        faces[flipped] = faces[flipped][:, ::-1]
        path = tmp_path / "cube.ply"
        trimesh.Trimesh(CUBE.vertices, faces, process=False).export(path)
        mesh = load_mesh(path)
        assert ((mesh.normals * mesh.vertices).sum(axis=1) > 0).all()


def test_degenerate_triangles_and_loose_vertices_are_dropped(tmp_path):
    path = tmp_path / "mesh.obj"
    path.write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nv 2 0 0\nv 9 9 9\nf 1 2 3\nf 1 2 4\nf 1 1 2\n")
    mesh = load_mesh(path)
    assert len(mesh.faces) == 1 and len(mesh.vertices) == 3


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("garbage.ply", b"\x00\x01 this is no mesh", "damaged or not a mesh"),
        ("garbage.glb", b"glTF\x02", "damaged or not a mesh"),
        ("points.obj", b"v 0 0 0\nv 1 0 0\nv 0 1 0\n", "no triangles|cannot be read"),
        ("empty.obj", b"", "no triangles|cannot be read"),
        ("nan.obj", b"v 0 0 0\nv nan 0 0\nv 0 1 0\nf 1 2 3\n", "not finite"),
        ("flat.obj", b"v 0 0 0\nv 1 0 0\nv 2 0 0\nf 1 2 3\n", "degenerate"),
        ("mesh.unknown", b"something", "is a .unknown file, which is not read; export it as"),
        ("part.step", b"ISO-10303-21;", "is a .step file, which is not read; export it as"),
    ],
)
def test_unusable_files_are_one_line_errors(tmp_path, name, content, message):
    path = tmp_path / name
    path.write_bytes(content)
    with pytest.raises(InputError, match=message) as caught:
        shapes.load(str(path))
    assert "\n" not in str(caught.value) and name in str(caught.value)


@pytest.mark.parametrize("suffix", ["ply", "obj", "glb"])
@pytest.mark.filterwarnings("ignore")
def test_a_damaged_file_loads_or_ends_in_one_line_that_names_it(tmp_path, suffix):
    sound = tmp_path / f"sound.{suffix}"
    trimesh.creation.icosphere(subdivisions=1).export(sound)
    content, path = sound.read_bytes(), tmp_path / f"damaged.{suffix}"
    rng, refused = generator(0, "mutations", suffix), 0
    for _ in range(120):
        damaged = bytearray(content)
        for place in rng.integers(len(damaged), size=rng.integers(1, 6)):
            damaged[place] = rng.integers(256)
        path.write_bytes(damaged)
        try:
            load_mesh(path).normalise()
        except InputError as error:
            refused += 1
            assert "\n" not in str(error) and str(path) in str(error)
    assert 0 < refused < 120


def test_a_compressed_file_is_the_same_mesh(tmp_path):
    plain = tmp_path / "ball.ply"
    trimesh.creation.icosphere(subdivisions=1).export(plain)
    packed = tmp_path / "ball.ply.gz"
    packed.write_bytes(gzip.compress(plain.read_bytes()))
    np.testing.assert_array_equal(load_mesh(packed).vertices, load_mesh(plain).vertices)


def test_a_compressed_file_that_unpacks_to_too_much_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr("render.shared.decoding.ALWAYS", 1 << 20)
    path = tmp_path / "bomb.ply.gz"
    path.write_bytes(gzip.compress(bytes((1 << 20) + 1)))
    with pytest.raises(InputError, match=r"bomb.ply.gz: unpacks to more than a file of this size"):
        load_mesh(path)


def test_the_bounding_centre_is_the_same_however_many_points_are_looked_at_together(monkeypatch) -> None:
    points = np.random.default_rng(0).normal(0, 1, (5000, 3)).astype(np.float32)
    whole = mesh_module.bounding_centre(points)
    monkeypatch.setattr(mesh_module, "_BLOCK", 700)
    np.testing.assert_array_equal(mesh_module.bounding_centre(points), whole)
