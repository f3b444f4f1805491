"""What `import render` and `import sdps` offer: names, docstrings, what they load, and what they compute."""

import ast
import importlib
import inspect
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import trimesh

import render
import sdps

ROOT = Path(__file__).resolve().parent.parent
OFFERED = [(package, name) for package in (render, sdps) for name in package.__all__]
SMALL = {"size": 32, "spp": 16}


def homes(package) -> dict[str, str]:
    """Return the module of every name that a package imports for type checkers."""
    tree = ast.parse(Path(package.__file__).read_text(encoding="utf-8"))
    (block,) = (node for node in tree.body if isinstance(node, ast.If))
    return {alias.name: node.module for node in block.body for alias in node.names}


@pytest.mark.parametrize(("package", "name"), OFFERED, ids=lambda value: getattr(value, "__name__", value))
def test_every_name_is_there_and_explained(package, name):
    value = getattr(package, name)
    assert value is getattr(importlib.import_module(homes(package)[name]), name)
    assert inspect.getdoc(value)


@pytest.mark.parametrize("package", [render, sdps])
def test_checkers_readers_and_python_see_the_same_names(package):
    assert set(package.__all__) == homes(package).keys() <= set(dir(package))
    with pytest.raises(AttributeError, match="no attribute 'rendr'"):
        _ = package.rendr


