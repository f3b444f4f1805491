"""Mesh files as programs write them: exact geometry of each, or one line that says what to do."""

import base64
import gzip
import json
import struct

import numpy as np
import pytest
import trimesh

from render import shapes
from render.shapes.files import polygons
from render.shapes.files.mesh_file import load_mesh
from render.shared.errors import InputError

BOX = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0, 0, 1], [1, 0, 1], [1, 1, 1], [0, 1, 1]], float)
QUADS = [[0, 3, 2, 1], [4, 5, 6, 7], [0, 1, 5, 4], [1, 2, 6, 5], [2, 3, 7, 6], [3, 0, 4, 7]]
MIXED = [*QUADS[:5], [3, 0, 4], [3, 4, 7]]
L_SHAPE = np.array([[0, 0], [2, 0], [2, 1], [1, 1], [1, 2], [0, 2]], float)


def prism(outline):
    """Return a prism of height 1 over an outline, with its ends as one polygon each."""
    n = len(outline)
    points = np.concatenate([np.c_[outline, np.zeros(n)], np.c_[outline, np.ones(n)]])
    sides = [[i, (i + 1) % n, n + (i + 1) % n, n + i] for i in range(n)]
    return points, [list(range(n))[::-1], list(range(n, 2 * n)), *sides]


def measures(mesh):
    """Return area and volume."""
    a, b, c = (mesh.vertices[mesh.faces[:, k]].astype(float) for k in range(3))
    cross = np.cross(b - a, c - a)
    return np.linalg.norm(cross, axis=1).sum() / 2, (a * cross).sum() / 6


def text_ply(points, faces):
    header = ["ply", "format ascii 1.0", f"element vertex {len(points)}", *(f"property float {axis}" for axis in "xyz"),
              f"element face {len(faces)}", "property list uchar int vertex_indices", "end_header"]  # fmt: skip
    rows = [" ".join(map(str, row)) for row in [*np.asarray(points).tolist(), *([len(face), *face] for face in faces)]]
    return "\n".join([*header, *rows, ""]).encode()


def binary_ply(points, faces, order="<", kind="float"):
    form = {"<": "binary_little_endian", ">": "binary_big_endian"}[order]
    header = text_ply(points, faces).decode().partition("end_header\n")[0].replace("ascii", form)
    body = np.asarray(points, f"{order}f{4 if kind == 'float' else 8}").tobytes()
    for face in faces:
        body += bytes([len(face)]) + np.array(face, f"{order}i4").tobytes()
    return (header.replace("property float", f"property {kind}") + "end_header\n").encode() + body


def off(points, faces):
    rows = [" ".join(map(str, row)) for row in [*np.asarray(points).tolist(), *([len(face), *face] for face in faces)]]
    return "\n".join([f"OFF # by hand\n{len(points)} {len(faces)} 0", *rows, ""]).encode()


def obj(points, faces):
    rows = [f"v {x} {y} {z}" for x, y, z in np.asarray(points)]
    return "\n".join([*rows, *("f " + " ".join(str(k + 1) for k in face) for face in faces), ""]).encode()


@pytest.mark.parametrize(("suffix", "write"), [("ply", text_ply), ("ply", binary_ply), ("off", off), ("obj", obj)])
@pytest.mark.parametrize("faces", [QUADS, MIXED], ids=["quads", "mixed"])
def test_quads_and_mixed_faces(tmp_path, suffix, write, faces):
    (tmp_path / f"box.{suffix}").write_bytes(write(BOX, faces))
    mesh = load_mesh(tmp_path / f"box.{suffix}")
    assert len(mesh.faces) == 12 and len(mesh.vertices) == 24
    np.testing.assert_allclose(measures(mesh), [6, 1], rtol=1e-6)


@pytest.mark.parametrize(
    ("suffix", "write"),
    [("ply", text_ply), ("ply", binary_ply), ("ply", lambda *args: binary_ply(*args, ">", "double")), ("off", off),
     ("obj", obj)],
)  # fmt: skip
@pytest.mark.parametrize("first", [0, 2, 3])
def test_concave_faces_are_filled_within_their_outline(tmp_path, suffix, write, first):
    (tmp_path / f"l.{suffix}").write_bytes(write(*prism(np.roll(L_SHAPE, first, 0))))
    np.testing.assert_allclose(measures(load_mesh(tmp_path / f"l.{suffix}")), [14, 3], rtol=1e-6)


