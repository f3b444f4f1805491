"""What the browser draws: Lambert's law, the refined model, and the mixing of images; and the command itself."""

import importlib.util
import json
import shutil
import subprocess
from pathlib import Path

import numpy as np
import photo_folders as folders
import pytest
import surface_scenes
from scipy.interpolate import RegularGridInterpolator
from sdps_scenes import hemisphere_lights

from pipelines import cli
from pipelines.app.pages import object_view
from pipelines.app.pages.object_view import shade_object
from pipelines.app.pages.reflectance_tables import build_tables
from pipelines.app.pages.studio_tasks import check_choice, make_training_preset, triangulate
from pipelines.shared import presets
from render.shared.errors import InputError
from render.shared.imaging.srgb import to_srgb
from sdps.api import infer, load
from sdps.core.geometry import Camera, Capture, reach

RNG = np.random.default_rng(0)


def test_a_white_matt_surface_that_faces_the_light_is_one() -> None:
    light = np.array([0.6, 0.0, 0.8])
    assert np.allclose(shade_object(light[None, None], np.ones((1, 1, 3)), np.zeros((1, 1)), {}, light), 1.0)


OBJECTS = {
    "plain": {"amplitudes": [0.5, 1.0], "sharpness": [20.0, 200.0], "body": [0.0] * 4, "modes": [0.0] * 6},
    "fabric": {"amplitudes": [0.1, 0.2], "sharpness": [10.0, 40.0], "body": [0.1, -0.2, 0.05, 0.3],
               "modes": [0.1, -0.5, 0.3, 0.1, -0.6, 0.2]},
    "rough and sharp": {"amplitudes": [3.0, 0.7, 0.1], "sharpness": [900.0, 150.0, 8.0],
                        "body": [-0.8, 0.6, -0.5, -0.4], "modes": [0.1, -0.2, 0.2, 0.1, -0.3, -0.2]},
}  # fmt: skip
LIGHTS = np.array([[0.0, 0.0, 1.0], [0.5, -0.3, 0.81], [-0.9, 0.2, 0.38], [0.1, 0.99, 0.09]])
LIGHTS /= np.linalg.norm(LIGHTS, axis=1, keepdims=True)


