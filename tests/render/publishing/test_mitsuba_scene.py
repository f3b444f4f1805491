"""Saved scenes, rendered by a Mitsuba that knows nothing of this project, against the many-light renderer."""

import logging
import os
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import render_support as support
from scipy import stats

from render import shapes
from render.backend import variant
from render.kernel import many_lights, scene
from render.materials import library, merl, model, rgl
from render.materials.kernels.packed import pack
from render.planning import light_sets
from render.publishing import mitsuba_scene, pattern_mesh
from render.records.manifest import SceneSpec, View
from render.shapes.geometry.mesh import face_normals
from render.shared.decoding import exr_parts
from render.shared.errors import InputError

_log = logging.getLogger(__name__)

LIGHTS = support.unit([0.2, 0.1, 1], [1.2, 0.3, 0.5], [-0.4, -1.5, 0.8])
VIEW = View(rotation=(0.8, 0, 0.6, 0, 1, 0, -0.6, 0, 0.8), scale=0.9, offset=(0.05, -0.1))
PLAIN = SceneSpec(
    id="bowl",
    seed=0,
    split="test",
    shape="bowl",
    material="lambertian:0.9/0.5/0.1",
    view=VIEW,
    lights=tuple(tuple(map(float, light)) for light in LIGHTS),
    size=12,
    spp=144,
    bounces=2,
)
REPEATS = 12
STOCK = """
import sys
import numpy as np
import mitsuba as mi

mi.set_variant(sys.argv[1])
seeds = int(sys.argv[2])
for folder in sys.argv[3:]:
    images = []
    for line in open(folder + "/lights.txt"):
        x, y, z, *intensity = map(float, line.split())
        own = {"intensity": intensity[0]} if intensity else {}
        scene = mi.load_file(folder + "/scene.xml", lx=x, ly=y, lz=z, **own)
        images.append([np.array(mi.render(scene, seed=seed)) for seed in range(seeds)])
    np.save(folder + "/images.npy", np.array(images))
assert not any(name.split(".")[0] in ("render", "sdps", "pipelines") for name in sys.modules)
"""


def stock(folders: list[Path], kind: str = "scalar_rgb", seeds: int = REPEATS) -> list[np.ndarray]:
    """Render saved scenes in a process of its own; return per folder (lights, seeds, H, W, 3)."""
    environment = dict(os.environ)
    if kind.startswith("llvm"):
        library = variant.choose().llvm
        environment["DRJIT_LIBLLVM_PATH"] = str(library)
        libraries = {str(path.parent) for path in variant.load_companions(library)}
        environment |= {"LD_LIBRARY_PATH": ":".join(libraries)} if libraries else {}
    command = [sys.executable, "-c", STOCK, kind, str(seeds), *map(str, folders)]
    subprocess.run(command, env=environment, cwd=folders[0], check=True, capture_output=True, timeout=600)
    return [np.load(folder / "images.npy") for folder in folders]


def ours(spec: SceneSpec, mesh, seeds: int = REPEATS) -> np.ndarray:
    """Return (lights, seeds, H, W, 3) of the many-light renderer."""
    settings = {"size": spec.size, "spp": spec.spp, "bounces": spec.bounces}
    settings["distances"] = np.array(spec.light_distances) if spec.light_distances else None
    built, surface, stacks = scene.build(mesh), pack([spec.material], mesh), []
    for seed in range(seeds):
        _, images = many_lights.render(built, spec.view, surface, LIGHTS, seed=1000 + seed, **settings)
        stacks.append(next(iter(images))[1])
    return np.stack(stacks, axis=1)


def p_value(first: np.ndarray, second: np.ndarray, margin: float = 0.0) -> float:
    """Return the Sidak-corrected p-value of the least probable pixel, given means over the seeds equal up to `margin`.

    The margin is relative to the pixel and, for a quarter, to the mean of the image.
    """
    first, second = (images.mean(-1).astype(np.float64) for images in (first, second))
    seen = (first.var(1) > 1e-14) & (second.var(1) > 1e-14)
    # A t-test of pixels that few seeds hit means nothing.
    seen &= np.minimum((first > 0).sum(1), (second > 0).sum(1)) > first.shape[1] // 2
    means, errors = ([f(images, 1)[seen] for images in (first, second)] for f in (np.mean, stats.sem))
    allowed = margin * (means[1] + 0.25 * second.mean())
    t = np.maximum(np.abs(means[0] - means[1]) - allowed, 0) / np.hypot(*errors)
    p = 2 * stats.t.sf(t.max(), first.shape[1] - 1)  # fewest degrees of freedom that Welch's test can have
    return float(-np.expm1(t.size * np.log1p(-min(p, 1 - 1e-12))))


