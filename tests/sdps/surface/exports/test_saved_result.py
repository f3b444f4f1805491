"""A result is read as it was written, and a folder that is none ends in one line."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import photo_folders as folders
import pytest
from saved_results import GAINS, LIGHTS, NAMES, save_result

import sdps
from render.shared.errors import InputError
from render.shared.files import read_json, write_json
from sdps.core.geometry import ORTHOGRAPHIC, Camera
from sdps.surface.exports.registry import EXPORTS, split_names
from sdps.surface.exports.saved_result import read_result


def test_what_infer_saves_is_read_again(tmp_path: Path) -> None:
    ring = np.arange(8) * np.pi / 4
    lights = np.stack([0.6 * np.cos(ring), 0.6 * np.sin(ring), np.full(8, 0.8)], axis=-1)
    images, mask = folders.matte(lights, size=40)
    photos = sdps.load(
        folders.write_folder(tmp_path / "photos", images, mask), focal="300px", principal="30,35", pixel_size=0.25
    )
    found = sdps.infer(photos, "pf14", findings=())
    found.save(tmp_path / "out")
    read = read_result(tmp_path / "out")
    assert np.array_equal(read.normals, found.normals) and np.array_equal(read.mask, photos.mask)
    assert np.allclose(read.depth, found.depth.z, atol=1e-4) and read.camera == photos.camera
    assert (read.unit, read.unit_size) == ("mm", 0.25) and read.albedo is None and read.expected_error is None
    assert read.lights is not None and read.lights.files == photos.files
    assert np.allclose(read.lights.directions, found.light_directions, atol=1e-5)
    plain = replace(photos, camera=ORTHOGRAPHIC)  # says no more than it did
    assert "camera_pixels" not in replace(found, photos=plain).summary()


def test_cameras_lamps_and_pictures_are_read(tmp_path: Path) -> None:
    nearness = np.array([0.2, 0.0, 0.1, 0.1])
    read = save_result(tmp_path, camera=Camera(200.0), nearness=nearness)
    assert read.camera == Camera(200.0, (30.0, 30.0)) and read.unit == "pixels" and read.pixel_size is None
    assert read.lights is not None and read.lights.files == NAMES
    assert np.allclose(read.lights.directions, LIGHTS, atol=1e-6) and np.allclose(read.lights.intensities, GAINS)
    assert read.lights.nearness == pytest.approx(nearness, abs=1e-5)
    assert read.albedo is not None and read.albedo.shape == (61, 61, 3) and read.expected_error is None


def test_folders_that_are_no_result_end_in_one_line(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no result of `sdps infer`"):
        read_result(tmp_path)
    save_result(tmp_path)
    facts = read_json(tmp_path / "result.json", "")
    for change, said in (
        ({"camera": "perspective, focal length 900 px"}, "earlier version"),
        ({"camera_pixels": {"focal": -1, "principal": [3, 4]}}, "focal length must be above 0"),
        ({"camera_pixels": {"focal": 100}}, "cannot be read"),
        ({"pixel_size": "wide"}, "cannot be read"),
    ):
        write_json(tmp_path / "result.json", facts | change)
        with pytest.raises(InputError, match=said):
            read_result(tmp_path)
    write_json(tmp_path / "result.json", facts)
    (tmp_path / "albedo.npy").write_bytes(b"\x93NUMPY damaged")
    with pytest.raises(InputError, match=r"albedo\.npy: damaged"):
        _ = read_result(tmp_path).albedo
    np.save(tmp_path / "normal.npy", np.zeros((5, 5, 3), np.float32))
    with pytest.raises(InputError, match=r"normal\.npy: is \(5, 5, 3\)"):
        read_result(tmp_path)
    np.save(tmp_path / "normal.npy", np.full((61, 61, 3), np.nan, np.float32))
    with pytest.raises(InputError, match="not finite"):
        read_result(tmp_path)
    (tmp_path / "depth.npy").unlink()
    with pytest.raises(InputError, match=r"depth\.npy: missing"):
        read_result(tmp_path)


def test_names_of_exports_are_checked() -> None:
    with pytest.raises(InputError, match="unknown export 'nonsense'"):
        split_names("nonsense")
    with pytest.raises(InputError, match="at least one"):
        split_names(" , ")
    names = ",".join([*EXPORTS, *EXPORTS])
    assert not EXPORTS or split_names(names) == tuple(EXPORTS)
