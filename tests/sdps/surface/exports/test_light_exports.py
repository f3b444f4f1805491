"""Lights that are written for other programs are read again to the same directions, in each program's frame."""

from pathlib import Path

import numpy as np
import pytest
from saved_results import GAINS, LIGHTS, NAMES, save_result

from render.shared.errors import InputError
from render.shared.files import read_json
from sdps.photos.light_files import read_intensities, read_lights, write_lights
from sdps.surface.exports.light_exports import write_alicevision_lights
from sdps.surface.exports.registry import write_exports
from sdps.surface.exports.saved_result import read_result


def test_lights_are_read_again(tmp_path: Path) -> None:
    result = save_result(tmp_path / "result")
    lp, directions, intensities, names = write_exports(result, ["lp", "diligent"], tmp_path / "out")
    (json,) = write_alicevision_lights(result, tmp_path)
    for path in (lp, directions, json):
        assert np.allclose(read_lights(path, NAMES).directions, LIGHTS, atol=2e-6), path.name
    assert np.allclose(read_lights(lp, NAMES[::-1]).directions, LIGHTS[::-1], atol=2e-6)  # by name
    assert np.allclose(read_intensities(intensities, NAMES), GAINS, atol=2e-6)
    assert names.read_text().splitlines() == list(NAMES)
    strengths = read_lights(json, NAMES).intensities
    assert strengths is not None and np.allclose(strengths, GAINS, atol=2e-6)
    assert lp.read_text().startswith("4\na 1.png 0.600000 0.000000 0.800000\n")
    first = read_json(json, "")["lights"][1]
    assert first["direction"] == [0.0, -0.6, -0.8] and first["lightId"] == "1"  # y down, z away


def test_pictures_that_are_numbered_from_1_keep_their_lights(tmp_path: Path) -> None:
    result = save_result(tmp_path / "result")
    (json,) = write_alicevision_lights(result, tmp_path)
    numbered = [f"{number}.png" for number in range(1, 5)]
    assert np.allclose(read_lights(json, numbered).directions, LIGHTS, atol=2e-6)


def test_lights_that_a_method_found_behind_the_object_are_written(tmp_path: Path) -> None:
    save_result(tmp_path / "result")
    behind = LIGHTS * (1, 1, -1)
    write_lights(tmp_path / "result" / "lights.json", NAMES, behind)
    (lp,) = write_exports(read_result(tmp_path / "result"), ["lp"], tmp_path / "out")
    assert np.allclose(read_lights(lp, NAMES, "z-away").directions, LIGHTS, atol=2e-6)


def test_a_result_without_lights_says_so(tmp_path: Path) -> None:
    save_result(tmp_path)
    (tmp_path / "lights.json").unlink()
    from sdps.surface.exports.saved_result import read_result

    with pytest.raises(InputError, match="no lights in it"):
        write_exports(read_result(tmp_path), ["lp"], tmp_path / "out")