def test_importing_loads_neither_torch_nor_mitsuba():
    code = (
        "import sys, render, sdps\n"
        "assert not {'numpy', 'torch', 'mitsuba', 'drjit'} & set(sys.modules)\n"
        "sdps.InputError, sdps.Estimate, sdps.integrate, sdps.load, sdps.score\n"
        "assert not {'torch', 'mitsuba', 'drjit'} & set(sys.modules)\n"
        "for name in render.__all__: getattr(render, name)\n"
        "assert not {'torch', 'mitsuba', 'drjit'} & set(sys.modules)\n"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, check=False, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


# ---- render ------------------------------------------------------------------------------------------


def test_a_white_sphere_has_the_cosine_for_radiance():
    lights = np.array([[0.0, 0.0, 2.0], [0.6, 0.0, 0.8], [0.0, 0.6, 0.8]])
    view = render.render_view("sphere", "lambertian:1", lights, size=64, spp=64, scale=1.0)
    assert view.images.shape == (3, 64, 64, 3) and view.images.dtype == np.float32
    np.testing.assert_allclose(view.light_directions, [[0, 0, 1], [0.6, 0, 0.8], [0, 0.6, 0.8]], atol=1e-6)
    # Rows run down and y up; z points to the camera.
    centres = (2 * np.arange(64) + 1) / 64 - 1
    x, y = np.meshgrid(centres, -centres)
    inside = x**2 + y**2 < 0.8
    truth = np.stack([x, y, np.sqrt(np.where(inside, 1 - x**2 - y**2, 0))], axis=-1)
    np.testing.assert_allclose(view.normals[inside], truth[inside], atol=0.01)
    np.testing.assert_allclose(view.depth[inside], truth[inside][:, 2], atol=0.01)
    for image, light in zip(view.images, view.light_directions, strict=True):
        cosine = np.maximum(truth[inside] @ light, 0)[:, None]
        np.testing.assert_allclose(image[inside], np.broadcast_to(cosine, (inside.sum(), 3)), atol=0.03)
        assert abs((image[inside] - cosine).mean()) < 2e-3
    assert not view.normals[~view.mask].any() and view.mask.mean() == pytest.approx(np.pi / 4, abs=0.01)


def test_meshes_of_ones_own_turn_and_move():
    bar = trimesh.creation.box((2.0, 0.6, 0.6))
    before = bar.vertices.copy()
    lying = render.render_view(bar, "lambertian:0.5", [0, 0, 1], **SMALL)
    turned = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    standing = render.render_view(bar, "lambertian:0.5", [0, 0, 1], rotation=turned, **SMALL)
    np.testing.assert_array_equal(lying.mask.sum(0), standing.mask.sum(1)[::-1])
    assert lying.mask.any(0).sum() > 2 * lying.mask.any(1).sum()
    np.testing.assert_array_equal(bar.vertices, before)
    moved = render.render_view(bar, "lambertian:0.5", [0, 0, 1], scale=0.4, offset=(0.5, 0.5), **SMALL)
    rows, columns = np.nonzero(moved.mask)
    assert rows.mean() < 12 and columns.mean() > 20  # up and to the right


def test_materials_share_the_rays_of_a_view(tmp_path):
    names = ["lambertian:0.8", "stripes:3:lambertian:0.2+lambertian:0.6"]
    plain, striped = render.render_views("sphere", names, "near-uniform:4", bounces=0, **SMALL)
    assert plain.weights is None and striped.weights.shape == (2, 32, 32)
    np.testing.assert_array_equal(plain.normals, striped.normals)
    ratio = striped.images[:, plain.mask].sum((0, 2)) / plain.images[:, plain.mask].sum((0, 2))
    assert ratio.min() == pytest.approx(0.25, abs=0.02) and ratio.max() == pytest.approx(0.75, abs=0.02)
    render.write_shard(tmp_path / "striped.exr", striped.shard("striped"))
    read = render.read_shard(tmp_path / "striped.exr")
    assert read.scene_id == "striped" and read.materials == ("lambertian:0.2", "lambertian:0.6")
    np.testing.assert_array_equal(read.images, striped.images.astype(np.float16))
    np.testing.assert_array_equal(read.normals, striped.normals)


def test_a_brdf_of_ones_own_is_fitted_and_kept(tmp_path):
    file = tmp_path / "mine.yaml"
    fitted = render.fit_material(file, lambda wi, wo: np.full(wi.shape, 0.5 / np.pi), source="a test")
    assert fitted.name == "mine" and fitted.fit_error < 0.01
    light = [0.3, 0.2, 1]
    ours, same, exact = render.render_views("sphere", [fitted, file, "lambertian:0.5"], light, bounces=0, **SMALL)
    np.testing.assert_array_equal(ours.images, same.images)
    np.testing.assert_allclose(ours.images[0, ours.mask], exact.images[0, ours.mask], atol=0.01)


def test_a_plan_is_rendered_once(tmp_path):
    config = render.DataConfig(
        families={"blobby": 1}, views=1, materials_per_view=2, validation=0.0, light_count=3, size=16, spp=4
    )
    scenes = render.plan(config)
    shards = render.render_plan(scenes, tmp_path)
    assert render.read_manifest(tmp_path) == scenes and [path.stem for path in shards] == [one.id for one in scenes]
    assert render.read_shard(shards[0], scenes[0]).images.shape == (3, 16, 16, 3)
    assert render.validate(tmp_path).checked == 2
    times = [path.stat().st_mtime_ns for path in shards]
    assert [path.stat().st_mtime_ns for path in render.render_plan(scenes, tmp_path)] == times
    with pytest.raises(render.InputError, match="holds another plan"):
        render.render_plan(scenes[:1], tmp_path)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: render.render_view("spher", "chrome", "merltest"), "did you mean 'sphere'"),
        (lambda: render.render_view("sphere", "crome", "merltest"), "did you mean 'chrome'"),
        (lambda: render.render_view("sphere", 7, "merltest"), "give a name, a file"),
        (lambda: render.render_view("sphere", "chrome", "merl"), "light set 'merl'"),
        (lambda: render.render_view("sphere", "chrome", [[0, 0, 1], [0, 1, -1]]), "light 2 is below the horizon"),
        (lambda: render.render_view("sphere", "chrome", [0, 0, 1], size=0), "size and spp must be at least 1"),
        (lambda: render.render_view("sphere", "chrome", [0, 0, 1], rotation=-np.eye(3)), "does not mirror"),
        (lambda: render.render_view("sphere", "chrome", [0, 0, 1], offset=(9, 9), size=16, spp=4), "outside the frame"),
        (lambda: render.shape(trimesh.Trimesh()), "contains no triangles"),
        (lambda: render.fit_material("mine.txt", lambda wi, wo: wi), "must end in .yaml"),
        (lambda: render.fit_material("mine.yaml", lambda wi, wo: wi[:, 0]), "brdf: must give"),
        (lambda: render.render_plan([], "nowhere"), "the plan is empty"),
        (lambda: sdps.train("lcnett", "data", "out"), "did you mean 'lcnet'"),
        (lambda: sdps.train("lcnet", "data", "out", step=3), "did you mean"),
        (lambda: sdps.estimate(np.ones((4, 8, 8, 3)), np.ones((8, 8), bool), "least-squares"), "needs the lights"),
    ],
)
def test_mistakes_are_one_line(call, message):
    with pytest.raises(render.InputError, match=message) as mistake:
        call()
    assert "\n" not in str(mistake.value)
    assert render.InputError is sdps.InputError


