"""`sdps infer`: photographs in; normals, lights, depth, meshes and a page out; and nothing where they are bad."""

import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import classical_scenes as scenes
import cv2
import numpy as np
import OpenEXR
import photo_folders as folders
import pytest
import trimesh
from sdps_scenes import hemisphere_lights

from lab.bench import bench_infer
from lab.commands import main as lab_main
from lab.shared.machines import HERE, kinds
from pipelines.cli import build_parser, main
from pipelines.evaluate.report.photographs_page import write_page
from render.shared.config import to_plain
from render.shared.errors import InputError
from render.shared.progress import report_to
from sdps import api
from sdps.api import infer, load
from sdps.core.metrics import direction_mae, intensity_error, normal_mae
from sdps.data.augment import Augmentation
from sdps.inference.inference_config import InferenceConfig, inference_config
from sdps.methods import pretrained
from sdps.methods.parse import parse
from sdps.models.checkpoint import TrainedModel, save_weights
from sdps.models.registry import create

ROOT = Path(__file__).parents[2]
LIGHTS = hemisphere_lights(16, np.random.default_rng(0))
GAINS = np.linspace(0.6, 1.0, 16)
FILES = ["depth.npy", "lights.json", "mask.png", "mesh.glb", "mesh.obj", "mesh.ply", "normal.exr", "normal.npy",
         "normal.png", "report.html", "result.json"]  # fmt: skip


@pytest.fixture(scope="module")
def hills(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, np.ndarray, np.ndarray]:
    """A folder of 16-bit pictures of matte hills, their normals and mask."""
    folder = tmp_path_factory.mktemp("hills")
    normals, mask = scenes.hills(64)
    images = scenes.lambertian(normals, mask, LIGHTS, albedo=0.7).images * GAINS[:, None, None, None]
    folders.write_folder(folder, images.astype(np.float32), mask)
    rows = [f"{number}.png {x} {-y} {z} {gain}" for number, ((x, y, z), gain) in
            enumerate(zip(LIGHTS, GAINS, strict=True), start=1)]  # fmt: skip
    (folder / "known.txt").write_text("\n".join(rows))
    return folder, normals, mask


def fails(capsys: pytest.CaptureFixture, *arguments: object) -> str:
    assert main(["infer", *map(str, arguments)]) == 2
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert "Traceback" not in line
    return line


def random_models(folder: Path) -> Path:
    """Write networks with random weights, as if trained in a folder."""
    metadata = {"config": {"augmentation": to_plain(Augmentation())}}
    for name in ("lcnet", "nenet"):
        path = pretrained.trained_file(folder, name)
        path.parent.mkdir(parents=True)
        save_weights(path, TrainedModel(name, create(name).eval(), {}, metadata))
    return folder


def test_known_lights_with_y_down_give_the_normals(hills: tuple, tmp_path: Path, capsys) -> None:
    folder, normals, mask = hills
    flags = [
        "--lights",
        folder / "known.txt",
        "--frame",
        "y-down",
        "--method",
        "robust-least-squares",
        "--out",
        tmp_path,
    ]
    assert main(["infer", str(folder), *map(str, flags)]) == 0, capsys.readouterr().err
    assert [name for name in FILES if not (tmp_path / name).is_file()] == []
    found = np.load(tmp_path / "normal.npy")
    assert found.dtype == np.float32 and found.shape == normals.shape and not found[~mask].any()
    assert normal_mae(found, normals, mask) < 3.0  # 1.4; with y up, tens of degrees
    text = capsys.readouterr().out
    assert "orthographic" in text and str(tmp_path / "report.html") in text
    assert not list(tmp_path.glob(".infer-*"))