def compare(got: np.ndarray, expected: np.ndarray, name: str, margin: float) -> None:
    """Assert equal pixels within noise, and mean radiance within 1 % or, for mirrors, four standard errors."""
    p = p_value(got, expected, margin)
    means, errors = ([f(x.mean((2, 3, 4)), 1) for x in (got, expected)] for f in (np.mean, stats.sem))
    ratio = means[0] / means[1]
    tolerance = np.maximum(0.01, 4 * np.hypot(*errors) / means[1])
    difference = got.mean(1) - expected.mean(1)
    rms = np.sqrt((difference**2).sum() / (expected.mean(1) ** 2).sum())
    _log.info("%s: p = %.2g, mean ratios %s, relative RMS %.3f", name, p, np.round(ratio, 4), rms)
    assert p > 0.01
    assert (np.abs(ratio - 1) < tolerance).all(), ratio


NEAR = replace(
    PLAIN, material="lambertian:0.9", view=replace(VIEW, camera_distance=2.5), light_distances=(2.0, 2.5, 3.5)
)
TABLE = 0.02  # what interpolation of a table, or of a pattern's edges, may change in a pixel
SCENES = {
    "lambertian": ("lambertian:0.9/0.5/0.1", support.bowl, 0.0),
    "plastic": ("white-acrylic", support.bowl, TABLE),
    "metallic paint": ("gold-metallic-paint", support.bowl, TABLE),
    "patches": ("patches:3:lambertian:0.9+lambertian:0.1+pink-felt", support.bowl, 2 * TABLE),
}


@pytest.fixture(scope="module")
def saved(tmp_path_factory) -> dict[str, tuple]:
    """Save and render all of SCENES by one stock process."""
    found, folder = {}, tmp_path_factory.mktemp("scenes")
    for name, (material, build, _) in SCENES.items():
        mesh, spec = build(), replace(PLAIN, material=material)
        found[name] = (mesh, spec, mitsuba_scene.save(folder / name, spec, mesh).parent)
    mesh = support.bowl()
    found["near lights, perspective"] = (mesh, NEAR, mitsuba_scene.save(folder / "near", NEAR, mesh).parent)
    images = stock([item[2] for item in found.values()])
    return {name: (*item, image) for (name, item), image in zip(found.items(), images, strict=True)}


@pytest.mark.parametrize("name", SCENES)
def test_stock_mitsuba_renders_the_same_picture(saved, name):
    mesh, spec, _, images = saved[name]
    compare(images, ours(spec, mesh), name, SCENES[name][2])


def test_near_lights_and_perspective(saved):
    """Both as a point emitter and a perspective sensor; the parameters' defaults are the first light's."""
    mesh, spec, folder, images = saved["near lights, perspective"]
    compare(images, ours(spec, mesh), "near lights, perspective", 0.0)
    assert p_value(images, ours(replace(spec, light_distances=(4.0, 5.0, 7.0)), mesh)) < 1e-4
    assert p_value(images, ours(replace(spec, view=replace(spec.view, camera_distance=4.0)), mesh)) < 1e-4
    xml, words = (folder / "scene.xml").read_text(), (folder / "README.txt").read_text()
    assert 'type="point"' in xml and 'type="perspective"' in xml and "directional" not in xml
    assert "x, y, z, intensity = map(float" in words and "irradiance" not in words


def test_the_comparison_notices_what_is_missing(saved):
    mesh, spec, _, images = saved["lambertian"]
    assert p_value(images, ours(replace(spec, bounces=1), mesh)) < 1e-4
    assert p_value(images, ours(replace(spec, view=replace(VIEW, offset=(-0.05, -0.1))), mesh)) < 1e-4


