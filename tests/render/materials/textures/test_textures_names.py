"""Names of maps that shops and programs give; what is not used is said; what is used is seen in the render."""

import numpy as np
import pytest
import textures_support as support
import tifffile
from PIL import Image

import render
from render.materials.textures import map_folder, map_names
from render.materials.textures.map_folder import read
from render.materials.textures.map_names import find
from render.shared.errors import InputError

SIZE = support.SIZE
ORM, GLTF = {"roughness": 1, "metallic": 2}, {"roughness": 1, "metallic": 2}
RMA, MRA = {"roughness": 0, "metallic": 1}, {"roughness": 1, "metallic": 0}


@pytest.fixture(autouse=True)
def nothing_said_before(monkeypatch):
    monkeypatch.setattr(map_folder, "_said", set())


def touch(folder, *names):
    for name in ("A_Color.png", *names):
        (folder / name).write_bytes(b"")


@pytest.mark.parametrize(
    "name",
    [
        "Floor_Albedo.png",
        "base color.png",
        "T_Rock_BC.tga",
        "rock_Base_Color_2048x2048.tif",
        "brick-diffuse-map.jpg",
        "Rock_Diffuse_4k.webp",
        "BaseColor.png",
        "rock_basecolor_srgb.bmp",
    ],
)
def test_base_colours(tmp_path, name):
    (tmp_path / name).write_bytes(b"")
    assert find(tmp_path).sources["colour"].path.name == name


@pytest.mark.parametrize(
    ("name", "convention"),
    [
        ("Floor_Normal.png", ""),
        ("floor_normal_2k.jpg", ""),
        ("FloorNormal.png", ""),
        ("T_Floor_N.tga", ""),
        ("normal.png", ""),
        ("floor_normalmap.png", ""),
        ("Floor_Normal_16bit.png", ""),
        ("f_nrm.png", ""),
        ("f_nor_gl_4k.png", "gl"),
        ("f_NormalGL.png", "gl"),
        ("f_Normal_OpenGL.png", "gl"),
        ("f_NormalOpenGL.png", "gl"),
        ("f_normal-ogl.png", "gl"),
        ("f_NormalDX.png", "dx"),
        ("f_normal_directx_2k.png", "dx"),
        ("f_NormalDirectX.png", "dx"),
        ("f_DX_Normal.png", "dx"),
        ("f_normalmap_dx.png", "dx"),
        ("f_nor_dx_1k.jpg", "dx"),
    ],
)
def test_normal_maps_and_the_way_of_their_green(tmp_path, name, convention):
    touch(tmp_path, name)
    source = find(tmp_path).sources["normal"]
    assert (source.path.name, source.convention) == (name, convention)


@pytest.mark.parametrize(
    ("name", "channels"),
    [
        ("Floor_ORM.png", ORM),
        ("floor_arm_2k.jpg", ORM),
        ("f_AORM.png", ORM),
        ("f_OcclusionRoughnessMetallic.png", ORM),
        ("f_occlusionRoughnessMetallic.png", ORM),
        ("f_ao_rough_metal.png", ORM),
        ("f_occlusion_roughness_metalness.png", ORM),
        ("f_MetallicRoughness.png", GLTF),
        ("f_metallic-roughness.png", GLTF),
        ("f_metalRough.png", GLTF),
        ("f_RMA.tga", RMA),
        ("f_rmao.png", RMA),
        ("f_RoughnessMetallicAO.png", RMA),
        ("f_MRA.png", MRA),
        ("f_MRAO_4k.png", MRA),
        ("f_OMR.png", {"roughness": 2, "metallic": 1}),
        ("f_MetallicSmoothness.png", {"metallic": 0, "roughness": 3}),
    ],
)
def test_pictures_of_several_maps(tmp_path, name, channels):
    touch(tmp_path, name)
    maps = find(tmp_path)
    found = {kind: source.channel for kind, source in maps.sources.items() if kind != "colour"}
    assert found == channels and not maps.unused
    assert maps.paths == (tmp_path / "A_Color.png", tmp_path / name)
    assert maps.sources["roughness"].inverted == ("Smooth" in name)


@pytest.mark.parametrize(
    ("name", "kind"),
    [
        ("rusty_metal_rough_1k.png", "roughness"),
        ("rusty_metal_roughness.png", "roughness"),
        ("brushed_rough_metal_2k.png", "metallic"),
        ("wood_normal_height.png", "height"),
        ("f_bump.png", "height"),
    ],
)
def test_the_last_word_counts_where_the_asset_is_called_like_a_map(tmp_path, name, kind):
    touch(tmp_path, name)
    assert {kind: source.channel for kind, source in find(tmp_path).sources.items()} == {"colour": None, kind: None}