@pytest.mark.parametrize("points", [5, 30, 100])
def test_stars_seen_from_any_side_are_cut_into_triangles_of_their_area(points):
    angle = np.arange(2 * points) * np.pi / points
    radius = np.where(np.arange(2 * points) % 2, 0.3, 1.0)
    turn = np.linalg.qr(np.random.default_rng(points).normal(size=(3, 3)))[0]
    star = np.stack([radius * np.cos(angle), radius * np.sin(angle), 0 * angle], 1) @ turn
    corners = star[polygons.triangulate(star, np.array([2 * points]))]
    crosses = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert len(crosses) == 2 * points - 2
    assert np.linalg.norm(crosses, axis=1).sum() == pytest.approx(np.linalg.norm(crosses.sum(0)), rel=1e-9)


# Vertices and faces in turn, counted back from each face; the second object would be the first by trimesh 5.2.
RELATIVE = """o one
v 0 0 0
v 1 0 0
v 0 2 0
f -3 -2 -1
o two
v 5 0 0
v 7 0 0
v 7 2 0
v 5 2 0
f -4 -3 -2 -1
"""
ABSOLUTE = RELATIVE.replace("-4 -3 -2 -1", "4 5 6 7").replace("-3 -2 -1", "1 2 3")
INSTRUCTIVE = {
    "relative": RELATIVE,
    "absolute": ABSOLUTE,
    "line ends of Windows": RELATIVE.replace("\n", "\r\n"),
    "line ends of old Macs": RELATIVE.replace("\n", "\r"),
    "byte order mark": "\ufeff" + RELATIVE,
    "tabs and blanks": ABSOLUTE.replace("v ", " v\t").replace("f ", "\tf  "),
    "continued lines": RELATIVE.replace("-2 -1", "\\\n  -2 \\\n -1"),
    "a comment that ends in a backslash": "# c:\\models\\\n" + RELATIVE,
    "materials and groups": "mtllib no.mtl\n"
    + ABSOLUTE.replace("f 1", "usemtl a\ng x y\nf 1").replace("f 4", "usemtl b\ns off\nf 4"),
    "colours": RELATIVE.replace("v 5 0 0", "v 5 0 0 0.1 0.2 0.3").replace("v 1 0 0", "v 1 0 0 1 1 1"),
    "weights": ABSOLUTE.replace("\nf 1", " 1.0\nf 1"),
    "texture coordinates of some": "vt 0 0\n" + ABSOLUTE.replace("1 2 3", "1/1 2/1 3/1"),
    "normals of some": "vn 0 0 1\n" + RELATIVE.replace("-3 -2 -1", "-3//-1 -2//-1 -1//-1", 1),
    "texture coordinates that are not there": ABSOLUTE.replace("1 2 3", "1/1 2/2 3/3"),
    "empty numbers": ABSOLUTE.replace("1 2 3", "1/ 2// 3"),
    "lines and points": RELATIVE + "l 1 2 3\np 1\n",
    "comments at the end": ABSOLUTE.replace("v 1 0 0", "v 1 0 0 # second").replace("f 1 2 3", "f 1 2 3 # first"),
    "exponents": ABSOLUTE.replace("v 1 0 0", "v 1e+0 -0.0e-3 +0"),
}


@pytest.mark.parametrize("case", INSTRUCTIVE)
def test_obj_is_read_as_its_makers_meant(tmp_path, case):
    (tmp_path / "two.obj").write_bytes(INSTRUCTIVE[case].encode())
    mesh = load_mesh(tmp_path / "two.obj")
    found = sorted(tuple(sorted(map(tuple, triangle))) for triangle in mesh.vertices[mesh.faces].tolist())
    expected = [[(0, 0, 0), (0, 2, 0), (1, 0, 0)], [(5, 0, 0), (5, 2, 0), (7, 2, 0)], [(5, 0, 0), (7, 0, 0), (7, 2, 0)]]
    assert found == [tuple(corners) for corners in expected]


def test_obj_faces_of_two_forms_with_as_many_numbers(tmp_path):
    """A hexagon of vertices and a triangle of vertices with texture coordinates: six numbers each."""
    ring = [(np.cos(k * np.pi / 3), np.sin(k * np.pi / 3), 0) for k in range(6)]
    rows = [f"v {x} {y} {z}" for x, y, z in ring] + ["vt 0 0", "vt 1 0", "vt 0 1", "v 9 0 0", "v 9 1 0"]
    (tmp_path / "mix.obj").write_text("\n".join([*rows, "f 1 2 3 4 5 6", "f 1/1 7/2 8/3", ""]))
    mesh = load_mesh(tmp_path / "mix.obj")
    assert len(mesh.faces) == 5 and mesh.uv is None
    assert measures(mesh)[0] == pytest.approx(3 * np.sqrt(3) / 2 + 4, rel=1e-6)