@pytest.mark.slow
@pytest.mark.parametrize("shape", ["sphere", "blobby:9", "bunny", "sculpture:5"])
@pytest.mark.parametrize(
    "material",
    ["lambertian:0.7", "red-plastic", "gold-metallic-paint", "pink-fabric",
     "stripes:7:lambertian:0.9+red-plastic+gold-metallic-paint", "parts:2:white-acrylic+blue-fabric"],
)  # fmt: skip
def test_more_scenes(tmp_path, shape, material):
    mesh, spec = shapes.load(shape), replace(PLAIN, material=material, size=32, spp=256)
    (images,) = stock([mitsuba_scene.save(tmp_path / "scene", spec, mesh).parent], "llvm_ad_rgb", 16)
    margin = 0 if material == "lambertian:0.7" else 4 * TABLE if ":" not in material else 5 * TABLE
    compare(images, ours(spec, mesh, 16), f"{shape}, {material}", margin)


@pytest.mark.slow
def test_mirrors_reflect_as_much_light(tmp_path):
    """`path` meets chrome's highlights by chance: only the mean is known well; pixels have no normal distribution."""
    mesh, spec = shapes.load("sphere"), replace(PLAIN, material="chrome", size=16, spp=4096, bounces=0)
    (images,) = stock([mitsuba_scene.save(tmp_path / "scene", spec, mesh).parent], "llvm_ad_rgb", 24)
    means, errors = ([f(x.mean((2, 3, 4)), 1) for x in (images, ours(spec, mesh, 4))] for f in (np.mean, stats.sem))
    assert (np.abs(means[0] - means[1]) < 4 * np.hypot(*errors)).all() and (errors[0] < 0.1 * means[0]).all()


def picture(path):
    """Read a picture without Mitsuba, whose reader can wait forever in a long-lived process: its threads are gone."""
    return exr_parts(path)[0].channels["RGB"].pixels


def test_command_line_takes_the_parameters(saved):
    """The command of README.txt, with another light: the picture a Python script gets with the same seed."""
    folder = saved["plastic"][2]
    program = shutil.which("mitsuba", path=str(Path(sys.executable).parent))
    x, y, z = LIGHTS[2]
    parameters = [f"-Dlx={x:.9g}", f"-Dly={y:.9g}", f"-Dlz={z:.9g}", "-Dspp=256", "-Dsize=6", "-Dirradiance=6.283185"]
    command = [program, "-m", "scalar_rgb", *parameters, "-o", "light.exr", "scene.xml"]
    subprocess.run(command, cwd=folder, check=True, capture_output=True, timeout=120)
    image = picture(folder / "light.exr")
    assert image.shape == (6, 6, 3) and image.dtype == np.float32
    np.testing.assert_allclose(image.mean(), 2 * saved["plastic"][3][2].mean(), rtol=0.05)


def test_readme_is_true(saved, tmp_path):
    """Its Python lines are run as they are."""
    folder = shutil.copytree(saved["plastic"][2], tmp_path / "copy with spaces")
    text = (folder / "README.txt").read_text(encoding="utf-8")
    code = text.split("Light k from Python:")[1]
    lines = [line[4:] for line in code.splitlines() if line.startswith("    ")]
    assert len(lines) == 5
    subprocess.run([sys.executable, "-c", "\n".join(["k = 1", *lines])], cwd=folder, check=True, timeout=120)
    image = picture(folder / "light001.exr")
    np.testing.assert_allclose(image.mean(), saved["plastic"][3][1].mean(), rtol=0.05)
    for word in ("white-acrylic", "0.8 0 0.6", "12x12", "material0.bsdf", "2 interreflections", "x right, y up"):
        assert word in text


def test_folder_is_self_contained(saved):
    folder = saved["patches"][2]
    names = {path.name for path in folder.iterdir()} - {"images.npy"}
    assert names == {"scene.xml", "object.ply", "lights.txt", "README.txt", "material2.bsdf"}
    np.testing.assert_allclose(light_sets.load(str(folder / "lights.txt")), LIGHTS, atol=1e-6)
    assert str(folder) not in (folder / "scene.xml").read_text(encoding="utf-8")


