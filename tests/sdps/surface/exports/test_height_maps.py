"""Height, slopes and curvature of a ball and a cylinder, in millimetres, as another reader sees them."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
import tifffile
from saved_results import save_result, sphere

from render.shared.files import read_json
from sdps.core.geometry import ORTHOGRAPHIC, Camera
from sdps.inference import tiles
from sdps.surface.exports.height_maps import measure_curvatures
from sdps.surface.exports.registry import write_exports
from sdps.surface.exports.saved_result import SavedResult

RADIUS = 24.0


def middle_of(result: SavedResult) -> np.ndarray:
    """Return the pixels of the ball that are not near its rim."""
    return result.normals[..., 2] > 0.75


@pytest.mark.parametrize("camera", [ORTHOGRAPHIC, Camera(150.0, (27.0, 34.0))])
@pytest.mark.parametrize("size", [None, 0.25])
def test_a_ball_has_the_curvature_of_its_radius(
    tmp_path: Path, camera: Camera, size: float | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tiles, "_BAND_PIXELS", 10 * 61)  # several parts, of ten rows
    result = save_result(tmp_path, sphere(camera=camera), camera=camera, pixel_size=size)
    mean, gauss = measure_curvatures(result)
    inside, radius = middle_of(result), RADIUS * (size or 1.0)
    assert mean[inside] * radius == pytest.approx(1.0, abs=0.02)
    assert gauss[inside] * radius**2 == pytest.approx(1.0, abs=0.03)
    assert not mean[~result.mask].any() and not gauss[~result.mask].any()


def test_a_dent_is_negative_and_a_cylinder_has_one_curvature(tmp_path: Path) -> None:
    normals, mask, z = sphere()
    dent = save_result(tmp_path / "dent", (normals * np.float32([-1, -1, 1]), mask, -z))
    mean, gauss = measure_curvatures(dent)
    assert mean[middle_of(dent)] * RADIUS == pytest.approx(-1.0, abs=0.02)
    assert gauss[middle_of(dent)] * RADIUS**2 == pytest.approx(1.0, abs=0.03)
    along = (np.arange(41) - 20) / RADIUS  # its axis lies aslant
    across = (along[:, None] + along[None]) / np.sqrt(2)
    mask = np.abs(across) < 0.6
    slant = across / np.sqrt(2)
    turned = np.where(mask[..., None], np.stack([slant, -slant, np.sqrt(1 - np.minimum(across**2, 0.9))], -1), 0)
    cylinder = save_result(tmp_path / "cylinder", (turned.astype(np.float32), mask, np.zeros((41, 41), np.float32)))
    mean, gauss = measure_curvatures(cylinder)
    inner = np.abs(across) < 0.5
    assert mean[inner] * RADIUS == pytest.approx(0.5, abs=0.01)
    assert np.abs(gauss[inner]).max() * RADIUS**2 < 0.01


def test_heights_and_slopes_are_read_in_millimetres(tmp_path: Path) -> None:
    result = save_result(tmp_path / "result", pixel_size=0.25)
    made = write_exports(result, ["height", "gradients", "curvature"], tmp_path / "out")
    names = {path.name: path for path in made}
    with tifffile.TiffFile(names["height.tif"]) as tiff:
        page = tiff.pages[0]
        heights, about = page.asarray(), json.loads(page.description)
        assert page.tags["XResolution"].value[0] / page.tags["XResolution"].value[1] == pytest.approx(40)
        assert page.tags["ResolutionUnit"].value == 3 and about["unit"] == "mm"  # 40 pixels a centimetre
    assert heights.dtype == np.float32 and np.allclose(heights, result.depth * 0.25, atol=1e-5)
    coded = cv2.imread(str(names["height-16bit.tif"]), cv2.IMREAD_UNCHANGED)
    facts = read_json(names["height.json"], "")
    assert coded.dtype == np.uint16 and not coded[~result.mask].any() and coded.max() == 65534
    read = facts["lowest"] + (coded[result.mask].astype(float) - 1) * facts["step"]
    assert np.abs(read - heights[result.mask]).max() <= 0.51 * facts["step"] and facts["step"] < 1e-4
    slopes = [cv2.imread(str(names[f"gradient-{axis}.tif"]), cv2.IMREAD_UNCHANGED) for axis in "xy"]
    inside = middle_of(result)
    down, right = np.gradient(result.depth)
    assert np.abs(slopes[0] - right)[inside].max() < 0.01 and np.abs(slopes[1] + down)[inside].max() < 0.01
    with tifffile.TiffFile(names["gaussian-curvature.tif"]) as tiff:
        assert json.loads(tiff.pages[0].description)["unit"] == "1/mm^2"
    plain = save_result(tmp_path / "plain")
    (first, *_) = write_exports(plain, ["height"], tmp_path / "pixels")
    with tifffile.TiffFile(first) as tiff:
        assert json.loads(tiff.pages[0].description)["unit"] == "pixels"
