"""SfMData for Meshroom: one view with its normal map, mask and lights, the camera and its pose, as AliceVision's JSON.

Version 1.2.6 of the format, which later versions read: numbers are texts, the principal point is an offset in pixels
from the picture's middle with the centre of the first pixel at 0, the focal length in millimetres of a sensor 36 wide.
"""

from pathlib import Path
from typing import Any

import numpy as np

from render.shared.files import write_json
from sdps.surface.exports.light_exports import write_alicevision_lights, write_lp
from sdps.surface.exports.map_files import write_picture, write_vectors
from sdps.surface.exports.normal_maps import ALICEVISION, code_normals
from sdps.surface.exports.reconstruction_folders import require_perspective
from sdps.surface.exports.saved_result import SavedResult

_VIEW = "1"  # its number, and that of its pose and camera
_SENSOR = 36.0  # millimetres


def write_meshroom(result: SavedResult, folder: Path) -> list[Path]:
    """Write the files of AliceVision's PhotometricStereo (1_normals.exr and .png, 1_mask.png), normalMaps.sfm, which
    names the map, the same of the albedo where there is one, and the lights.

    The world is the camera's frame, x right, y down, z away: normals in it are those of the camera.

    Raises:
        InputError: an orthographic camera, which SfMData does not know.
    """
    require_perspective(result)
    maps = {"normal": result.normals * np.array(ALICEVISION.values, np.float32)}
    if result.albedo is not None:
        maps["albedo"] = result.albedo
    made = [
        write_picture(folder / f"{_VIEW}_normals.png", code_normals(result.normals, result.mask, ALICEVISION)),
        write_picture(folder / f"{_VIEW}_mask.png", result.mask.astype(np.uint8) * 255),
    ]
    for name, values in maps.items():
        path = write_vectors(folder / f"{_VIEW}_{'normals' if name == 'normal' else name}.exr", values)
        write_json(folder / f"{name}Maps.sfm", describe_view(result, path))
        made += [path, folder / f"{name}Maps.sfm"]
    if result.lights is not None:
        made += write_alicevision_lights(result, folder) + write_lp(result, folder)
    return made


def describe_view(result: SavedResult, picture: Path) -> dict[str, Any]:
    """Return SfMData of one view, whose picture has the size of the result, JSON ready."""
    height, width = result.shape
    column, row = result.camera.middle(result.shape)
    size = {"width": str(width), "height": str(height)}
    view = {"viewId": _VIEW, "poseId": _VIEW, "frameId": "0", "intrinsicId": _VIEW,
            "path": str(picture.resolve()), **size, "metadata": ""}  # fmt: skip
    focal = _text(result.camera.focal * _SENSOR / width)
    intrinsic = {
        "intrinsicId": _VIEW, **size, "sensorWidth": _text(_SENSOR), "sensorHeight": _text(_SENSOR * height / width),
        "serialNumber": "", "type": "pinhole", "initializationMode": "calibrated", "initialFocalLength": focal,
        "focalLength": focal, "pixelRatio": "1", "pixelRatioLocked": "true",
        "principalPoint": [_text(column - width / 2), _text(row - height / 2)],
        "distortionInitializationMode": "none", "distortionParams": "", "undistortionOffset": ["0", "0"],
        "undistortionParams": "", "locked": "true",
    }  # fmt: skip
    rotation = [_text(value) for value in np.eye(3).ravel()]
    pose = {"transform": {"rotation": rotation, "center": ["0", "0", "0"]}, "locked": "true"}
    return {
        "version": ["1", "2", "6"],
        "views": [view],
        "intrinsics": [intrinsic],
        "poses": [{"poseId": _VIEW, "pose": pose}],
    }


def _text(value: float) -> str:
    return f"{value:.12g}"
