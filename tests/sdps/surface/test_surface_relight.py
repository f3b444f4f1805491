"""Albedo, relit pictures, cast shadows, residuals, and views of the depth."""

import json

import numpy as np
import pytest
from classical_scenes import glossy, lambertian, lights
from classical_scenes import sphere as shaded_sphere
from sdps_scenes import write_data
from surface_scenes import sphere

from lab.bench import bench_surface
from lab.commands import main as lab_main
from render.records.shards import Shard
from render.shared.errors import InputError
from sdps.core.geometry import ORTHOGRAPHIC, Camera, Capture, reach
from sdps.core.integration import integrate
from sdps.surface.relight import Lamps, fit_albedo, relit, residuals, trace_light
from sdps.surface.views import depth_normals, strip, turned


class Counted:
    """Images that remember how many were asked for at once."""

    def __init__(self, images):
        self.images, self.most, self.reads = images, 0, 0

    def __len__(self):
        return len(self.images)

    def __getitem__(self, part):
        self.most = max(self.most, part.stop - part.start)
        self.reads += part.stop - part.start
        return self.images[part]


@pytest.fixture(scope="module")
def scene():
    normals, mask = shaded_sphere(64)
    albedo = np.random.default_rng(0).uniform(0.1, 0.9, (*mask.shape, 3))
    return lambertian(normals, mask, lights(30), albedo=albedo, intensities=np.linspace(0.5, 2, 30)), albedo


def test_albedo_is_exact_on_lambertian_images(scene):
    scene, albedo = scene
    found = fit_albedo(scene.images, scene.mask, scene.normals, scene.lights, scene.intensities)
    assert np.allclose(found[scene.mask], albedo[scene.mask], rtol=1e-3)
    assert (found[~scene.mask] == 0).all()
    left = residuals(scene.images, scene.mask, scene.normals, scene.lights, scene.intensities, found)
    assert left.overall < 1e-3
    assert left.images.shape == (30,)
    assert left.images.max() < 1e-3
    assert left.pixels.shape == scene.mask.shape


def test_coloured_intensities(scene):
    scene, albedo = scene
    tint = np.array([1.0, 0.5, 2.0])
    gains = scene.intensities[:, None] * tint
    found = fit_albedo(scene.images * tint, scene.mask, scene.normals, scene.lights, gains)
    assert np.allclose(found[scene.mask], albedo[scene.mask], rtol=1e-3)


def test_highlights_and_shadows_count_little():
    normals, mask = shaded_sphere(64)
    scene = glossy(normals, mask, lights(60), diffuse=0.4, specular=0.3, roughness=0.15)
    images = scene.images.copy()
    images[::7, :, :20] = 0.0  # as if in a cast shadow
    plain, robust = (
        np.abs(fit_albedo(images, mask, normals, scene.lights, np.ones(60), passes=passes)[mask] - 0.4).mean()
        for passes in (1, 4)
    )
    assert robust < 0.4 * plain
    assert robust < 0.035  # 0.023


def test_memory_is_bounded(monkeypatch, scene):
    scene, _ = scene
    monkeypatch.setattr("sdps.surface.relight._READ_PIXELS", 4 * scene.mask.size)
    source = Counted(scene.images)
    fit_albedo(source, scene.mask, scene.normals, scene.lights, scene.intensities, passes=2)
    assert (source.most, source.reads) == (4, 60)


@pytest.mark.parametrize("camera", [ORTHOGRAPHIC, Camera(200.0)])
@pytest.mark.parametrize("banded", [False, True])
def test_near_lamps_leave_an_even_albedo_even(monkeypatch, camera, banded):
    """Both as one piece and in bands of rows and parts of pixels, with a distance for each lamp."""
    z, normals, mask = sphere(64, 30.0, 0.9)
    heights = np.where(mask, z - z[mask].mean(), np.nan)  # what is outside must not be read
    capture, nearness, directions = Capture.of(mask, camera), np.linspace(0.1, 0.4, 30), lights(30)
    ways, falloff = reach(capture.places(heights)[mask], directions.astype(np.float64), nearness)
    shading = np.maximum(np.einsum("pc,plc->pl", normals[mask], ways), 0.0) * falloff
    images = np.zeros((30, *mask.shape, 3))
    images[:, mask] = 0.6 * shading.T[..., None]
    if banded:
        monkeypatch.setattr("sdps.surface.relight._BAND", 700)
        monkeypatch.setattr("sdps.surface.relight._PART", 300)
    known = images, mask, normals, directions, np.ones(30)
    lamps = Lamps(capture, heights, nearness)
    found = fit_albedo(*known, lamps=lamps)
    assert np.allclose(found[mask], 0.6, rtol=1e-4)
    assert residuals(*known, found, lamps=lamps).overall < 1e-4
    distant = fit_albedo(*known)
    assert np.ptp(distant[mask]) > 0.15
    assert residuals(*known, distant).overall > 0.1