def test_near_lamps_with_positions(hills: tuple, tmp_path: Path, capsys) -> None:
    """The lamps of a file come out as they went in, and each mistake has its line."""
    folder, _, _ = hills
    places = [[round(float(value), 6) for value in 3.0 * light] for light in LIGHTS]
    path, out = tmp_path / "near.yaml", tmp_path / "out"
    path.write_text(json.dumps({"kind": "near", "unit": "objects", "positions": places}))
    flags = ["--lights", path, "--intensities", "equal", "--method", "least-squares", "--anyway", "--out", out]
    assert main(["infer", str(folder), *map(str, flags)]) == 0, capsys.readouterr().err
    assert "its lamps stand 3 object sizes from the object's middle" in capsys.readouterr().out
    stored = json.loads((out / "lights.json").read_text())
    assert (stored["kind"], stored["unit"]) == ("near", "objects")
    again, given = load(folder, lights=out / "lights.json"), load(folder, lights=path)
    np.testing.assert_allclose(again.light_nearness, given.light_nearness, atol=1e-5)
    np.testing.assert_allclose(again.light_nearness, 1 / 6, atol=1e-5)
    np.testing.assert_allclose(again.light_directions, given.light_directions, atol=1e-5)
    near = np.load(out / "normal.npy")
    assert main(["infer", str(folder), *map(str, flags), "--light-distance", "far"]) == 0
    assert list(json.loads((out / "lights.json").read_text())) == ["frame", "images"]
    assert np.abs(np.load(out / "normal.npy") - near).max() > 0.01
    capsys.readouterr()
    assert "--pixel-size" in fails(capsys, folder, *flags, "--light-distance", "3m", "--lights", folder / "known.txt")
    assert "inside the object" in fails(capsys, folder, "--light-distance", "0.4", "--out", out)
    path.write_text(path.read_text().replace("objects", "inch"))
    assert "unknown unit 'inch'" in fails(capsys, folder, *flags)


def test_all_files_say_the_same(hills: tuple, tmp_path: Path, capsys) -> None:
    folder, _, mask = hills
    assert main(["infer", str(folder), "--method", "factorisation", "--out", str(tmp_path)]) == 0
    found = np.load(tmp_path / "normal.npy")
    coded = cv2.imread(str(tmp_path / "normal.png"), cv2.IMREAD_UNCHANGED)[..., ::-1]
    assert coded.dtype == np.uint16
    np.testing.assert_allclose(coded / 65535 * 2 - 1, found, atol=2e-5)
    channels = OpenEXR.File(str(tmp_path / "normal.exr"), separate_channels=True).channels()
    for axis, name in enumerate("XYZ"):
        np.testing.assert_array_equal(channels[f"normal.{name}"].pixels, found[..., axis])
    stored = json.loads((tmp_path / "lights.json").read_text())
    assert stored["images"][0]["file"] == "1.png"
    directions = np.array([row["direction"] for row in stored["images"]])
    assert direction_mae(directions, LIGHTS) < 25  # equal albedo alone tells the bas-relief transformation roughly
    # lights.json is what --lights reads.
    again = load(folder, lights=tmp_path / "lights.json")
    np.testing.assert_allclose(again.light_directions, directions, atol=1e-5)
    depth = np.load(tmp_path / "depth.npy")
    surface = trimesh.load(tmp_path / "mesh.ply", process=False)
    assert np.ptp(surface.vertices[:, 2]) == pytest.approx(np.ptp(depth[mask]) * 2 / 64, rel=1e-3)
    for suffix in ("obj", "glb"):
        assert len(trimesh.load(tmp_path / f"mesh.{suffix}", force="mesh", process=False).faces) == len(surface.faces)
    facts = json.loads((tmp_path / "result.json").read_text())
    assert facts["method"] == "factorisation" and facts["mask"] == "file" and facts["images"] == 16
    assert facts["terms"] == ""  # no weights
    page = (tmp_path / "report.html").read_text()
    assert not re.search(r"(src|href)=\"(?!data:|#)", page) and page.count("data:image/png") >= 10


def test_the_two_verbs(hills: tuple) -> None:
    folder, normals, mask = hills
    photos = load(folder, lights=folder / "known.txt", frame="y-down")
    result = infer(photos)  # no network is shipped for known lights, or it is: both must do
    assert normal_mae(result.normals, normals, mask) < 20
    result = infer(photos, "robust-least-squares")
    assert normal_mae(result.normals, normals, mask) < 3.0
    assert intensity_error(result.intensities, GAINS) < 1e-5  # given, and kept
    assert result.residuals.overall < 0.05
    assert result.depth.z.shape == mask.shape


