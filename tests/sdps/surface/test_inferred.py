"""What `infer` writes: a folder with a result.json holds files of one run."""

import errno
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import photo_folders as folders
import pytest
from any_light_weights import write_weights

import sdps
from render.shared.errors import InputError
from sdps.core.estimate import Estimate
from sdps.core.geometry import FAR, ORTHOGRAPHIC
from sdps.refinement.surroundings.outcome import LowOrderEstimate, refine_estimate


def test_a_run_that_is_cut_off_leaves_no_result(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    ring = np.arange(12) * np.pi / 6
    images, _ = folders.matte(np.stack([0.8 * np.cos(ring), 0.8 * np.sin(ring), np.full(12, 0.6)], axis=-1))
    photos = sdps.load(folders.write_folder(tmp_path / "photos", images))
    found = sdps.infer(photos, "pf14", findings=())
    out = tmp_path / "out"
    names = {path.name for path in found.save(out)}
    assert {"result.json", "normal.npy", "mesh.ply"} <= names and (out / "result.json").exists()
    replace, moved = Path.replace, []

    def replace_three(self: Path, target: Path) -> Path:
        moved.append(self)
        if len(moved) > 3:
            raise OSError(errno.EIO, "Input/output error")
        return replace(self, target)

    monkeypatch.setattr(Path, "replace", replace_three)
    with pytest.raises(InputError, match="cannot be written"):
        found.save(out)
    assert not (out / "result.json").exists() and np.load(out / "normal.npy").shape == found.normals.shape


def test_lamps_that_were_found_light_the_albedo_and_are_written(tmp_path: Path) -> None:
    ring = np.arange(12) * np.pi / 6
    lights = np.stack([0.8 * np.cos(ring), 0.8 * np.sin(ring), np.full(12, 0.6)], axis=-1)
    images, mask = folders.matte(lights)
    photos = sdps.load(folders.write_folder(tmp_path / "photos", images, mask))
    plain = sdps.infer(photos, "pf14", findings=())
    nearness = np.linspace(0.1, 0.2, 12, dtype=np.float32)
    near, far, told = (
        replace(plain, photos=replace(photos, light_nearness=given), estimate=replace(plain.estimate, nearness=found))
        for given, found in ((None, nearness), (None, np.full(12, 0.9 * FAR, np.float32)), (nearness, None))
    )
    origins = [result.lamps["origin"] for result in (plain, far, near, told)]
    assert origins == ["assumed", "found", "found", "given"]
    said = "the lamps stood about 3.3 object sizes away, the nearest 2.5, the furthest 5"
    assert near.summary()["lamps"]["text"] == said
    assert told.lamps["text"] == f"{said}, as given"
    assert plain.albedo is not None and near.albedo is not None and told.albedo is not None
    assert np.array_equal(far.albedo, plain.albedo)
    assert np.abs(near.albedo - plain.albedo).max() > 0.05 * plain.albedo.max()
    assert np.array_equal(near.albedo, told.albedo)
    near.save(tmp_path / "out")
    written = json.loads((tmp_path / "out" / "lights.json").read_text())
    far_away = [np.linalg.norm(image["position"]) for image in written["images"]]
    assert far_away == pytest.approx(0.5 / nearness, rel=1e-4)


def test_a_network_that_finds_no_lights_gives_everything_else(tmp_path: Path) -> None:
    lights = np.array([[0.5, 0.0, 0.8], [0.0, 0.5, 0.8], [-0.5, 0.0, 0.8], [0.0, -0.5, 0.8]])
    images, mask = folders.matte(lights, size=40)
    photos = sdps.load(folders.write_folder(tmp_path / "photos", images + 0.2, mask))
    out = write_weights(tmp_path / "runs")
    found = sdps.infer(photos, "anylight", models=out, findings=())
    assert found.normals.shape == (*mask.shape, 3) and found.refinement is None
    assert not len(found.light_directions) and found.albedo is None and found.residuals is None
    assert found.expected_error is not None
    names = {path.name for path in found.save(tmp_path / "out")}
    assert {"mesh.ply", "normal.npy", "expected-error.npy"} <= names and "lights.json" not in names
    written = json.loads((tmp_path / "out" / "result.json").read_text())
    assert written["light_directions"] == written["light_intensities"] == "not found"
    with pytest.raises(InputError, match="is given lamps"):
        sdps.infer(photos, "anylight+fuse", models=out, findings=())
    refined = sdps.infer(photos, "anylight", models=out, refine=True, findings=())
    assert refined.method.endswith("refined") and refined.residuals is None
    assert isinstance(refined.estimate, LowOrderEstimate) and refined.summary()["refined"]["kept"]
    assert refined.albedo is not None and not len(refined.light_directions)


def test_refinement_without_lights_tells_the_albedo(tmp_path: Path) -> None:
    lights = np.array([[0.5, 0.0, 0.8], [0.0, 0.5, 0.8], [-0.5, 0.0, 0.8], [0.0, -0.5, 0.8]])
    images, mask = folders.matte(lights, size=40)
    photos = sdps.load(folders.write_folder(tmp_path / "photos", images + 0.2, mask))
    plain = sdps.infer(photos, "pf14", findings=())
    normals = sdps.estimate(images, mask, "true+least-squares", light_directions=lights).normals
    start = Estimate(normals, np.zeros((0, 3), np.float32), np.zeros(0, np.float32))
    found = replace(plain, estimate=refine_estimate(images + 0.2, mask, start, ORTHOGRAPHIC))
    assert found.albedo is not None and found.residuals is None and found.refinement is None
    names = {path.name for path in found.save(tmp_path / "out")}
    assert "albedo.npy" in names and not {"lights.json", "highlights.npy", "residual.npy"} & names
    assert np.array_equal(np.load(tmp_path / "out" / "albedo.npy"), found.albedo)
    about = json.loads((tmp_path / "out" / "result.json").read_text())["refined"]
    assert about["kept"] and not about["doubt"] and about["misfit"][1] < about["misfit"][0]
    assert 0.1 < about["normals_moved_degrees"] < 20.0


def test_without_lights_a_doubted_refinement_is_not_kept() -> None:
    lights = np.array([[0.5, 0.0, 0.8], [0.0, 0.5, 0.8], [-0.5, 0.0, 0.8], [0.0, -0.5, 0.8]])
    images, mask = folders.matte(lights, size=24)
    facing = mask[..., None] * np.array([0.0, 0.0, 1.0], np.float32)
    start = Estimate(facing, np.zeros((0, 3), np.float32), np.zeros(0, np.float32))
    found = refine_estimate(images + 0.2, mask, start, ORTHOGRAPHIC)
    assert "flat" in found.low_order.doubt and found.albedo is None
    assert np.array_equal(found.normals, facing) and found.expected_error is None