def test_obj_texture_coordinates_and_normals_stay_with_their_corners(tmp_path):
    text = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\nvn 0 0.3 1\n"
    (tmp_path / "sheet.obj").write_text(text + "f -4/-4/-1 -3/-3/-1 -2/-2/-1 -1/-1/-1\n")
    mesh = load_mesh(tmp_path / "sheet.obj")
    np.testing.assert_allclose(mesh.uv, mesh.vertices[mesh.faces][..., :2])
    np.testing.assert_allclose(mesh.normals, np.tile(np.array([0, 0.3, 1]) / np.hypot(0.3, 1), (4, 1)), atol=1e-6)


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("a.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 9\n", "names vertex 9, but the file holds 1 to 3"),
        ("a.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 0 1 2\n", "names vertex 0"),
        ("a.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\nf -9 -2 -1\n", "counts back beyond the first vertex"),
        ("a.obj", "v 0,5 0,1 0,2\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", "'v 0,5 0,1 0,2': expected 3 numbers"),
        ("a.obj", "v 0 0\nv 1 0\nv 0 1\nf 1 2 3\n", "'v 0 0': expected 3 numbers"),
        ("a.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 c\n", "'f 1 2 c': expected whole numbers"),
        ("a.off", "OFF\n3 1 0\n0 0 0\n1 0 0\n", "is cut short: announces 3 vertices and 1 faces"),
        ("a.off", "4OFF\n3 1 0\n", "of another kind than text in three dimensions"),
        ("a.off", "OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 7\n", "names vertex 7"),
        ("a.ply", text_ply(BOX, [[0, 1, 2, 9]]).decode(), "names vertex 9"),
        ("a.stl", "solid\x00" + 100 * "\x00", "a mesh|degenerate|cut short|no triangles"),
        ("a.fbx", "Kaydara FBX Binary", "is a .fbx file, which is not read; export it as .glb, .obj, .ply or .stl"),
    ],
)  # fmt: skip
def test_what_cannot_be_read_is_named(tmp_path, name, content, message):
    (tmp_path / name).write_text(content)
    with pytest.raises(InputError, match=message) as caught:
        load_mesh(tmp_path / name)
    assert "\n" not in str(caught.value) and str(caught.value).startswith(str(tmp_path / name))


def test_stl_cut_short_or_with_more_behind_it(tmp_path):
    whole = trimesh.creation.box().export(file_type="stl")
    (tmp_path / "a.stl").write_bytes(whole[:-30])
    with pytest.raises(InputError, match=r"a\.stl: is cut short: 11 of 12 triangles"):
        load_mesh(tmp_path / "a.stl")
    (tmp_path / "a.stl").write_bytes(b"solid by a CAD program".ljust(80) + whole[80:] + bytes(7))
    assert len(load_mesh(tmp_path / "a.stl").faces) == 12


def test_stl_as_text_with_several_solids(tmp_path):
    box = trimesh.creation.box()
    text = (
        box.export(file_type="stl_ascii") + "\n" + box.copy().apply_translation([3, 0, 0]).export(file_type="stl_ascii")
    )
    (tmp_path / "two.stl").write_text(text)
    np.testing.assert_allclose(measures(load_mesh(tmp_path / "two.stl")), [12, 2], rtol=1e-6)


@pytest.mark.parametrize("size", [1e-30, 1e-9, 1.0, 1e9, 1e30, 1e200])
def test_the_unit_does_not_matter(tmp_path, size):
    (tmp_path / "box.ply").write_bytes(binary_ply(BOX * size, QUADS, kind="double"))
    mesh = shapes.load(str(tmp_path / "box.ply"))
    np.testing.assert_allclose(np.abs(mesh.vertices), 1 / np.sqrt(3), rtol=1e-5)
    assert len(mesh.vertices) == 24


