"""Maps, a mesh and relightable files of a saved result, held against the photographs they come from."""

import json
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image
from saved_results import save_result, sphere

from render.shared.errors import InputError
from render.shared.imaging.srgb import from_srgb
from sdps.core.geometry import ORTHOGRAPHIC, Camera, Capture, reach
from sdps.refinement.reflectance import SHAPES, shade
from sdps.surface.exports import gloss_exports
from sdps.surface.exports.gloss_exports import read_surface
from sdps.surface.exports.registry import write_exports
from sdps.surface.exports.saved_result import SavedLights, SavedResult, read_result
from sdps.surface.gloss.fitted_gloss import fit_materials
from sdps.surface.gloss.metallic_roughness import shade_gltf
from sdps.surface.gloss.relightable import expand_harmonics, expand_polynomial, spread_lights

LIGHTS = spread_lights(24).astype(np.float32)


def refined_result(folder: Path, camera: Camera = ORTHOGRAPHIC) -> SavedResult:
    """Return a ball with a highlight of roughness about 0.35, red on its left and blue on its right."""
    normals, mask, _ = sphere(camera=camera)
    save_result(folder, camera=camera)
    albedo = np.where(normals[..., :1] < 0.0, [1.8, 0.8, 0.4], [0.4, 0.8, 1.8]) * mask[..., None]
    np.save(folder / "albedo.npy", albedo.astype(np.float32))
    np.save(folder / "highlights.npy", mask.astype(np.float32))
    return read_result(folder)


def photographs(result: SavedResult) -> np.ndarray:  # (L, H, W, 3)
    surface = read_surface(result)
    pictures = np.zeros((len(LIGHTS), *result.shape, 3), np.float32)
    pictures[:, result.mask] = shade(result.normals[result.mask], LIGHTS, surface).transpose(2, 0, 1)
    return pictures


def load_material(path: Path) -> tuple[np.ndarray, list[np.ndarray]]:
    """Return a mesh file's vertices (v, 3), and at each of them base colour, metallic, roughness and normal."""
    (mesh,) = trimesh.load(path, process=False).geometry.values()
    material = mesh.visual.material
    right, down = mesh.visual.uv[:, 0], 1.0 - mesh.visual.uv[:, 1]

    def look_up(picture: Image.Image) -> np.ndarray:
        pixels = np.asarray(picture) / 255.0
        places = down * pixels.shape[0] - 0.5, right * pixels.shape[1] - 0.5
        assert all(np.abs(place - np.rint(place)).max() < 0.01 for place in places)  # each vertex at a pixel's centre
        return pixels[tuple(np.rint(place).astype(int) for place in places)]

    packed = look_up(material.metallicRoughnessTexture)
    normals = look_up(material.normalTexture) * 2.0 - 1.0
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    base = from_srgb(look_up(material.baseColorTexture)[:, :3])
    return mesh.vertices, [base, packed[:, 2], packed[:, 1], normals]


def test_maps_have_the_names_of_universal_methods(tmp_path: Path) -> None:
    result = refined_result(tmp_path)
    made = write_exports(result, ["materials"], tmp_path / "out")
    assert [path.name for path in made] == ["baseColor.png", "roughness.png", "metallic.png", "material.json"]
    base, roughness, metallic = (np.asarray(Image.open(path)) / 255.0 for path in made[:3])
    assert base.shape == (*result.shape, 3)
    assert base[30, 15, 0] > base[30, 15, 2]
    assert base[30, 45, 0] < base[30, 45, 2]
    assert 0.25 < roughness[30, 30] < 0.45
    assert metallic.max() == 0.0
    facts = json.loads(made[3].read_text())
    assert facts["median_roughness"] == pytest.approx(roughness[30, 30], abs=0.01)


@pytest.mark.parametrize("camera", [ORTHOGRAPHIC, Camera(200.0)])
def test_a_glb_shaded_as_gltf_says_looks_like_the_photographs(tmp_path: Path, camera: Camera) -> None:
    result = refined_result(tmp_path, camera)
    (path,) = write_exports(result, ["gltf"], tmp_path / "out")
    places, (base, metallic, roughness, normals) = load_material(path)
    photographed = photographs(result)[:, result.mask]
    assert len(places) == photographed.shape[1]
    assert np.abs(normals - result.normals[result.mask]).max() < 0.02
    shaded = np.stack([shade_gltf(normals, light, base, metallic, roughness) for light in LIGHTS])
    scale = (shaded * photographed).sum() / (shaded**2).sum()
    off = np.linalg.norm(scale * shaded - photographed) / np.linalg.norm(photographed)
    assert off < 0.08


def test_a_glb_names_its_tangents_and_textures(tmp_path: Path) -> None:
    (path,) = write_exports(refined_result(tmp_path), ["gltf"], tmp_path / "out")
    data = path.read_bytes()
    tree = json.loads(data[20 : 20 + int.from_bytes(data[12:16], "little")])
    (part,) = tree["meshes"][0]["primitives"]
    assert set(part["attributes"]) == {"POSITION", "NORMAL", "TANGENT", "TEXCOORD_0"}
    assert tree["accessors"][part["attributes"]["TANGENT"]]["type"] == "VEC4"
    assert set(tree["materials"][0]["pbrMetallicRoughness"]) >= {"baseColorTexture", "metallicRoughnessTexture"}
    assert "normalTexture" in tree["materials"][0]


