"""Normal maps have the axes and background of who wants them, as other readers see them."""

from pathlib import Path

import cv2
import numpy as np
import OpenEXR
import pytest
from saved_results import save_result

from render.shared.files import read_json
from sdps.core.metrics import angle_degrees
from sdps.surface.exports.normal_maps import CONVENTIONS, face_viewer, write_normals
from sdps.surface.exports.registry import EXPORTS, write_exports

RIGHT, TOP = (30, 45), (15, 30)  # pixels of the ball that face right and up


def read_png(path: Path) -> np.ndarray:
    """Return the colours of a PNG in RGB order, as OpenCV reads them."""
    return cv2.imread(str(path), cv2.IMREAD_UNCHANGED)[..., ::-1]


@pytest.mark.parametrize("name", CONVENTIONS)
def test_pictures_look_as_each_wants(tmp_path: Path, name: str) -> None:
    result = save_result(tmp_path / "result")
    made = write_exports(result, [f"normals-{name}"], tmp_path / "out")
    assert [path.name for path in made] == ["normal.png", "normal.exr", "normal.json"]
    coded = read_png(made[0])
    assert coded.dtype == np.uint16 and (coded[RIGHT][0] > 40000) and (coded[RIGHT][2] > 40000)
    assert (coded[TOP][1] > 40000) == (name != "directx")
    decoded = coded / 65535 * 2 - 1
    signs = np.array([1, -1 if name == "directx" else 1, 1])
    inside = result.mask
    assert np.abs(decoded[inside] * signs - result.normals[inside]).max() < 2e-5
    flat = name in ("opengl", "directx")
    assert (coded[~inside] == ([32768, 32768, 65535] if flat else [32768] * 3)).all()
    (part,) = OpenEXR.File(str(made[1]), separate_channels=True).parts
    assert sorted(part.channels) == ["B", "G", "R"]
    values = np.stack([part.channels[letter].pixels for letter in "RGB"], axis=-1)
    wanted = {"directx": [1, -1, 1], "alicevision": [1, -1, -1]}.get(name, [1, 1, 1])
    assert values.dtype == np.float32 and np.array_equal(values, result.normals * np.float32(wanted))
    about = read_json(made[2], "")
    assert about["convention"] == name and "turned_degrees" not in about


def test_a_map_that_fills_the_picture_faces_the_viewer_and_tells_how_it_tiles(tmp_path: Path) -> None:
    waves = np.sin(2 * np.pi * np.arange(64) / 64)  # whole waves: the edges are neighbours
    slopes = np.stack([0.2 + 0.3 * np.broadcast_to(waves, (64, 64)), np.full((64, 64), -0.1)], axis=-1)
    normals = np.dstack([slopes, np.ones((64, 64))])
    normals = (normals / np.linalg.norm(normals, axis=-1, keepdims=True)).astype(np.float32)
    whole = np.ones((64, 64), bool)
    result = save_result(tmp_path / "result", (normals, whole, np.zeros((64, 64), np.float32)))
    made = write_normals("opengl", result, tmp_path)
    about = read_json(made[2], "")
    edges = about["edges_differ_degrees"]
    assert edges["left_right"] < 2 * edges["neighbours"] + 0.1 and edges["top_bottom"] == pytest.approx(0, abs=0.05)
    assert about["turned_degrees"] == pytest.approx(np.degrees(np.arctan(np.hypot(0.2, 0.1))), abs=0.1)
    turned, _ = face_viewer(normals)
    assert np.abs(np.linalg.norm(turned, axis=-1) - 1).max() < 1e-5
    assert angle_degrees((turned / turned[..., 2:]).mean((0, 1)), np.array([0, 0, 1])) < 1.0  # 12.6 before
    assert np.abs(read_png(made[0]) / 65535 * 2 - 1 - turned).max() < 2e-5
    kept = write_normals("camera", result, tmp_path)
    assert np.abs(read_png(kept[0]) / 65535 * 2 - 1 - normals).max() < 2e-5
    assert "turned_degrees" not in read_json(kept[2], "")


def test_every_convention_is_an_export() -> None:
    assert {f"normals-{name}" for name in CONVENTIONS} <= set(EXPORTS)
