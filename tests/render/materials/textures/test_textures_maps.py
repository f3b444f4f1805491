"""Folders of maps: found by name, decoded in their colour space and depth, laid on from three sides."""

import numpy as np
import pytest
import textures_support as support

from render import shapes
from render.backend.jit import dr, mi
from render.materials import library
from render.materials.kernels.textures import cover, projections
from render.materials.textures import map_folder
from render.materials.textures.map_folder import read
from render.materials.textures.map_names import find
from render.shapes.files.mesh_file import load_mesh
from render.shared.errors import InputError


def linear(encoded: np.ndarray) -> np.ndarray:
    return np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)


def test_base_colour_is_srgb_and_the_others_are_linear(tmp_path):
    maps = support.write_maps(tmp_path)
    found = read(tmp_path)
    np.testing.assert_allclose(found.values[..., :3], linear(maps["Color"]), atol=0.01)
    np.testing.assert_allclose(found.values[..., 3], maps["Roughness"], atol=0.005)
    np.testing.assert_allclose(found.values[..., 4], maps["Metalness"], atol=0.005)
    normal = 2 * maps["NormalGL"] - 1
    np.testing.assert_allclose(found.slopes, -normal[..., :2] / normal[..., 2:], atol=1e-3)  # 16 bits


@pytest.mark.parametrize(
    "names",
    [("A_Color.png", "A_Roughness.png", "A_Metalness.png", "A_NormalGL.png", "A_NormalDX.png", "A_Displacement.png"),
     ("a_diff_2k.png", "a_rough_2k.png", "a_metal_2k.png", "a_nor_gl_2k.png", "a_nor_dx_2k.png", "a_disp_2k.png"),
     ("old_rough_metal_wood_diff_2k.jpg", "old_rough_metal_wood_rough_2k.jpg", "old_rough_metal_wood_metal_2k.jpg",
      "old_rough_metal_wood_nor_gl_2k.png", "old_rough_metal_wood_nor_dx_2k.png", "old_rough_metal_wood_height_2k.png"),
     ("A_1K-PNG_Color.png", "A_1K-PNG_Roughness.png", "A_1K-PNG_Metalness.png", "A_1K-PNG_NormalGL.png",
      "A_1K-PNG_NormalDX.png", "A_1K-PNG_Displacement.png")],
)  # fmt: skip
def test_maps_are_known_by_the_names_of_both_shops(tmp_path, names):
    for name in (*names, "A.png", "A_preview.usdc", "a_ao_2k.png"):
        (tmp_path / name).write_bytes(b"")
    maps = find(tmp_path)
    found = {kind: source.path.name for kind, source in maps.sources.items()}
    colour, rough, metal, gl, dx, height = names
    assert {path.name for path in maps.unused} == {"A.png", "a_ao_2k.png", dx}
    assert found == {"colour": colour, "roughness": rough, "metallic": metal, "normal": gl, "height": height}


def test_a_directx_normal_map_is_turned(tmp_path):
    (tmp_path / "gl").mkdir()
    (tmp_path / "dx").mkdir()
    maps = support.write_maps(tmp_path / "gl")
    flipped = maps["NormalGL"].copy()
    flipped[..., 1] = 1 - flipped[..., 1]
    support.write(tmp_path / "dx" / "T_Color.png", maps["Color"], 8)
    support.write(tmp_path / "dx" / "T_NormalDX.png", flipped, 16)
    np.testing.assert_allclose(read(tmp_path / "gl").slopes, read(tmp_path / "dx").slopes, atol=1e-3)


def test_a_height_map_gives_the_slopes_where_there_are_no_normals(tmp_path):
    size = 64
    u = (np.arange(size) + 0.5) / size
    height = np.tile(0.5 + 0.4 * np.sin(2 * np.pi * u), (size, 1))
    support.write(tmp_path / "T_Color.png", np.full((size, size, 3), 0.5), 8)
    support.write(tmp_path / "T_Displacement.png", height, 16)
    slopes = read(tmp_path).slopes
    expected = map_folder._DEPTH * 0.4 * 2 * np.pi * np.cos(2 * np.pi * u)
    np.testing.assert_allclose(slopes[..., 0], np.tile(expected, (size, 1)), atol=2e-3 * np.pi)
    np.testing.assert_allclose(slopes[..., 1], 0, atol=1e-6)


