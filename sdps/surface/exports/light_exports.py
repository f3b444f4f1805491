"""The lights as other programs read them: RTI's .lp, DiLiGenT's text files, AliceVision's JSON.

Directions point from the surface to the light. In .lp and DiLiGenT's files x is right, y up, z to the viewer; in
AliceVision's y is down, z away. These files do not hold distances of near lamps; the result's lights.json does.
"""

from pathlib import Path

import numpy as np

from render.shared.errors import InputError
from render.shared.files import write_json, write_text
from sdps.surface.exports.saved_result import SavedLights, SavedResult


def write_lp(result: SavedResult, folder: Path) -> list[Path]:
    """Write lights.lp: the number of lights, then rows `name x y z`. It holds no intensities.

    Raises:
        InputError: the result has no lights.
    """
    lights, path = require_lights(result), folder / "lights.lp"
    rows = (f"{file} {_join(light)}" for file, light in zip(lights.files, lights.directions, strict=True))
    write_text(path, "\n".join([str(len(lights.files)), *rows]) + "\n")
    return [path]


def write_diligent(result: SavedResult, folder: Path) -> list[Path]:
    """Write light_directions.txt, light_intensities.txt (r g b) and filenames.txt, a row for each photograph.

    Raises:
        InputError: the result has no lights.
    """
    lights = require_lights(result)
    content = {
        "light_directions.txt": map(_join, lights.directions),
        "light_intensities.txt": map(_join, colour_gains(lights)),
        "filenames.txt": lights.files,
    }
    for name, rows in content.items():
        write_text(folder / name, "\n".join(rows) + "\n")
    return [folder / name for name in content]


def write_alicevision_lights(result: SavedResult, folder: Path) -> list[Path]:
    """Write lights.json as AliceVision's LightingCalibration does, in its frame.

    Each light has a lightId: AliceVision takes such lights in the order of the pictures, and needs no ids of its views.

    Raises:
        InputError: the result has no lights.
    """
    lights, path = require_lights(result), folder / "lights.json"
    turned = lights.directions * np.array([1, -1, -1], np.float32)
    rows = [
        {"lightId": str(number), "type": "directional", "direction": _list(direction), "intensity": _list(gain)}
        for number, (direction, gain) in enumerate(zip(turned, colour_gains(lights), strict=True))
    ]
    write_json(path, {"lights": rows})
    return [path]


def require_lights(result: SavedResult) -> SavedLights:
    """Return the lights of a result.

    Raises:
        InputError: there are none.
    """
    if result.lights is None:
        raise InputError(
            f"{result.folder}: no lights in it; run `sdps infer` again, with --lights or a method that finds them"
        )
    return result.lights


def colour_gains(lights: SavedLights) -> np.ndarray:
    """Return intensities (L, 3), the same in all channels where there is one."""
    gains = np.asarray(lights.intensities)
    return gains if gains.ndim == 2 else np.repeat(gains[:, None], 3, axis=1)


def _list(values: np.ndarray) -> list[float]:
    return [round(float(value), 6) + 0.0 for value in values]  # + 0.0: no -0.0


def _join(values: np.ndarray) -> str:
    return " ".join(f"{value:.6f}" for value in _list(values))
