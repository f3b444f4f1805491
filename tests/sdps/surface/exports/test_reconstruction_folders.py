"""Folders for BiNI, RNb-NeuS and Meshroom: what their own formulas make of the files is the surface."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from saved_results import save_result, sphere

from render.shared.errors import InputError
from render.shared.files import read_json
from sdps.core.geometry import Camera
from sdps.surface.exports.reconstruction_folders import write_bini
from sdps.surface.exports.registry import write_exports
from sdps.surface.exports.saved_result import SavedResult

CAMERA = Camera(150.0, (27.0, 34.0))


@pytest.fixture
def ball(tmp_path: Path) -> SavedResult:
    return save_result(tmp_path / "result", sphere(camera=CAMERA), camera=CAMERA, pixel_size=0.5)


def decode(path: Path) -> np.ndarray:
    """Return the vectors of a 16-bit normal map, in the frame of its colours."""
    return cv2.imread(str(path), cv2.IMREAD_UNCHANGED)[..., ::-1] / 65535 * 2 - 1


def test_bini_finds_the_depth_of_its_folder(ball: SavedResult, tmp_path: Path) -> None:
    """BiNI, eq. 15: with u up from the last row and v right, d log(z) / du = -n_u / (n_u u' + n_v v' + f n_z)."""
    write_exports(ball, ["bini"], tmp_path)
    coded, matrix = decode(tmp_path / "bini" / "normal_map.png"), np.loadtxt(tmp_path / "bini" / "K.txt")
    assert np.array_equal(cv2.imread(str(tmp_path / "bini" / "mask.png"), cv2.IMREAD_GRAYSCALE) > 0, ball.mask)
    height, width = ball.shape
    rows, columns = np.mgrid[:height, :width]
    up, right = height - 1 - rows - matrix[0, 2], columns - matrix[1, 2]
    n_u, n_v, n_z = coded[..., 1], coded[..., 0], -coded[..., 2]
    facing = up * n_u + right * n_v + matrix[0, 0] * n_z
    down, across = np.gradient(np.log(CAMERA.focal - ball.depth))
    inside = ball.normals[..., 2] > 0.75
    assert np.abs(-n_u / facing + down)[inside].max() < 1e-4 < np.abs(down)[inside].max()
    assert np.abs(-n_v / facing - across)[inside].max() < 1e-4


def test_an_orthographic_folder_has_no_camera(tmp_path: Path) -> None:
    result = save_result(tmp_path / "result")
    (tmp_path / "K.txt").write_text("1 0 0\n0 1 0\n0 0 1\n")  # of an earlier export
    assert [path.name for path in write_bini(result, tmp_path)] == ["normal_map.png", "mask.png"]
    assert not (tmp_path / "K.txt").exists()
    for name in ("rnb", "meshroom"):
        with pytest.raises(InputError, match="again with --focal"):
            write_exports(result, [name], tmp_path)


def test_rnb_sees_the_surface_where_it_is(ball: SavedResult, tmp_path: Path) -> None:
    write_exports(ball, ["rnb"], tmp_path)
    folder = tmp_path / "rnb"
    cameras = np.load(folder / "cameras.npz")
    matrix, rotation, place = cv2.decomposeProjectionMatrix((cameras["world_mat_0"] @ cameras["scale_mat_0"])[:3])[:3]
    points = CAMERA.positions(ball.depth)[ball.mask] - [0, 0, CAMERA.focal]
    points = points * [0.5, -0.5, -0.5]  # millimetres, y down, z away
    scaled = (np.linalg.inv(cameras["scale_mat_0"]) @ np.c_[points, np.ones(len(points))].T).T[:, :3]
    assert 0.85 < np.linalg.norm(scaled, axis=1).max() < 1.0
    seen = (matrix @ rotation @ (scaled - (place[:3] / place[3])[:, 0]).T).T
    rows, columns = np.nonzero(ball.mask)
    assert np.allclose(seen[:, :2] / seen[:, 2:], np.c_[columns, rows], atol=1e-3)
    assert np.abs(decode(folder / "normal" / "000.png") - ball.normals)[ball.mask].max() < 2e-5
    albedo = cv2.imread(str(folder / "albedo" / "000.png"), cv2.IMREAD_UNCHANGED)
    assert albedo.dtype == np.uint16 and albedo.max() == 65535


def test_meshroom_finds_map_camera_and_pose(ball: SavedResult, tmp_path: Path) -> None:
    names = {path.name for path in write_exports(ball, ["meshroom"], tmp_path)}
    assert names == {"1_normals.png", "1_normals.exr", "1_mask.png", "1_albedo.exr", "normalMaps.sfm",
                     "albedoMaps.sfm", "lights.json", "lights.lp"}  # fmt: skip
    scene = read_json(tmp_path / "meshroom" / "normalMaps.sfm", "")
    (view,), (intrinsic,), (pose,) = scene["views"], scene["intrinsics"], scene["poses"]
    assert Path(view["path"]).is_file() and view["viewId"] == view["poseId"] == pose["poseId"]
    assert intrinsic["intrinsicId"] == view["intrinsicId"] and intrinsic["type"] == "pinhole"
    width = int(intrinsic["width"])
    # As AliceVision's reader: focal length in pixels by the sensor's width, the principal point from the middle.
    assert float(intrinsic["focalLength"]) / float(intrinsic["sensorWidth"]) * width == pytest.approx(CAMERA.focal)
    middle = [float(offset) + width / 2 for offset in intrinsic["principalPoint"]]
    assert middle == pytest.approx(CAMERA.principal)
    rotation = np.array(pose["pose"]["transform"]["rotation"], float).reshape(3, 3)
    assert np.array_equal(rotation, np.eye(3))