def test_a_survey_far_from_the_origin_keeps_its_shape(tmp_path):
    """Coordinates of a map projection in metres: float32 has steps of half a metre there."""
    (tmp_path / "a.ply").write_bytes(binary_ply(0.3 * BOX + [512345.25, 5412345.75, 310], QUADS, kind="double"))
    mesh = load_mesh(tmp_path / "a.ply")
    np.testing.assert_allclose(np.ptp(mesh.vertices, axis=0), 0.3, rtol=1e-6)


def test_vertices_that_are_not_finite_matter_only_where_used(tmp_path):
    (tmp_path / "a.ply").write_bytes(binary_ply([*BOX, [np.nan] * 3], QUADS))
    assert measures(load_mesh(tmp_path / "a.ply")) == pytest.approx((6, 1))
    (tmp_path / "a.ply").write_bytes(binary_ply([[np.inf] * 3, *BOX[1:]], QUADS))
    with pytest.raises(InputError, match="1 of 8 vertices are not finite"):
        load_mesh(tmp_path / "a.ply")


BALL = trimesh.creation.icosphere(subdivisions=2)


def faces_of(name):
    """Return the faces of a ball as some programs leave them."""
    faces = np.asarray(BALL.faces)
    return {
        "twice": np.concatenate([faces, np.roll(faces, 1, axis=1)]),
        "double-sided": np.concatenate([faces, faces[:, ::-1]]),
        "inside out": faces[:, ::-1],
        "some turned": np.where(np.arange(len(faces))[:, None] % 3 == 0, faces[:, ::-1], faces),
        "open, inside out": faces[5:, ::-1],
        "open, some turned": np.where(np.arange(len(faces))[:, None] % 3 == 0, faces[:, ::-1], faces)[5:],
    }[name]


@pytest.mark.parametrize(
    "case", ["twice", "double-sided", "inside out", "some turned", "open, inside out", "open, some turned"]
)
def test_a_ball_points_outwards_whatever_its_triangles(tmp_path, case):
    trimesh.Trimesh(BALL.vertices, faces_of(case), process=False).export(tmp_path / "a.ply")
    mesh = load_mesh(tmp_path / "a.ply")
    assert len(mesh.vertices) == len(BALL.vertices) and len(mesh.faces) in (len(BALL.faces), len(BALL.faces) - 5)
    assert ((mesh.normals * mesh.vertices).sum(1) > 0.99).all()
    corners = mesh.vertices[mesh.faces]
    assert (np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]) * corners.mean(1)).sum(1).min() > 0


def test_a_sheet_is_wound_as_most_of_it_is(tmp_path):
    grid = np.array([(x, y, 0.1 * x * y) for y in range(5) for x in range(5)], float)
    faces = [[k, k + 1, k + 6, k + 5] for k in range(20) if k % 5 != 4]
    faces[3:6] = [face[::-1] for face in faces[3:6]]
    (tmp_path / "a.ply").write_bytes(text_ply(grid, faces))
    assert (load_mesh(tmp_path / "a.ply").normals[:, 2] > 0.5).all()


def gltf(tmp_path, **changes):
    """Write a box as glTF with its buffer next to it; return the path and the tree."""
    box = trimesh.creation.box()
    points, index = box.vertices.astype("<f4").tobytes(), box.faces.astype("<u2").tobytes()
    (tmp_path / "my box.bin").write_bytes(points + index)
    tree = {
        "asset": {"version": "2.0"}, "scene": 0, "scenes": [{"nodes": [0]}], "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1}]}],
        "buffers": [{"uri": "my%20box.bin", "byteLength": len(points + index)}],
        "bufferViews": [{"buffer": 0, "byteLength": len(points)},
                        {"buffer": 0, "byteOffset": len(points), "byteLength": len(index)}],
        "accessors": [{"bufferView": 0, "componentType": 5126, "count": 8, "type": "VEC3"},
                      {"bufferView": 1, "componentType": 5123, "count": 36, "type": "SCALAR"}],
    }  # fmt: skip
    for name, value in changes.items():
        tree[name] = value
    path = tmp_path / "box.gltf"
    path.write_text(json.dumps(tree))
    return path, tree


def test_gltf_finds_its_buffer_and_says_which_one_is_missing(tmp_path):
    path, tree = gltf(tmp_path)
    assert measures(load_mesh(path)) == pytest.approx((6, 1))
    data = base64.b64encode((tmp_path / "my box.bin").read_bytes()).decode()
    gltf(tmp_path, buffers=[tree["buffers"][0] | {"uri": f"data:application/octet-stream;base64,{data}"}])
    assert measures(load_mesh(path)) == pytest.approx((6, 1))
    gltf(tmp_path)
    (tmp_path / "my box.bin").unlink()
    with pytest.raises(InputError, match=r"box\.gltf: keeps its mesh in 'my box\.bin', which is not there; copy it"):
        load_mesh(path)


