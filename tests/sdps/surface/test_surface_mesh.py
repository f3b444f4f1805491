"""The mesh: frame, units, winding, colours, holes, and files read back by trimesh."""

import io
import json
import struct

import numpy as np
import pytest
import trimesh
from surface_scenes import balls, sphere, sphere_before
from trimesh.exchange.gltf import load_glb
from trimesh.exchange.obj import load_obj
from trimesh.exchange.ply import load_ply

from render.shared.errors import InputError
from sdps.core.geometry import Camera
from sdps.core.integration import integrate
from sdps.surface.meshing import FORMATS, mesh, unit_scale, write_mesh

READERS = {".ply": load_ply, ".obj": load_obj, ".glb": load_glb}


@pytest.fixture(scope="module")
def dome():
    truth, normals, mask = sphere(48, 21.0, 0.9)
    return integrate(normals, mask), normals, truth


@pytest.fixture(scope="module")
def surface(dome):
    depth, normals, _ = dome
    colour = np.random.default_rng(0).integers(0, 256, (48, 48, 3), dtype=np.uint8)
    return mesh(depth, normals=normals, colour=colour), colour


def test_vertices_are_in_half_widths(dome, surface):
    depth, normals, truth = dome
    vertices = surface[0].vertices
    assert len(vertices) == depth.mask.sum()
    radius = 21.0 * unit_scale(depth.mask.shape)
    # A sphere again, about its own centre; the depth is known up to a constant.
    z = vertices[:, 2] + (truth[depth.mask].mean()) / 24
    assert np.allclose(np.hypot(np.hypot(vertices[:, 0], vertices[:, 1]), z), radius, atol=1e-3)
    top = vertices[np.argmax(vertices[:, 1])]
    assert normals[depth.mask][np.argmax(vertices[:, 1])][1] > 0.5 and top[1] > 0.5


def test_longer_side_is_two():
    mask = np.ones((10, 40), bool)
    wide = mesh(np.zeros((10, 40)), mask)
    assert np.allclose(wide.bounds, [[-0.975, -0.225, 0], [0.975, 0.225, 0]])
    assert np.allclose(np.abs(mesh(np.zeros((40, 10)), mask.T).bounds[:, 1]), 0.975)


@pytest.mark.parametrize("every", [1, 2])
def test_a_sphere_before_a_pinhole_is_a_sphere(every):
    camera = Camera(150.0, (40.0, 60.0))
    points, normals, mask = sphere_before(camera, 100, 36.0, (6.0, 4.0, -10.0), 0.95)
    depth = integrate(normals, mask, camera=camera)
    found = mesh(depth, normals=normals, millimetres=0.25, every=every)

    def radius(vertices: np.ndarray) -> tuple[float, float]:
        squares = (vertices**2).sum(-1)
        fit = np.linalg.lstsq(np.column_stack([2 * vertices, np.ones(len(vertices))]), squares, rcond=None)[0]
        off = np.abs(np.linalg.norm(vertices - fit[:3], axis=-1) - np.sqrt(fit[3] + (fit[:3] ** 2).sum()))
        return float(np.sqrt(fit[3] + (fit[:3] ** 2).sum())), float(off.max())

    scale = np.exp(-np.log(1.0 - points[mask][:, 2] / 150.0).mean())  # the object's mean depth is the focal length
    size, off = radius(np.asarray(found.vertices))
    assert size == pytest.approx(0.25 * 36.0 * scale, rel=1e-3) and off < 0.01
    assert (np.asarray(found.face_normals) * (np.array([0, 0, 37.5]) - found.triangles_center)).sum(-1).min() > 0
    flat = mesh(depth, camera=Camera(), millimetres=0.25, every=every)
    assert radius(np.asarray(flat.vertices))[1] > 0.15


def test_triangles_face_the_camera_and_agree_with_the_normals(dome, surface):
    shape = surface[0]
    assert (shape.face_normals[:, 2] > 0).all()
    means = shape.vertex_normals[shape.faces].mean(axis=1)
    agreement = (means * shape.face_normals).sum(axis=1) / np.linalg.norm(means, axis=1)
    assert agreement.min() > 0.97
    assert np.allclose(shape.vertex_normals, dome[1][dome[0].mask], atol=1e-5)


def test_full_grid_and_corners():
    assert len(mesh(np.zeros((4, 5)), np.ones((4, 5), bool)).faces) == 2 * 3 * 4
    corner = np.ones((2, 2), bool)
    for row in (0, 1):
        for column in (0, 1):
            mask = corner.copy()
            mask[row, column] = False
            one = mesh(np.zeros((2, 2)), mask)
            assert len(one.faces) == 1 and one.face_normals[0, 2] == pytest.approx(1.0)