def test_lamps_that_do_not_fit_are_refused(scene):
    scene = scene[0]
    known = scene.images, scene.mask, scene.normals, scene.lights, scene.intensities
    flat, capture = np.zeros(scene.mask.shape), Capture.of(scene.mask)
    for lamps, words in [
        (Lamps(capture, flat[1:], np.full(30, 0.1)), "heights must be"),
        (Lamps(capture, flat, np.full(30, 1.0)), "nearness must be"),
        (Lamps(capture, flat, np.full(29, 0.1)), "30 images need nearness"),
    ]:
        with pytest.raises(InputError, match=words):
            fit_albedo(*known, lamps=lamps)


def test_relit_predicts_an_image_that_was_not_used(scene):
    scene, _ = scene
    found = fit_albedo(scene.images[1:], scene.mask, scene.normals, scene.lights[1:], scene.intensities[1:])
    picture = relit(scene.normals, found, 3 * scene.lights[0])
    assert picture.dtype == np.float32
    assert np.allclose(picture, scene.images[0] / scene.intensities[0], atol=2e-3)


def test_residuals_see_wrong_lights(scene):
    scene, _ = scene
    wrong = scene.lights.copy()
    wrong[5] = wrong[5] * (-1, -1, 1)
    found = fit_albedo(scene.images, scene.mask, scene.normals, wrong, scene.intensities)
    left = residuals(scene.images, scene.mask, scene.normals, wrong, scene.intensities, found)
    assert left.images.argmax() == 5
    assert left.images[5] > 0.3


@pytest.mark.filterwarnings("error")
def test_residual_of_a_black_picture_is_finite(scene):
    scene, _ = scene
    images = scene.images.copy()
    images[3] = 0
    found = fit_albedo(images, scene.mask, scene.normals, scene.lights, scene.intensities)
    left = residuals(images, scene.mask, scene.normals, scene.lights, scene.intensities, found)
    assert left.images[3] == 1 and np.isfinite(left.images).all() and np.isfinite(left.pixels).all()


def test_cast_shadow_of_a_wall():
    z = np.zeros((21, 41), np.float32)
    z[:, 20] = 10.0
    flat = np.zeros((21, 41, 3), np.float32)
    flat[..., 2] = 1.0
    depth = integrate(flat, np.ones((21, 41), bool))
    object.__setattr__(depth, "z", z)
    free = trace_light(depth, np.array([1.0, 0.0, 1.0]))  # from the right, 45 degrees: 10 pixels of shadow on the left
    assert free[10, 21:].all() and free[10, :10].all()
    assert not free[10, 12:20].any()
    up = trace_light(depth, np.array([0.0, 1.0, 0.2]))
    assert up.all()
    assert trace_light(depth, np.array([0.0, 0.0, 1.0])).all()
    object.__setattr__(depth, "z", np.where(np.arange(21)[:, None] == 10, 10.0, 0.0).astype(np.float32) + 0 * z)
    below = trace_light(depth, np.array([0.0, 1.0, 1.0]))  # from above: the rows below the wall are in shadow
    assert below[:9].all() and not below[12:18].any()


def test_depth_normals_are_those_that_were_integrated():
    _, normals, mask = sphere(64, 30.0, 0.8)
    found = depth_normals(integrate(normals, mask))
    cosine = (found * normals).sum(-1)[mask]
    assert np.degrees(np.arccos(np.clip(cosine, -1, 1))).mean() < 0.5
    assert (found[~mask] == 0).all()


def test_views():
    _, normals, mask = sphere(64, 30.0, 0.9)
    depth = integrate(normals, mask)
    picture = strip(depth, 80)
    assert picture.shape == (80, 240, 3) and picture.dtype == np.uint8
    front = turned(depth, 0.0, 80)
    assert np.array_equal(picture[:, 80:160], front)
    seen = (front < 250).any(axis=2)
    rows, columns = (np.flatnonzero(seen.any(axis=axis)) for axis in (1, 0))
    assert abs(len(rows) - len(columns)) <= 2  # round from the front
    assert front[30, 30].mean() > front[50, 50].mean()  # lit from the upper left
    side = turned(depth, 60.0, 80, colour=np.broadcast_to([0.8, 0.1, 0.1], normals.shape))
    assert side[40, 40, 0] > 2 * side[40, 40, 1]
    assert (side < 250).any(axis=2).sum() < seen.sum()