@pytest.mark.parametrize(
    "name",
    [
        "f_AO.png",
        "f_Mask_Map.png",
        "f_SpecularGlossiness.png",
        "f_emissive.jpg",
        "preview.png",
        "Metal049A.png",
        "metal_plates.webp",
        "f_opacity.exr",
        "thumb.gif",
    ],
)
def test_every_other_picture_is_named_on_the_console(tmp_path, name, caplog):
    support.write_maps(tmp_path)
    (tmp_path / name).write_bytes(b"")
    (tmp_path / "notes.txt").write_text("no picture")
    for _ in range(2):
        read(tmp_path)
    assert [record.getMessage() for record in caplog.records] == [f"{tmp_path}: not used: {name}"]


def test_a_map_of_its_own_goes_before_a_channel(tmp_path):
    touch(tmp_path, "A_ORM.png", "A_Roughness.png", "A_NormalGL.png", "A_Normal.png", "A_NormalDX.png", "A_RMA.png")
    maps = find(tmp_path)
    assert {kind: source.path.name for kind, source in maps.sources.items()} == {
        "colour": "A_Color.png",
        "roughness": "A_Roughness.png",
        "metallic": "A_ORM.png",
        "normal": "A_NormalGL.png",
    }
    assert [path.name for path in maps.unused] == ["A_Normal.png", "A_NormalDX.png", "A_RMA.png"]
    touch(tmp_path, "B_ORM.png")
    with pytest.raises(InputError, match=r"metallic: both A_ORM\.png and B_ORM\.png; keep one of them"):
        find(tmp_path)


def test_without_base_colour_the_pictures_there_are_named(tmp_path):
    (tmp_path / "stone_spec.png").write_bytes(b"")
    with pytest.raises(InputError, match=r"no base colour map; expected .*, found stone_spec\.png"):
        find(tmp_path)


def height_field(down=False):
    """Write nothing; return the normal map of a relief with slopes in both directions, (SIZE, SIZE, 3) in [0, 1]."""
    v, u = (grid / SIZE for grid in np.mgrid[:SIZE, :SIZE])
    along_u = 0.8 * np.cos(2 * np.pi * (u + v))
    along_v = -along_u  # the picture's v is up
    normal = np.stack([-along_u, -along_v * (-1 if down else 1), np.ones_like(u)], -1)
    return (normal / np.linalg.norm(normal, axis=-1, keepdims=True) + 1) / 2


@pytest.mark.parametrize("down", [False, True])
def test_a_plain_normal_map_is_opengl_and_the_console_says_so(tmp_path, caplog, down):
    support.write(tmp_path / "F_Color.png", np.full((SIZE, SIZE, 3), 0.5), 8)
    support.write(tmp_path / "F_Normal.png", height_field(down), 8)
    plain = read(tmp_path).slopes
    message = f"{tmp_path / 'F_Normal.png'}: taken as OpenGL, green up; "
    message += (
        "but its slopes fit together better with green down: if so, name it _NormalDX"
        if down
        else ("name it _NormalDX if green is down")
    )
    assert [record.getMessage() for record in caplog.records] == [message]
    (tmp_path / "F_Normal.png").rename(tmp_path / "F_NormalGL.png")
    np.testing.assert_array_equal(read(tmp_path).slopes, plain)
    (tmp_path / "F_NormalGL.png").rename(tmp_path / "F_NormalDX.png")
    np.testing.assert_allclose(read(tmp_path).slopes, plain * [1, -1], atol=1e-6)
    assert len(caplog.records) == 1


def packed_folder(folder, red=1.0, green=0.3, blue=0.0):
    folder.mkdir()
    support.write(folder / "F_Albedo.png", np.full((SIZE, SIZE, 3), 0.5), 8)
    support.write(folder / "F_ORM.png", np.broadcast_to([red, green, blue], (SIZE, SIZE, 3)), 8)
    return folder


def rendered(folder, **options):
    lights = [[0, 0, 1], [0.5, 0, 0.8], [0, 0.5, 0.8]]
    return render.render_view("sphere", str(folder), lights, size=32, spp=16, bounces=0, **options)