DRACO, MESHOPT, QUANTISED = "KHR_draco_mesh_compression", "EXT_meshopt_compression", "KHR_mesh_quantization"
ACCESSORS = [
    {"componentType": 5126, "count": 8, "type": "VEC3"},
    {"componentType": 5123, "count": 36, "type": "SCALAR"},
]
PART = {"attributes": {"POSITION": 0}, "indices": 1}


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"extensionsRequired": [DRACO], "extensionsUsed": [DRACO]}, f"is compressed with Draco ({DRACO}); export it"),
        ({"meshes": [{"primitives": [PART | {"extensions": {DRACO: {"bufferView": 0, "attributes": {}}}}]}],
          "accessors": ACCESSORS}, f"is compressed with Draco ({DRACO})"),
        ({"extensionsRequired": [QUANTISED, MESHOPT]}, f"is compressed with meshopt ({MESHOPT}); export it without c"),
        ({"extensionsRequired": ["KHR_meshopt_compression"]}, "is compressed with meshopt (KHR_meshopt_compression)"),
        ({"extensionsRequired": ["VENDOR_voxels"]}, "requires the extension VENDOR_voxels, which is not read"),
        ({"nodes": [{"mesh": 0, "extensions": {"EXT_mesh_gpu_instancing": {}}}]}, "places copies of a mesh by EXT"),
        ({"meshes": [{"primitives": [PART | {"mode": 6}]}]}, "has triangle fans, which are not read"),
        ({"accessors": [ACCESSORS[0] | {"sparse": {"count": 1}}, ACCESSORS[1]]}, "has positions or indices in sparse"),
        ({"extensionsUsed": [QUANTISED], "accessors": [ACCESSORS[0] | {"componentType": 5122, "normalized": True},
                                                      ACCESSORS[1]]}, "has quantised positions"),
    ],
)  # fmt: skip
@pytest.mark.parametrize("packed", [False, True])
def test_gltf_that_trimesh_would_leave_out_is_refused_by_its_name(tmp_path, changes, message, packed):
    path, tree = gltf(tmp_path, **changes)
    if packed:
        content = json.dumps(tree).encode()
        content += b" " * (-len(content) % 4)
        data = (tmp_path / "my box.bin").read_bytes()
        chunks = (
            struct.pack("<II", len(content), 0x4E4F534A) + content + struct.pack("<II", len(data), 0x004E4942) + data
        )
        path = tmp_path / "box.glb"
        path.write_bytes(b"glTF" + struct.pack("<II", 2, 12 + len(chunks)) + chunks)
    with pytest.raises(InputError) as caught:
        load_mesh(path)
    assert message in str(caught.value) and str(caught.value).startswith(f"{path}: ")


def test_gltf_extensions_of_materials_do_not_matter(tmp_path):
    path, _ = gltf(tmp_path, extensionsRequired=["KHR_materials_unlit", "KHR_texture_transform"])
    assert measures(load_mesh(path)) == pytest.approx((6, 1))


def test_gltf_nodes_that_mirror_keep_the_outside(tmp_path):
    path, _ = gltf(tmp_path, nodes=[{"mesh": 0, "scale": [-2, 1, 1], "translation": [4, 0, 0]}])
    mesh = load_mesh(path)
    assert measures(mesh) == pytest.approx((10, 2))
    np.testing.assert_allclose([mesh.vertices[:, 0].min(), mesh.vertices[:, 0].max()], [3, 5])
    assert ((mesh.normals * (mesh.vertices - [4, 0, 0])).sum(1) > 0).all()