def test_networks_with_and_without_known_lights(hills: tuple, tmp_path: Path, capsys) -> None:
    folder, _, mask = hills
    models = random_models(tmp_path / "runs")
    result = infer(load(folder), "sdps", models=models, refine=False)
    assert result.method == "lcnet + nenet" and result.light_directions.shape == (16, 3)
    assert set(result.files) == {"lcnet", "nenet"} and "light_confidence" in result.summary()
    told = infer(load(folder, lights=folder / "known.txt", frame="y-down"), "sdps", models=models, refine=False)
    np.testing.assert_allclose(told.light_directions, LIGHTS, atol=1e-5)
    assert set(told.files) == {"nenet"}
    # Over all eight views an untrained network's lights average to a single one.
    config = InferenceConfig(light_views=1)
    only = infer(load(folder), "lcnet+least-squares", models=models, config=config, refine=False)
    assert only.method == "lcnet + least-squares" and only.normals[mask].any()


def test_the_terms_of_pretrained_weights_are_told(
    hills: tuple, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    models = random_models(tmp_path / "runs")
    result = infer(load(hills[0]), "sdps", models=models, refine=False)
    assert result.summary()["terms"] == ""
    monkeypatch.setattr(pretrained, "shipped_folder", lambda: models / "models" / "lcnet")
    assert result.summary()["terms"] == pretrained.TERMS and "research use" in pretrained.TERMS
    page = write_page(tmp_path / "page.html", result).read_text()
    assert "research use: weights trained on materials fitted to MERL data, LICENSE-DATA" in page


def test_a_method_means_the_same_to_photographs_as_to_benchmarks(
    hills: tuple, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked = []

    def runner(*given: object, **_: object) -> None:
        asked.append(given)
        raise InputError("enough")

    monkeypatch.setattr(api, "Runner", runner)
    monkeypatch.setattr(api.pretrained, "require", lambda name, out: Path(name))
    with pytest.raises(InputError, match="enough"):
        infer(load(hills[0]), "sdps-plus", refine=False)
    method, _, config = asked[0]
    assert method == parse("sdps-plus", Path) and config is None
    flags = build_parser(["infer"]).parse_args(["infer", "photographs"])
    assert inference_config(flags) == InferenceConfig()


def test_folders_and_methods_that_do_not_fit_are_one_line(hills: tuple, tmp_path: Path, capsys) -> None:
    folder, out = hills[0], tmp_path / "out"
    assert "no such" in fails(capsys, tmp_path / "nowhere", "--out", out)
    one = folders.write_folder(tmp_path / "one", np.full((1, 40, 40, 3), 0.5, np.float32))
    assert "1" in fails(capsys, one, "--out", out)
    assert "did you mean 'pf14'" in fails(capsys, folder, "--method", "pf-14", "--out", out)
    assert "needs the lights; give them with --lights" in fails(
        capsys, folder, "--method", "least-squares", "--out", out
    )
    assert "holds the photographs" in fails(capsys, folder, "--method", "factorisation", "--out", folder)
    assert "no such weights" in fails(capsys, folder, "--method", "lcnet-reg+nenet", "--models", tmp_path, "--out", out)
    assert "--self-test" in fails(capsys, "--out", out)
    (tmp_path / "file").write_text("")
    flags = ["--lights", folder / "known.txt", "--frame", "y-down", "--method", "least-squares"]
    assert "cannot be written" in fails(capsys, folder, *flags, "--out", tmp_path / "file" / "x")
    assert not out.exists()


def test_one_flag_goes_on_where_a_check_stops(hills: tuple, tmp_path: Path, capsys) -> None:
    folder, _, mask = hills
    images = load(folder)[0:2]
    pair = folders.write_folder(tmp_path / "pair", np.clip(images * [[[[1.0]]], [[[0.5]]]], 0, 1), mask)
    (pair / "lights.txt").write_text("\n".join(" ".join(map(str, light)) for light in LIGHTS[:2]))
    flags = [pair, "--lights", pair / "lights.txt", "--method", "psfcn", "--out", tmp_path / "out"]
    assert fails(capsys, *flags).endswith("Take more. (--anyway goes on all the same)")
    assert main(["infer", *map(str, flags), "--anyway"]) == 0, capsys.readouterr().err
    found = json.loads((tmp_path / "out" / "result.json").read_text())["findings"]
    assert found[0]["level"] == "error" and "Only 2 pictures" in found[0]["text"]
    assert "Only 2 pictures" in (tmp_path / "out" / "report.html").read_text()


def test_a_corrupt_file_among_good_ones_leaves_nothing(hills: tuple, tmp_path: Path, capsys) -> None:
    images = np.random.default_rng(0).random((4, 32, 32, 3)).astype(np.float32)
    folder = folders.write_folder(tmp_path / "photos", images)
    path = folder / "3.png"
    path.write_bytes(path.read_bytes()[:200])
    line = fails(capsys, folder, "--method", "pf14", "--out", tmp_path / "out")
    assert "3.png" in line and not (tmp_path / "out").exists()


@pytest.mark.slow
def test_the_self_test_scores_itself(tmp_path: Path, capsys) -> None:
    assert main(["infer", "--self-test", "--method", "pf14", "--out", str(tmp_path)]) == 0
    scores = json.loads((tmp_path / "self_test.json").read_text())["scores"]
    assert scores["normals, degrees"] < 25
    assert "against the truth" in capsys.readouterr().out


@pytest.mark.slow
def test_many_photographs_do_not_need_more_memory(tmp_path: Path) -> None:
    normals, mask = scenes.sphere(192)
    environment, peaks = os.environ | {"PYTHONPATH": str(ROOT)}, {}
    for count in (100, 1000):
        lights = hemisphere_lights(count, np.random.default_rng(1))
        folder = tmp_path / str(count)
        for number, light in enumerate(lights):
            image = scenes.lambertian(normals, mask, light[None], albedo=0.7).images[0]
            folders.write(folder / f"{number}.png", image, 8)
        folders.write(folder / "mask.png", mask.astype(np.float32))
        (folder / "names.txt").write_text("\n".join(f"{number}.png" for number in range(count)))
        models = random_models(tmp_path / f"runs-{count}")
        command = [sys.executable, "tests/support/infer_memory.py", str(folder), str(models)]
        done = subprocess.run(command, check=True, capture_output=True, text=True, cwd=ROOT, env=environment)
        peaks[count] = json.loads(done.stdout.splitlines()[-1])["peak_gib"]
    assert peaks[1000] < 1.3 * peaks[100]
    assert peaks[1000] < 3.0


def test_a_scale_takes_less_of_everything(hills: tuple, tmp_path: Path, capsys) -> None:
    folder, _, _ = hills
    flags = ["--method", "lcnet+least-squares", "--scale", "0.5", "--out", str(tmp_path / "half")]
    assert main(["infer", str(folder), *flags]) == 0, capsys.readouterr().err
    text = capsys.readouterr().out
    assert "photographs of 32x32" in text and "reduced from 64x64 to 32x32" in text
    line = next(line for line in text.splitlines() if "pixels of object in 16 pictures of 32x32: about" in line)
    assert "GiB of memory" in line and "--scale" not in line
    assert np.load(tmp_path / "half" / "normal.npy").shape == (32, 32, 3)
    assert json.loads((tmp_path / "half" / "result.json").read_text())["scale"] == 0.5


def test_a_focal_length_bends_the_surface_and_a_pixel_size_measures_it(hills: tuple, tmp_path: Path, capsys) -> None:
    folder, _, mask = hills
    flags = ["--lights", folder / "known.txt", "--frame", "y-down", "--method", "least-squares", "--no-refine", "--out"]

    def run(name: str, *more: str) -> tuple[str, dict, np.ndarray, np.ndarray]:
        assert main(["infer", str(folder), *map(str, flags), str(tmp_path / name), *more]) == 0
        surface = trimesh.load(tmp_path / name / "mesh.ply", process=False)
        facts = json.loads((tmp_path / name / "result.json").read_text())
        return capsys.readouterr().out, facts, np.load(tmp_path / name / "depth.npy"), np.asarray(surface.vertices)

    text, facts, depth, _ = run("plain")
    assert "64x64; the camera is taken for orthographic" in text and "pixel_size" not in facts
    assert facts["camera"] == "orthographic, looking along -z" and facts["mesh"] == {"every": 1}
    text, facts, near, points = run("near", "--focal", "80px", "--pixel-size", "0.5")
    assert "64x64; the camera is perspective, focal length 80 px (--focal)" in text
    assert facts["camera"] == "perspective, focal length 80 px (--focal)" and facts["pixel_size"] == 0.5
    assert facts["depth"]["unit"] == "millimetres towards the camera" and facts["mesh"]["unit"] == "millimetres"
    assert "The camera is perspective, focal length 80 px" in (tmp_path / "near" / "report.html").read_text()
    assert np.abs(near[mask] / 0.5 - depth[mask]).max() > 0.5
    rows, columns = np.nonzero(mask)
    assert points[:, 2] == pytest.approx(near[rows, columns], abs=1e-4)
    assert points[:, 0] == pytest.approx((columns - 31.5) * 0.5 * (1 - near[rows, columns] / 40.0), abs=1e-4)
    assert np.array_equal(np.load(tmp_path / "near" / "normal.npy"), np.load(tmp_path / "plain" / "normal.npy"))


def test_people_are_told_how_far_away_the_lamps_stood(hills: tuple, tmp_path: Path, capsys) -> None:
    folder, _, mask = hills
    flags = ["--lights", folder / "known.txt", "--frame", "y-down", "--method", "least-squares", "--no-refine", "--out"]

    def run(name: str, *more: str) -> tuple[str, dict, str, dict]:
        assert main(["infer", str(folder), *map(str, flags), str(tmp_path / name), *more]) == 0
        facts, lights = (json.loads((tmp_path / name / f"{file}.json").read_text()) for file in ("result", "lights"))
        return capsys.readouterr().out, facts, (tmp_path / name / "report.html").read_text(), lights

    text, facts, page, lights = run("far")
    assert "\nThe lamps were taken for far away.\n" in text and "The lamps were taken for far away." in page
    assert facts["lamps"] == {"text": "the lamps were taken for far away", "origin": "assumed", "far": True}
    assert "object sizes away" not in page and "kind" not in lights
    distant = facts["lambertian_residual"]
    text, facts, page, lights = run("near", "--light-distance", "2.5", "--pixel-size", "2")
    size = np.ptp(np.nonzero(mask), axis=1).max() + 1
    said = f"he lamps stood about 2.5 object sizes ({float(f'{5 * size:.2g}'):g} mm) away, as given"
    assert f"\nT{said}.\n" in text and page.count(f"T{said}.") == 2
    assert facts["lamps"] == {"text": f"t{said}", "origin": "given", "far": False, "distance_in_object_sizes": 2.5,
                              "distance_in_millimetres": 5.0 * size}  # fmt: skip
    assert "object sizes away</th>" in page and "2.50</td>" in page
    assert lights["kind"] == "near" and np.linalg.norm(lights["images"][3]["position"]) == pytest.approx(2.5)
    assert facts["lambertian_residual"] > distant  # these lamps were far


@pytest.mark.parametrize(
    ("flags", "said"),
    [
        ("--focal=0", "--focal 0: must be above 0"),
        ("--focal=28", "28 pixels are too few"),
        ("--focal=28inch", "unknown unit of --focal 'inch'; known: mm, px"),
        ("--principal=5", "--principal 5: must be two numbers"),
        ("--pixel-size=0", "--pixel-size 0: must be above 0"),
    ],
)
def test_a_camera_that_is_none_is_one_line(hills: tuple, tmp_path: Path, capsys, flags: str, said: str) -> None:
    folder = hills[0] if flags != "--focal=28" else tmp_path / "wide"
    if flags == "--focal=28":
        folders.write_folder(folder, folders.plate(LIGHTS[:3], shape=(64, 160))[0])
    assert said in fails(capsys, folder, flags, "--out", tmp_path / "out")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("scale", ["0", "1.5", "-1", "nan", "half", "0,5", ""])
def test_a_scale_that_is_none_is_one_line(hills: tuple, tmp_path: Path, capsys, scale: str) -> None:
    assert "scale" in fails(capsys, hills[0], f"--scale={scale}", "--out", tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_what_does_not_fit_stops_before_it_starts(hills: tuple, tmp_path: Path, capsys, monkeypatch) -> None:
    monkeypatch.setattr("sdps.surface.workload.LIMIT", 0.2)
    folder, flags = hills[0], ["--method", "pf14", "--out", tmp_path / "out"]
    assert re.search(r"GiB of memory, more than 0\.2; give --scale", fails(capsys, folder, *flags))
    assert main(["infer", str(folder), *map(str, flags), "--anyway"]) == 0


def test_under_any_light_the_page_tells_what_refinement_did(hills: tuple, tmp_path: Path, capsys) -> None:
    out = tmp_path / "out"
    assert main(["infer", str(hills[0]), "--lit-by", "any", "--out", str(out)]) == 0
    page, said = (out / "report.html").read_text(), capsys.readouterr().out
    assert "No lamps were found." in page and "No lamps were found." in said
    assert "refinement moved normals" in page and "photographs not explained" not in page
    written = {path.name for path in out.iterdir()}
    assert written == {*FILES, "albedo.npy", "expected-error.npy", "relit"} - {"lights.json"}
    assert main(["export", str(out), "--as", "materials"]) == 2
    assert "does not tell how it shines; photograph it under one lamp" in capsys.readouterr().err


def test_every_stage_tells_how_far_it_is(hills: tuple, tmp_path: Path) -> None:
    folder, _, _ = hills
    told: dict[str, list[float]] = {}
    with report_to(lambda name, share: told.setdefault(name, []).append(share)):
        photos = load(folder)
        result = infer(photos, "sdps-frames", refine=True)
        result.save(tmp_path)
        write_page(tmp_path / "report.html", result)
    stages = (
        "reading",
        "checks",
        "lights",
        "normals",
        "refinement",
        "depth",
        "albedo",
        "meshes",
        "relit pictures",
        "page",
    )
    for name in stages:
        assert name in told, name
        assert min(told[name]) >= 0.0 and max(told[name]) <= 1.0 + 1e-9
    for name in ("reading", "lights", "normals", "refinement", "albedo", "meshes", "relit pictures"):
        assert max(told[name]) == pytest.approx(1.0), name
    assert told["normals"] == sorted(told["normals"]) and len(told["normals"]) > 5


def test_the_bench_measures_every_step(
    tmp_path: Path, capsys: pytest.CaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    flags = ["--height", "48", "--width", "64", "--images", "12", "--many", "20", "--out", str(tmp_path)]
    assert lab_main(["bench-infer", *flags, "--methods", "factorisation"]) == 0
    found = json.loads((tmp_path / "bench_infer.json").read_text())["kinds"]
    assert tuple(found) == kinds()  # this machine, and it held to AVX2 where it has more
    runs = found[HERE]
    assert runs["factorisation, 20 pictures"]["peak_gib"] > 0 and runs["factorisation, 12 pictures"]["seconds"] > 0
    assert "within 180 s, 3 GiB" in capsys.readouterr().out
    assert lab_main(["bench-infer", "--only-large", "240x180x3", "--out", str(tmp_path)]) == 0
    large = json.loads((tmp_path / "bench_large.json").read_text())
    assert large["stages"]["normals"][0] > 0 and large["peak_gib"] > 0 and large["expected"] > 0
    assert "million" not in (said := capsys.readouterr().out) and "of work), expected" in said
    asked = []
    monkeypatch.setattr(bench_infer, "_large", lambda _, config: asked.append((config.width, config.height)) or 0)
    assert lab_main(["bench-infer", "--quick", "--out", str(tmp_path)]) == 0 and asked == [(800, 600)]
    assert "too dark" in bench_infer.table({"pf14": {"error": "too dark"}}, bench_infer.BenchClassicalConfig(), "here")


def test_all_poses_of_a_folder(tmp_path: Path, capsys) -> None:
    """One line for each; one that fails stops no other, and the last line names it."""
    normals, mask = scenes.hills(32)
    images = scenes.lambertian(normals, mask, LIGHTS, albedo=0.7).images.astype(np.float32)
    for name, some in (("ps_a", images), ("ps_b", images[:6]), ("ps_c", images[:8])):
        folders.write_folder(tmp_path / "rig" / name, some)
        folders.write(tmp_path / "rig" / f"{name[3:]}.png", mask.astype(np.float32))
    (tmp_path / "rig" / "lights.txt").write_text(
        "".join(f"{number} {x} {y} {z}\n" for number, (x, y, z) in enumerate(LIGHTS, start=1))
    )
    folders.write(tmp_path / "rig" / "b.png", np.ones((9, 9)))
    out = tmp_path / "out"
    flags = ["--lights", "folder", "--intensities", "equal", "--method", "least-squares", "--anyway", "--out", str(out)]
    assert main(["infer", str(tmp_path / "rig"), *flags]) == 2
    said, wrong = capsys.readouterr()
    first, one, two, three = said.splitlines()
    assert first == "3 poses: a, b, c" and three.startswith("c: least-squares, given lights, 8 photographs, ")
    assert one.startswith("a: least-squares, given lights, 16 photographs, ") and one.endswith(
        str(out / "a" / "report.html")
    )
    assert two.startswith("!! b: ") and "b.png: the mask is 9x9 pixels" in two
    assert wrong.endswith("rig: 1 of 3 poses failed, for the reasons above: b\n")
    assert sorted(path.name for path in out.iterdir()) == ["a", "c"]
    for name in "ac":
        assert [file for file in FILES if not (out / name / file).is_file()] == []
        assert normal_mae(np.load(out / name / "normal.npy"), normals, mask) < 10.0  # shadows; else tens of degrees


def test_a_film_and_a_zip(tmp_path: Path, capsys) -> None:
    around = 2 * np.pi * np.arange(30) / 30
    lights = np.stack([0.6 * np.cos(around), 0.6 * np.sin(around), np.full(30, 0.8)], axis=1)
    images, mask = folders.matte(lights, size=32)
    writer = cv2.VideoWriter(str(tmp_path / "lamp.avi"), cv2.VideoWriter_fourcc(*"MJPG"), 25, mask.shape[::-1])
    for image in images:
        writer.write(np.rint(255 * folders.to_srgb(image[..., ::-1])).astype(np.uint8))
    writer.release()
    flags = ["--method", "am07", "--anyway", "--every", "5"]
    assert main(["infer", str(tmp_path / "lamp.avi"), "--out", str(tmp_path / "out"), *flags]) == 0
    said = capsys.readouterr().out
    assert "lamp.avi has 30 frames; one of every 5 frames was looked at, and 6 are the photographs" in said
    assert "lamp.avi" in (tmp_path / "out" / "report.html").read_text()
    assert len(json.loads((tmp_path / "out" / "lights.json").read_text())["images"]) == 6
    shutil.make_archive(str(tmp_path / "cup"), "zip", folders.write_folder(tmp_path / "cup", images[::5], mask))
    assert main(["infer", str(tmp_path / "cup.zip"), "--out", str(tmp_path / "zip"), *flags[:3]]) == 0
    assert "the mask is mask.png" in capsys.readouterr().out
    assert "cup is no film; leave the flag out" in fails(capsys, tmp_path / "cup", *flags, "--out", tmp_path / "no")
    assert not list(Path(tempfile.gettempdir()).glob("sdps-*/lamp.avi"))