def test_roughness_comes_from_green_and_metallic_from_blue(tmp_path):
    shiny = rendered(packed_folder(tmp_path / "shiny")).images
    np.testing.assert_array_equal(rendered(packed_folder(tmp_path / "occluded", red=0.1)).images, shiny)
    rough = rendered(packed_folder(tmp_path / "rough", green=0.9)).images
    metal = rendered(packed_folder(tmp_path / "metal", blue=1.0)).images
    assert shiny.max() > 1.5 * rough.max()  # the highlight
    assert np.median(metal[0][16, 16:]) < 0.5 * np.median(shiny[0][16, 16:])  # no diffuse base
    alone = tmp_path / "alone"
    alone.mkdir()
    support.write(alone / "F_Albedo.png", np.full((SIZE, SIZE, 3), 0.5), 8)
    support.write(alone / "F_Roughness.png", np.full((SIZE, SIZE), 0.3), 8)
    np.testing.assert_array_equal(rendered(alone).images, shiny)


def test_the_relief_of_a_plain_normal_map_is_seen(tmp_path):
    smooth = rendered(packed_folder(tmp_path / "floor")).normals
    support.write(tmp_path / "floor" / "F_Normal.png", height_field(), 8)
    relief = rendered(tmp_path / "floor")
    angle = np.degrees(np.arccos(np.clip((smooth * relief.normals).sum(-1), -1, 1)))[relief.mask]
    assert angle.mean() > 10


def test_gloss_is_the_opposite_of_roughness_and_alpha_of_colours_is_left_out(tmp_path):
    rough = np.linspace(0, 1, SIZE)[None].repeat(SIZE, 0)
    rgba = np.full((SIZE, SIZE, 4), 128, np.uint8)
    Image.fromarray(rgba).save(tmp_path / "F_Color.png")
    support.write(tmp_path / "F_Gloss.png", 1 - rough, 8)
    found = read(tmp_path)
    np.testing.assert_allclose(found.values[..., 3], rough, atol=0.003)
    np.testing.assert_allclose(found.values[..., :3], ((128 / 255 + 0.055) / 1.055) ** 2.4, atol=1e-4)
    (tmp_path / "F_Gloss.png").unlink()
    rgba[..., 0], rgba[..., 3] = 255, np.rint(255 * (1 - rough))
    Image.fromarray(rgba).save(tmp_path / "F_MetallicSmoothness.png")
    found = read(tmp_path)
    np.testing.assert_allclose(found.values[..., 3], rough, atol=0.003)
    np.testing.assert_array_equal(found.values[..., 4], 1)
    Image.fromarray(rgba[..., :3]).save(tmp_path / "F_MetallicSmoothness.png")
    with pytest.raises(InputError, match=r"F_MetallicSmoothness\.png: roughness: 3 channel\(s\) where 4 are needed"):
        read(tmp_path)


def test_what_is_wrong_with_a_picture_is_said_in_one_line(tmp_path, recwarn):
    Image.new("L", (16000, 6000)).save(tmp_path / "F_Color.png")
    with pytest.raises(InputError, match=r"F_Color\.png: 16000x6000 pixels; maps may have 2 to 4096 a side|announces"):
        read(tmp_path)
    assert not recwarn.list
    tifffile.imwrite(tmp_path / "F_Color.tif", np.zeros((SIZE, SIZE, 3), np.float32), photometric="rgb")
    (tmp_path / "F_Color.png").unlink()
    with pytest.raises(
        InputError, match=r"F_Color\.tif: damaged or not a picture \(cannot identify image file\); copy"
    ):
        read(tmp_path)


def test_a_grey_base_colour_is_repeated_and_a_grey_normal_map_refused(tmp_path):
    support.write(tmp_path / "F_Color.png", np.full((SIZE, SIZE), 0.5), 8)
    assert np.ptp(read(tmp_path).values[..., :3]) == 0
    support.write(tmp_path / "F_NormalGL.png", np.full((SIZE, SIZE), 0.5), 8)
    with pytest.raises(InputError, match=r"F_NormalGL\.png: normal: 1 channel\(s\) where 3 are needed; save it as RGB"):
        read(tmp_path)


@pytest.mark.parametrize("suffix", map_names.SUFFIXES)
def test_kinds_of_pictures(tmp_path, suffix):
    colours = np.arange(SIZE * SIZE * 3, dtype=np.uint8).reshape(SIZE, SIZE, 3) // 16 * 16 + 8
    options = {"lossless": True} if suffix == ".webp" else {"quality": 100} if "jp" in suffix else {}
    Image.fromarray(np.repeat(np.repeat(colours[::16, ::16], 16, 0), 16, 1)).save(
        tmp_path / f"F_Color{suffix}", **options
    )
    expected = np.repeat(np.repeat(colours[::16, ::16], 16, 0), 16, 1) / 255
    found = read(tmp_path).values[..., :3]
    expected = np.where(expected <= 0.04045, expected / 12.92, ((expected + 0.055) / 1.055) ** 2.4)
    np.testing.assert_allclose(found, expected, atol=0.1 if "jp" in suffix else 1e-5)