def test_hole_stays_open_and_lines_are_left_out():
    mask = np.zeros((12, 20), bool)
    mask[:, :12] = True
    mask[5:7, 5:7] = False
    mask[3, 12:] = True  # a line
    shape = mesh(np.zeros(mask.shape), mask)
    # The line's first pixel has two neighbouring pixels of the block above and below, the others have none.
    assert shape.vertices[:, 0].max() == pytest.approx((12 - 9.5) * unit_scale(mask.shape))
    assert shape.area == pytest.approx((11 * 11 - 3 * 3 + 4 * 0.5 + 2 * 0.5) * unit_scale(mask.shape) ** 2)


def test_steepest_removes_walls():
    z, normals = balls()
    mask = np.ones(z.shape, bool)
    depth = integrate(normals, mask, discontinuities=True)
    whole, cut = mesh(depth), mesh(depth, steepest=8.0)
    assert 0 < len(whole.faces) - len(cut.faces) < 0.05 * len(whole.faces)
    steps = np.ptp(cut.vertices[cut.faces][..., 2], axis=1) / unit_scale(mask.shape)
    assert steps.max() <= 16.0


@pytest.mark.parametrize("suffix", FORMATS)
def test_files_read_back(tmp_path, surface, suffix):
    shape = surface[0]
    write_mesh(shape, tmp_path / f"object{suffix}")
    assert [path.name for path in tmp_path.iterdir()] == [f"object{suffix}"]
    back = trimesh.load(tmp_path / f"object{suffix}", force="mesh", process=False)
    assert np.allclose(back.vertices, shape.vertices, atol=1e-6)
    assert np.array_equal(back.faces, shape.faces)
    # trimesh.load drops the normals that its readers find, so they are asked themselves.
    with open(tmp_path / f"object{suffix}", "rb") as handle:
        parts = READERS[suffix](handle if suffix != ".obj" else io.TextIOWrapper(handle))
    parts = next(iter(parts["geometry"].values())) if "geometry" in parts else parts
    assert np.allclose(parts["vertex_normals"], shape.vertex_normals, atol=1e-5)
    colours = shape.visual.vertex_colors[:, :3]
    if suffix == ".glb":
        assert back.visual.material.metallicFactor == 0.0
        return
    assert np.array_equal(back.visual.vertex_colors[:, :3], colours)


def chunks(path):
    """Return the JSON of a .glb and its bytes, read by the specification (glTF 2.0, 4.4)."""
    data = path.read_bytes()
    assert struct.unpack_from("<4sII", data) == (b"glTF", 2, len(data))
    length, kind = struct.unpack_from("<I4s", data, 12)
    assert kind == b"JSON" and struct.unpack_from("<4s", data, 24 + length) == (b"BIN\0",)
    return json.loads(data[20 : 20 + length]), data[28 + length :]


def test_glb_is_matt_and_its_colours_are_linear(tmp_path, surface):
    write_mesh(surface[0], tmp_path / "object.glb")
    tree, data = chunks(tmp_path / "object.glb")
    (part,) = tree["meshes"][0]["primitives"]
    look = tree["materials"][part["material"]]["pbrMetallicRoughness"]
    assert look == {"baseColorFactor": [1, 1, 1, 1], "metallicFactor": 0, "roughnessFactor": 1}
    assert set(part["attributes"]) == {"POSITION", "NORMAL", "COLOR_0"}
    accessor = tree["accessors"][part["attributes"]["COLOR_0"]]
    assert (accessor["componentType"], accessor["type"], accessor["normalized"]) == (5123, "VEC4", True)
    begin = tree["bufferViews"][accessor["bufferView"]]["byteOffset"]
    found = np.frombuffer(data, "<u2", 4 * accessor["count"], begin).reshape(-1, 4) / 65535
    coded = surface[0].visual.vertex_colors[:, :3] / 255
    linear = np.where(coded <= 0.04045, coded / 12.92, ((coded + 0.055) / 1.055) ** 2.4)
    np.testing.assert_allclose(found, np.pad(linear, ((0, 0), (0, 1)), constant_values=1), atol=1e-5)


def test_glb_without_colours_is_matt_as_well(tmp_path, dome):
    write_mesh(mesh(dome[0]), tmp_path / "object.glb")
    (part,) = chunks(tmp_path / "object.glb")[0]["meshes"][0]["primitives"]
    assert part["material"] == 0 and "COLOR_0" not in part["attributes"]


def test_refusals(tmp_path, dome):
    depth, normals, _ = dome
    with pytest.raises(InputError, match="triangle"):
        mesh(np.zeros((5, 5)), np.eye(5, dtype=bool))
    with pytest.raises(InputError, match="uint8"):
        mesh(depth, colour=normals)
    with pytest.raises(InputError, match="normals must be"):
        mesh(depth, normals=normals[1:])
    with pytest.raises(InputError, match="NaN"):
        mesh(np.full((5, 5), np.nan), np.ones((5, 5), bool))
    with pytest.raises(InputError, match="mask"):
        mesh(np.zeros((5, 5)))
    with pytest.raises(InputError, match="mesh format"):
        write_mesh(mesh(depth), tmp_path / "object.stl")
    assert not list(tmp_path.iterdir())