@pytest.mark.parametrize("kind", ["ptm", "rti"])
def test_relightable_files_are_of_the_photographs_or_else_relit(tmp_path: Path, kind: str) -> None:
    result = refined_result(tmp_path)
    write_exports(result, [kind], tmp_path / "relit")
    gains = np.linspace(0.5, 2.0, len(LIGHTS)).astype(np.float32)
    lights = SavedLights(tuple(map(str, range(len(LIGHTS)))), LIGHTS, gains)
    pictures = photographs(result) * gains[:, None, None, None]
    write_exports(replace(result, lights=lights, pictures=pictures), [kind], tmp_path / "seen")
    relit, seen = (json.loads((tmp_path / name / kind / f"{kind}.json").read_text()) for name in ("relit", "seen"))
    assert relit["of"].startswith("refined reflectance")
    assert (seen["of"], seen["lights"]) == ("photographs", len(LIGHTS))
    assert max(relit["rms_error"], seen["rms_error"]) < 0.1


@pytest.mark.parametrize(("kind", "writer"), [("ptm", "write_ptm"), ("rti", "write_rti")])
def test_relightable_files_know_near_lamps(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kind: str, writer: str
) -> None:
    """Photographs under near lamps, shown under distant ones, look like photographs under these."""
    result, nearness = refined_result(tmp_path), np.full(len(LIGHTS), 0.3)
    capture, normals, surface = Capture.of(result.mask), result.normals[result.mask], read_surface(result)
    towards, falloff = reach(capture.places(result.depth)[result.mask], LIGHTS.astype(np.float64), nearness)
    shown = shade(normals, towards.astype(np.float32), surface) * falloff[:, None]
    pictures = np.zeros((len(LIGHTS), *result.shape, 3), np.float32)
    pictures[:, result.mask] = shown.transpose(2, 0, 1)
    wanted = shade(normals, LIGHTS, surface).transpose(2, 0, 1)
    expand = expand_polynomial if kind == "ptm" else partial(expand_harmonics, terms=9)
    written: list[np.ndarray] = []
    monkeypatch.setattr(gloss_exports, writer, lambda _, numbers, __: written.append(numbers))
    errors = []
    for known in (nearness, None):
        lights = SavedLights(tuple(map(str, range(len(LIGHTS)))), LIGHTS, np.ones(len(LIGHTS), np.float32), known)
        write_exports(replace(result, lights=lights, pictures=pictures), [kind], tmp_path / "out")
        found = from_srgb(np.tensordot(expand(LIGHTS), written[-1], 1).clip(0.0, 1.0))
        scale = (found * wanted).sum() / (wanted**2).sum()
        errors.append(np.linalg.norm(found - scale * wanted) / np.linalg.norm(found))
    assert errors[0] < 0.8 * errors[1]


def test_materials_are_fitted_one_time_for_all_that_want_them(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    fitted = []
    monkeypatch.setattr(gloss_exports, "fit_materials", lambda part: fitted.append(1) or fit_materials(part))
    write_exports(refined_result(tmp_path), ["materials", "gltf"], tmp_path / "out")
    assert len(fitted) == 1


@pytest.mark.parametrize("seen", [False, True])
def test_large_relightable_pictures_are_thinned(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, seen: bool) -> None:
    result = refined_result(tmp_path)
    monkeypatch.setattr(gloss_exports, "MOST_PIXELS", result.mask.sum() // 3)
    if seen:
        lights = SavedLights(tuple(map(str, range(len(LIGHTS)))), LIGHTS, np.ones(len(LIGHTS), np.float32))
        result = replace(result, lights=lights, pictures=photographs(result))
    path, about = write_exports(result, ["ptm"], tmp_path / "out")
    assert path.read_bytes().split(b"\n")[2:4] == [b"31", b"31"]
    assert json.loads(about.read_text())["every"] == 2


@pytest.mark.parametrize("name", ["materials", "gltf", "ptm"])
def test_what_was_not_refined_is_refused(tmp_path: Path, name: str) -> None:
    with pytest.raises(InputError, match=r"nothing was refined.*sdps infer --refine"):
        write_exports(save_result(tmp_path, albedo=False), [name], tmp_path / "out")


@pytest.mark.parametrize("part", ["channels", "body", "modes"])
@pytest.mark.parametrize("value", [None, [1.0], "words", [[1.0, 2.0, 3.0]], {}, [0.0, 0.0, 0.0]])
def test_a_reflectance_that_is_damaged_or_of_an_earlier_version_is_refused(
    tmp_path: Path, part: str, value: object
) -> None:
    result = refined_result(tmp_path)
    result.facts["refined"][part] = value
    with pytest.raises(InputError, match=r"result\.json: its reflectance is of an earlier version"):
        write_exports(result, ["materials"], tmp_path / "out")


def test_a_reflectance_that_is_not_finite_is_refused(tmp_path: Path) -> None:
    result = refined_result(tmp_path)
    result.facts["refined"]["body"] = [float("nan")] * SHAPES
    with pytest.raises(InputError, match="not finite"):
        write_exports(result, ["rti"], tmp_path / "out")