@pytest.mark.parametrize(
    "case", ["bad.stl", "text.stl", "short.off", "odd.obj", "draco.glb", "zero.ply", "normals.ply"]
)
def test_the_console_stays_clean(tmp_path, recwarn, caplog, capfd, case):
    """What numpy and trimesh would say of files; what cannot be used is refused in one line by us."""
    zero = "ply\nformat ascii 1.0\nelement vertex 3\n" + "".join(f"property float {a}\n" for a in "xyz")
    zero += "element face 1\nproperty list uchar int vertex_indices\nend_header\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n"
    normals = zero.replace(
        "property float z\n", "property float z\n" + "".join(f"property float n{a}\n" for a in "xyz")
    )
    contents = {
        "bad.stl": "solid a\nfacet normal nan nan nan\nouter loop\nvertex 0 0 x\nvertex 1 0 0\nvertex 0 1 0\nendloop\n",
        "text.stl": trimesh.creation.box().export(file_type="stl_ascii").replace("normal 0", "normal x"),
        "short.off": "OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n4 0 1 2\n",
        "odd.obj": "v 0 0 0\nv 1 0 0 1 2\nv 0 1 x\nf 1 2 3\n",
        "draco.glb": json.dumps({"extensionsRequired": [DRACO]}),
        "zero.ply": zero.replace("1 0 0", "1e300 0 0").replace("float x", "double x"),
        "normals.ply": normals.replace("0 0 0\n", "0 0 0 0 0 0\n").replace("1 0 0\n", "1 0 0 nan 0 0\n").replace(
            "0 1 0\n", "0 1 0 1e30 1e30 1e30\n"),
    }  # fmt: skip
    (tmp_path / case).write_text(contents[case])
    try:
        load_mesh(tmp_path / case).normalise()
    except InputError as error:
        assert "\n" not in str(error)
    assert not recwarn.list and not caplog.records and capfd.readouterr() == ("", "")


def test_ply_with_colours_lists_and_other_elements(tmp_path):
    """As MeshLab and Blender write them: more columns, texture coordinates by corner, edges behind the faces."""
    uv = BOX[:, :2]
    header = "ply\nformat binary_little_endian 1.0\ncomment a\nelement vertex 8\n"
    header += "".join(f"property float {name}\n" for name in ("x", "y", "z", "nx", "ny", "nz"))
    header += "property uchar red\nelement face 7\nproperty uchar flags\nproperty list uchar uint vertex_index\n"
    header += "property list uchar float texcoord\nelement edge 1\nproperty int vertex1\nend_header\n"
    body = b"".join(struct.pack("<6fB", *point, *(point - 0.5), 9) for point in BOX)
    for face in MIXED:
        body += bytes([1, len(face)]) + np.array(face, "<u4").tobytes()
        body += bytes([2 * len(face)]) + uv[face].astype("<f4").tobytes()
    (tmp_path / "a.ply").write_bytes(header.encode() + body + struct.pack("<i", 3))
    mesh = load_mesh(tmp_path / "a.ply")
    assert measures(mesh) == pytest.approx((6, 1))
    np.testing.assert_allclose(mesh.uv, mesh.vertices[mesh.faces][..., :2])
    (tmp_path / "a.ply.gz").write_bytes(gzip.compress((tmp_path / "a.ply").read_bytes()))
    np.testing.assert_array_equal(load_mesh(tmp_path / "a.ply.gz").vertices, mesh.vertices)
    (tmp_path / "a.ply").write_bytes(header.encode() + body[:-40])
    with pytest.raises(InputError, match="is cut short"):
        load_mesh(tmp_path / "a.ply")


@pytest.mark.parametrize("order", ["", "<", ">"])
def test_ply_strips_of_any_byte_order(tmp_path, order):
    """A square and a triangle: strips of one list are separated by -1, and the last may end without."""
    points, strips = [[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0], [5, 0, 0]], [0, 1, 2, 3, -1, 1, 4, 3]
    form = {"": "ascii", "<": "binary_little_endian", ">": "binary_big_endian"}[order]
    header = f"ply\nformat {form} 1.0\nelement vertex 5\n" + "".join(f"property float {axis}\n" for axis in "xyz")
    header += "element tristrips 1\nproperty list int int vertex_indices\nend_header\n"
    rows = [*points, [len(strips), *strips]]
    body = "\n".join(" ".join(map(str, row)) for row in rows).encode()
    if order:
        body = np.array(points, f"{order}f4").tobytes() + np.array(rows[-1], f"{order}i4").tobytes()
    (tmp_path / "a.ply").write_bytes(header.encode() + body)
    mesh = load_mesh(tmp_path / "a.ply")
    assert len(mesh.faces) == 3 and measures(mesh)[0] == pytest.approx(3)
    (tmp_path / "a.ply").write_bytes(header.encode() + body[:-2])
    with pytest.raises(InputError, match="is cut short"):
        load_mesh(tmp_path / "a.ply")