def test_pictures_are_looked_up_with_v_up_and_repeat(tmp_path):
    maps = support.write_maps(tmp_path)
    pictures, size = projections.Pictures(read(tmp_path)), support.SIZE
    row, column = (grid.ravel() for grid in np.mgrid[:size, :size])
    for shift in (0, 3, -2):
        u, v = (column + 0.5) / size + shift, 1 - (row + 0.5) / size - shift
        found = pictures.at(*(mi.Float(np.ascontiguousarray(part, np.float32)) for part in (u, v)))
        np.testing.assert_allclose(np.array(found[3]), maps["Roughness"].ravel(), atol=0.01)


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_maps_are_laid_on_along_the_main_direction(tmp_path, axis):
    """On a face of a cube: across and up of the picture run along the other two axes."""
    maps = support.write_maps(tmp_path)
    texture = cover.of_texture(library.load(f"maps:1:{tmp_path}"))
    u, v = projections.AXES[axis]
    row, column = (grid.ravel() for grid in np.mgrid[: support.SIZE, : support.SIZE])
    position, normal = np.zeros((row.size, 3)), np.zeros((row.size, 3))
    position[:, u], position[:, v] = (column + 0.5) / support.SIZE, 1 - (row + 0.5) / support.SIZE
    normal[:, axis] = 1
    arrays = [mi.Vector3f(*(mi.Float(np.ascontiguousarray(part, np.float32)) for part in values.T))
              for values in (position, normal)]  # fmt: skip
    place = cover.Place(*arrays, dr.zeros(mi.UInt32, row.size), mi.Point2f(0))
    slope = np.array(texture.slope(place), np.float64).T
    flat = (2 * maps["NormalGL"] - 1).reshape(-1, 3)
    np.testing.assert_allclose(slope[:, u], -flat[:, 0] / flat[:, 2], atol=2e-3)
    np.testing.assert_allclose(slope[:, v], -flat[:, 1] / flat[:, 2], atol=2e-3)
    np.testing.assert_allclose(slope[:, axis], 0, atol=1e-6)


def test_maps_follow_the_texture_coordinates_of_a_mesh(tmp_path):
    """A sheet in the plane x = 0.3 z whose u runs along y and v along z, read from a file with a seam in it."""
    support.write_maps(tmp_path)
    grid = np.array([(u, v) for v in np.linspace(0, 1, 5) for u in np.linspace(0, 1, 5)])
    points = np.stack([0.3 * grid[:, 1], grid[:, 0], grid[:, 1]], 1)
    corner = np.array([k for k in range(20) if k % 5 != 4])
    faces = np.concatenate(
        [np.stack([corner, corner + 1, corner + 6], 1), np.stack([corner, corner + 6, corner + 5], 1)]
    )
    lines = [f"v {x} {y} {z}" for x, y, z in points] + [f"vt {u} {v}" for u, v in grid]
    lines += ["f " + " ".join(f"{k + 1}/{k + 1}" for k in face) for face in faces]
    (tmp_path / "sheet.obj").write_text("\n".join(lines) + "\n", encoding="utf-8")
    mesh = load_mesh(tmp_path / "sheet.obj")
    assert mesh.uv is not None
    np.testing.assert_allclose(mesh.vertices[mesh.faces][..., 1:], mesh.uv, atol=1e-6)
    texture = cover.of_texture(library.load(f"uv:1:{tmp_path}"), mesh)
    rng = np.random.default_rng(0)
    prim, share = rng.integers(len(mesh.faces), size=500), rng.dirichlet([1, 1, 1], 500)
    uv = (mesh.uv[prim] * share[..., None]).sum(1)
    arrays = (mi.Vector3f(0, 0, 0), mi.Vector3f(1, 0, 0))  # not used
    corners = mi.Point2f(*(mi.Float(np.ascontiguousarray(share[:, k], np.float32)) for k in (1, 2)))
    place = cover.Place(*arrays, mi.UInt32(prim.astype(np.uint32)), corners)
    slope = np.array(texture.slope(place), np.float64).T
    pictures = projections.Pictures(read(tmp_path))
    found = pictures.at(*(mi.Float(np.ascontiguousarray(part, np.float32)) for part in uv.T))
    np.testing.assert_allclose(slope[:, 1], np.array(found[5]), atol=1e-4)
    along = np.array([0.3, 1]) / np.hypot(0.3, 1)  # v grows along the sheet
    np.testing.assert_allclose(slope[:, [0, 2]], np.array(found[6])[:, None] * along, atol=1e-4)
    with pytest.raises(InputError, match="no texture coordinates"):
        cover.of_texture(library.load(f"uv:1:{tmp_path}"), shapes.load("sphere"))


def test_bad_folders_end_in_a_line_that_names_file_and_remedy(tmp_path):
    with pytest.raises(InputError, match="no base colour map"):
        read(tmp_path)
    support.write_maps(tmp_path)
    (tmp_path / "Test_Displacement.exr").write_bytes(b"")
    with pytest.raises(InputError, match=r"Test_Displacement.exr: height: maps must be .png"):
        read(tmp_path)
    (tmp_path / "Test_Displacement.exr").unlink()
    support.write(tmp_path / "Test_Roughness.png", np.zeros((16, 32)), 8)
    with pytest.raises(InputError, match=r"Test_Roughness.png: 32x16 pixels, but Test_Color.png has 32x32"):
        read(tmp_path)
    (tmp_path / "Test_Roughness.png").write_bytes(b"no picture")
    with pytest.raises(InputError, match="damaged or not a picture"):
        read(tmp_path)
    (tmp_path / "Test_Roughness.png").unlink()
    support.write(tmp_path / "Other_Color.png", np.zeros((32, 32, 3)), 8)
    with pytest.raises(InputError, match=r"both Other_Color\.png and Test_Color\.png"):
        read(tmp_path)