# ---- sdps --------------------------------------------------------------------------------------------


def test_from_images_to_a_mesh(tmp_path):
    lights = render.lights("diligent")[::6]  # all within 45 degrees of the camera
    view = render.render_view("sphere", "lambertian:0.7", lights, bounces=0, size=48, spp=16)
    found = sdps.estimate(view.images, view.mask, "robust-least-squares", light_directions=view.light_directions)
    assert isinstance(found, sdps.Estimate)
    errors = {item.name: item.value for item in sdps.score(found, view.mask, normals=view.normals)}
    assert errors["normal_mae"] < 3
    depth = sdps.integrate(found.normals, view.mask)
    off = depth.z[view.mask] / 24 - view.depth[view.mask]  # pixels against half image widths
    assert np.abs(off - np.median(off)).mean() < 0.05
    sdps.write_mesh(sdps.mesh(depth, normals=found.normals), tmp_path / "sphere.ply")
    assert len(trimesh.load(tmp_path / "sphere.ply").faces) > 1000
    picture, inside = sdps.relit(view.normals, 0.7, lights[0]), view.coverage == 1
    assert picture.shape == (48, 48, 3)
    np.testing.assert_allclose(picture[inside], view.images[0, inside], atol=0.05)


def test_methods_that_can_be_used_are_listed():
    about = sdps.available_methods()
    assert {"sdps", "lcnet", "pf14", "least-squares"} <= about.keys() and all(about.values())
    assert not {"true", "lcnet-reg"} & about.keys()  # not a method by itself, and without weights


@pytest.mark.parametrize(
    ("lit", "refine", "images", "expected"),
    [
        (False, False, 96, "sdps-frames (lightset + frames)"),
        (False, None, 3, "sdps-frames (lightset + frames)"),  # too few to refine
        (False, None, 96, "sdps-frames (lightset + frames), fused"),
        (False, True, 7, "sdps-frames (lightset + frames), fused"),
        (True, False, 96, "frames, given lights"),
        (True, None, 96, "frames, given lights, fused"),
    ],
)
def test_the_automatic_method_depends_on_what_follows(
    lit: bool, refine: bool | None, images: int, expected: str
) -> None:
    from sdps.api import make_runner

    assert (
        make_runner("auto", (lit, False), None, None, refine, images).method.name.replace(" (shipped)", "") == expected
    )


def test_intensities_without_directions_are_used() -> None:
    """They were left unused without a word."""
    from sdps.api import make_runner

    runner = make_runner("auto", (False, True), None, None)
    assert runner.method.intensities == "true"


@pytest.mark.parametrize(("method", "known"), [("lcnet+psfcn", (True, False)), ("pf14", (False, True))])
def test_what_a_method_does_not_look_at_is_said(
    caplog: pytest.LogCaptureFixture, method: str, known: tuple[bool, bool]
) -> None:
    from sdps.api import make_runner

    make_runner(method, known, None, None)
    assert "those given are not used" in caplog.text