def ball(side: int = 96) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return normals (side, side, 3), albedo and highlight strength of a ball of two colours, shinier on one side."""
    y, x = np.mgrid[1 : -1 : side * 1j, -1 : 1 : side * 1j]
    inside = np.hypot(x, y) < 0.999
    normals = np.stack([x, y, np.sqrt(np.maximum(1 - x**2 - y**2, 0))], axis=-1) * inside[..., None]
    albedo = np.where((x > 0)[..., None], [0.8, 0.5, 0.2], [0.1, 0.3, 0.7]) * inside[..., None]
    return normals, albedo, (0.2 + 0.1 * y) * inside


@pytest.mark.parametrize("lobes", [{}, *OBJECTS.values()], ids=["Lambertian", *OBJECTS])
def test_each_pixel_may_have_a_light_of_its_own(lobes: dict) -> None:
    normals, albedo, strength = ball(24)
    owners = RNG.integers(len(LIGHTS), size=normals.shape[:2])
    found = shade_object(normals, albedo, strength, lobes, LIGHTS[owners])
    for number, light in enumerate(LIGHTS):
        own = owners == number
        assert np.allclose(found[own], shade_object(normals, albedo, strength, lobes, light)[own])


@pytest.mark.parametrize("flags", [{}, {"focal": "200px"}], ids=["orthographic", "perspective"])
def test_a_pixel_s_intensities_are_explained_under_near_lamps(tmp_path: Path, flags: dict) -> None:
    z, normals, mask = surface_scenes.sphere(64, 30.0, 0.9)
    lights = hemisphere_lights(12, np.random.default_rng(0))
    nearness = np.full(12, 0.25)
    camera = Camera(200.0) if flags else Camera()
    places = Capture.of(mask, camera).places(z - z[mask].mean())[mask]
    ways, falloff = reach(places, lights.astype(np.float64), nearness)
    images = np.zeros((12, *mask.shape, 3), np.float32)
    images[:, mask] = (np.maximum(np.einsum("pc,plc->pl", normals[mask], ways), 0) * falloff).T[..., None] * 0.3
    folders.write_folder(tmp_path / "near", images, mask)
    rows = "\n".join(f"{x} {y} {z}" for x, y, z in lights)
    (tmp_path / "lights.txt").write_text(rows)
    known = {"lights": tmp_path / "lights.txt", "intensities": "equal", "gamma": "linear"} | flags

    def view(distance: str) -> tuple[dict, float]:
        photos = load(tmp_path / "near", light_distance=distance, **known)
        result = infer(photos, "least-squares", refine=False)
        result.estimate.normals[:] = normals  # the method's own errors are not what is tested here
        (tmp_path / distance).mkdir()
        about = object_view.write(result, tmp_path / distance)
        names = ("observed", "model")
        observed, model = (np.load(tmp_path / distance / f"{name}.npy").astype(float)[mask] for name in names)
        return about, float(np.sqrt(((model - observed) ** 2).sum() / (observed**2).sum()))

    about, off = view("2.0")
    assert about["lamps"] == "the lamps stood about 2 object sizes away, as given" and about["distances"] == [2.0] * 12
    assert off < 0.01
    about, off = view("far")
    assert about["lamps"] == "the lamps stood far away, as given" and about["distances"] == []
    assert off > 0.1


def code(radiance: np.ndarray) -> np.ndarray:
    return np.rint(255 * to_srgb(np.clip(radiance, 0, 1)))


@pytest.mark.parametrize("lobes", OBJECTS.values(), ids=OBJECTS)
def test_the_tables_interpolate_to_what_they_were_evaluated_from(lobes: dict) -> None:
    about, data = build_tables(lobes)
    values = np.frombuffer(data, "<f4")
    size = 2 * np.prod(about["matte"])
    matte = grid(values[:size], about["matte"], [(-1, 1), (-1, 1), (0, np.arccosh(1 / about["least"]))])
    glossy = grid(values[size:], about["glossy"], [(0, 1), (0, 1)])
    normals, albedo, strength = ball()
    for light in LIGHTS:
        lit, seen = (np.maximum(part, about["least"]) for part in (normals @ light, normals[..., 2]))
        most = np.maximum(lit, seen)
        balance = (lit - seen) / np.maximum(most - about["least"], 1e-12)
        azimuth = (light[2] - lit * seen) / np.sqrt(np.maximum((1 - lit**2) * (1 - seen**2), 1e-12))
        tilt = np.sqrt(np.maximum(1 - (normals @ light + normals[..., 2]) / np.sqrt(2 + 2 * light[2]), 0))
        body, bent = matte(np.stack([azimuth.clip(-1, 1), balance, np.arccosh(1 / most)], axis=-1)).T
        shine, tilted = glossy(np.stack([np.full_like(tilt, light[2]), tilt.clip(0, 1)], axis=-1)).T
        bent = np.exp((bent + tilted).clip(-about["limit"], about["limit"])).T[..., None]
        reflected = albedo * np.exp(body.T)[..., None] + (strength * shine.T)[..., None]
        found = code(reflected * bent * np.maximum(normals @ light, 0)[..., None])
        expected = code(shade_object(normals, albedo, strength, lobes, light))
        assert np.abs(found - expected).max() <= 1, light


def grid(values: np.ndarray, sizes: list[int], ranges: list[tuple[float, float]]) -> RegularGridInterpolator:
    axes = [np.linspace(*ends, size) for ends, size in zip(ranges, sizes, strict=True)]
    return RegularGridInterpolator(axes, values.reshape(*sizes, 2))


@pytest.mark.skipif(shutil.which("node") is None, reason="needs node")
@pytest.mark.parametrize("lobes", [{}, *OBJECTS.values()], ids=["Lambertian", *OBJECTS])
def test_the_page_draws_what_python_evaluates(tmp_path: Path, lobes: dict) -> None:
    normals, albedo, strength = ball()
    parts = [
        np.rint(normals * 32767).astype("<i2"), np.rint(albedo * 65535).astype("<u2"),
        np.rint(strength * 65535).astype("<u2"),
    ]  # fmt: skip
    (tmp_path / "basis.bin").write_bytes(b"".join(part.tobytes() for part in parts))
    about, data = build_tables(lobes) if lobes else (None, b"")
    (tmp_path / "tables.bin").write_bytes(data)
    view = {"width": len(normals), "height": len(normals), "albedo": 1, "strength": 1, "tables": about}
    (tmp_path / "view.json").write_text(json.dumps(view | {"lights": LIGHTS.tolist()}))
    for name in ("relight.js", "jobs.js"):
        shutil.copy(Path(object_view.__file__).parents[1] / "static" / name, tmp_path / name)
    (tmp_path / "package.json").write_text('{"type": "module"}')
    (tmp_path / "draw.js").write_text(DRAW)
    subprocess.run(["node", "draw.js"], cwd=tmp_path, check=True)
    for number, light in enumerate(LIGHTS):
        drawn = np.frombuffer((tmp_path / f"{number}.bin").read_bytes(), np.uint8).reshape(*normals.shape[:2], 4)
        expected = code(shade_object(parts[0] / 32767, parts[1] / 65535, parts[2] / 65535, lobes, light))
        assert np.abs(drawn[..., :3] - expected).max() <= 1 and (drawn[..., 3] == 255).all(), light


DRAW = """
import { readFileSync, writeFileSync } from "node:fs";
import { Reflectance } from "./relight.js";
const bytes = (name) => new Uint8Array(readFileSync(name)).buffer, view = JSON.parse(readFileSync("view.json"));
const object = new Reflectance(bytes("basis.bin"), view, view.tables && bytes("tables.bin"));
view.lights.forEach((light, number) => {
  const createImageData = (width, height) => ({ data: new Uint8ClampedArray(4 * width * height) });
  const putImageData = ({ data }) => writeFileSync(`${number}.bin`, data);
  object.draw({ getContext: () => ({ createImageData, putImageData }) }, light);
});
"""


def test_triangles_cover_the_lights() -> None:
    lights = hemisphere_lights(40, RNG)
    assert set(np.ravel(triangulate(lights))) == set(range(40))
    assert triangulate(lights[:2]) == []


@pytest.mark.parametrize("name", ["/etc/passwd", "../x.ply", "bunny;rm", "meshes:1", ""])
def test_only_known_names_are_rendered(tmp_path, name: str) -> None:
    with pytest.raises(InputError, match="shape"):
        check_choice(tmp_path / "studio", shape=name, material="chrome")
    for material in ("/etc/passwd", "x.yaml", "maps:1:folder", "stripes:7:a.binary+b", "lambertian:../x"):
        with pytest.raises(InputError, match="material"):
            check_choice(tmp_path / "studio", shape="bunny", material=material)


def test_the_training_preset_can_be_loaded(tmp_path) -> None:
    text = make_training_preset(str(tmp_path), shape="blobby:4", material="stripes:7:chrome+nylon")
    (tmp_path / "my-scenes.yaml").write_text(text)
    assert presets.load(str(tmp_path / "my-scenes.yaml")).data.families == {"blobby": 200}
    with pytest.raises(InputError, match="many shapes"):
        make_training_preset(str(tmp_path), shape="bunny", material="chrome")


def test_a_missing_extra_is_one_line(monkeypatch: pytest.MonkeyPatch, capsys) -> None:
    found = importlib.util.find_spec
    monkeypatch.setattr(
        importlib.util, "find_spec", lambda name, *rest: None if name == "uvicorn" else found(name, *rest)
    )
    assert cli.main(["app", "--no-browser"]) == 2
    assert capsys.readouterr().err.strip() == "sdps: uvicorn missing: pip install sdps[app]"