def test_measured_files_are_copied_or_converted(tmp_path):
    samples = np.random.default_rng(0).normal(size=(2, 500, 3)) * [1, 1, 0.1] + [0, 0, 2]
    wi, wo = samples / np.linalg.norm(samples, axis=2, keepdims=True)
    brdf = mitsuba_scene.evaluator(library.load("pink-felt"))
    given = rgl.write(tmp_path / "felt_rgb.bsdf", brdf, slices=5, side=9)
    merl.write(tmp_path / "felt.binary", merl.tabulate(brdf))
    material = f"patches:1:{given.path}+{tmp_path / 'felt.binary'}"
    folder = mitsuba_scene.save(tmp_path / "scene", replace(PLAIN, material=material), support.plane()).parent
    assert (folder / "material0.bsdf").read_bytes() == given.path.read_bytes()
    expected = model.evaluate(library.load("pink-felt"), wi, wo)
    np.testing.assert_allclose(
        mitsuba_scene.evaluator(library.load(tmp_path / "felt.binary"))(wi, wo), expected, rtol=0.02
    )
    assert rgl.load(folder / "material1.bsdf").description == "felt"


def test_folder_is_replaced_whole_or_left_alone(tmp_path):
    target = tmp_path / "scene"
    mitsuba_scene.save(target, PLAIN, support.plane())
    before = (target / "scene.xml").read_bytes()
    for name, message in (("chrom", "unknown material"), ("procedural:wood:1", "stock Mitsuba has no such material")):
        with pytest.raises(InputError, match=message):
            mitsuba_scene.save(target, replace(PLAIN, material=name), support.plane())
    assert (target / "scene.xml").read_bytes() == before
    mitsuba_scene.save(target, replace(PLAIN, bounces=5), support.plane())
    assert 'name="max_depth" value="7"' in (target / "scene.xml").read_text(encoding="utf-8")
    assert [path.name for path in tmp_path.iterdir()] == ["scene"]
    other = tmp_path / "photos"
    other.mkdir()
    (other / "me.jpg").write_bytes(b"")
    with pytest.raises(InputError, match="holds other files"):
        mitsuba_scene.save(other, PLAIN, support.plane())
    assert [path.name for path in other.iterdir()] == ["me.jpg"]


def half(points: np.ndarray, _) -> np.ndarray:
    """Return one-hot weights of three materials in x < -0.2, x < 0.3 and the rest."""
    label = (points[:, 0] > -0.2).astype(int) + (points[:, 0] > 0.3)
    return np.eye(3)[label]


def test_cut_follows_sharp_edges_and_keeps_the_surface():
    mesh = support.bowl(12)
    edge = 0.01
    finer, shares = pattern_mesh.cut(mesh, half, edge)
    assert shares.shape == (len(finer.vertices), 2) and shares.min() >= 0 and shares.max() <= 1
    weights = np.stack([(1 - shares[:, 0]) * (1 - shares[:, 1]), shares[:, 0] * (1 - shares[:, 1]), shares[:, 1]], 1)
    far = np.abs(finer.vertices[:, :1] - [-0.2, 0.3]).min(1) > edge
    np.testing.assert_allclose(weights[far], half(finer.vertices[far], None), atol=1e-6)
    crosses = face_normals(finer.vertices, finer.faces)
    before = np.linalg.norm(face_normals(mesh.vertices, mesh.faces), axis=1).sum()
    np.testing.assert_allclose(np.linalg.norm(crosses, axis=1).sum(), before, rtol=1e-5)
    assert ((crosses * finer.normals[finer.faces[:, 0]]).sum(1) > 0).all()


def test_cut_leaves_what_varies_linearly():
    """A mesh without long edges stays as it is, but for the order of its vertices."""
    mesh = replace(support.bowl(20), vertices=support.bowl(20).vertices / 10)
    finer, shares = pattern_mesh.cut(mesh, lambda p, _: np.stack([0.5 + p[:, 0] / 2, 0.5 - p[:, 0] / 2], 1), 1e-3)
    assert len(finer.faces) == len(mesh.faces) and len(finer.vertices) == len(mesh.vertices)
    np.testing.assert_allclose(shares[:, 0], 0.5 - finer.vertices[:, 0] / 2, atol=1e-6)