def test_a_viewer_on_the_right_sees_what_faces_right():
    x = np.arange(40) - 19.5
    slope = np.where(x > 0, -1.0, 1.0) + np.zeros((40, 1))  # a ridge
    normals = np.stack([-slope, 0 * slope, np.ones_like(slope)], -1) / np.sqrt(2)
    depth = integrate(normals, np.ones((40, 40), bool))
    colour = np.where(x[None, :, None] > 0, [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]) + np.zeros((40, 1, 1))
    seen = turned(depth, 44.0, 64, colour=colour).astype(int)
    red, blue = (seen[..., 0] > seen[..., 2] + 40).sum(), (seen[..., 2] > seen[..., 0] + 40).sum()
    assert red > 5 * blue


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"lights": np.ones((3, 3))}, "30 images need lights"),
        ({"intensities": np.full(30, np.nan)}, "finite"),
        ({"passes": 0}, "passes"),
        ({"images": np.full((30, 64, 64, 3), np.nan)}, "NaN"),
        ({"images": np.zeros((30, 64, 60, 3))}, "images must be"),
    ],
)
def test_refusals(scene, change, words):
    scene = scene[0]
    given = {"images": scene.images, "mask": scene.mask, "normals": scene.normals, "lights": scene.lights}
    with pytest.raises(InputError, match=words):
        fit_albedo(**{**given, "intensities": scene.intensities, **change})


def test_directions_are_refused(scene):
    with pytest.raises(InputError, match="direction"):
        relit(scene[0].normals, np.ones((1, 1, 1)), np.zeros(3))
    depth = integrate(scene[0].normals, scene[0].mask)
    with pytest.raises(InputError, match="degrees"):
        turned(depth, 90.0, 64)


def test_the_bench_scores_scenes_and_times_steps(tmp_path, capsys):
    write_data(tmp_path / "data", ("train",), lights=8, size=64)
    flags = ["--height", "48", "--width", "64", "--images", "12", "--steps", "albedo", "--out", str(tmp_path / "out")]
    assert lab_main(["bench-surface", str(tmp_path / "data"), *flags]) == 0
    found = json.loads((tmp_path / "out" / "bench_surface.json").read_text())
    assert [row["normals"] for row in found["depths"]] == ["true normals", "least squares"]
    assert found["depths"][0]["mae"] < 0.1 < found["depths"][1]["mae"] < 10.0  # attached shadows mislead least squares
    assert found["depths"][0]["plain"]["residual"] < 0.1
    (row,) = found["pictures"]
    assert row["residual"] < 0.01 and row["shadows"] == {}
    assert found["steps"]["albedo"]["seconds"] > 0
    for step in bench_surface.STEPS:  # all of them, without a process each
        took = bench_surface._work(step, bench_surface.BenchClassicalConfig(height=32, width=40, lights=12))
        assert took["pixels"] > 500 and took["seconds"] > 0
    assert "pixels of object, 12 images" in capsys.readouterr().out
    assert lab_main(["bench-surface", str(tmp_path / "nowhere"), *flags]) == 2
    assert lab_main(["bench-surface", "--steps", "albdo"]) == 2
    assert "did you mean 'albedo'" in capsys.readouterr().err


def test_cast_shadows_are_counted_on_a_step():
    """A wall before a floor: its shadow is found by the true depth, and lowers the error of the relit pictures."""
    size = 64
    depth = np.where(np.arange(size) < 24, 0.5, 0.0) * np.ones((size, 1))  # in half image widths, as shards have it
    normals = np.broadcast_to(np.float32([0, 0, 1]), (size, size, 3)).copy()
    direction = np.float32([-0.8, 0.0, 0.6])
    reach = int(0.5 * size / 2 * 0.8 / 0.6)  # of the shadow, in pixels
    image = np.full((1, size, size, 3), 0.6 * 0.5, np.float16)
    image[:, :, 24 : 24 + reach] = 0.0
    shard = Shard(
        scene_id="step",
        images=image,
        normals=normals,
        depth=depth.astype(np.float32),
        mask=np.ones((size, size), bool),
        coverage=np.ones((size, size), np.float32),
        light_directions=direction[None],
        provenance={},
    )
    found = bench_surface._shadows(shard, np.full((size, size, 3), 0.5, np.float32))
    assert found["true depth"]["found"] > 0.8 and found["true depth"]["wrong"] < 0.1
    assert found["true depth"]["rms"] < 0.5 * found["none"]["rms"]
    assert found["plain"]["found"] == 0.0  # normals that know of no wall
