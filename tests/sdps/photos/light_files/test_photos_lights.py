"""Lights files: every layout that is documented, frames, and one clear line for each mistake."""

import json
from pathlib import Path

import numpy as np
import photo_folders as folders
import pytest

from render.shared.errors import InputError
from sdps import photos
from sdps.photos.light_files import FRAME, read_intensities, read_lights
from sdps.photos.light_files.light_frame import frame_matrix, frame_name

FILES = ("a 1.png", "b.png", "c.png")
LIGHTS = np.array([[0.6, 0.0, 0.8], [0.0, 0.6, 0.8], [0.0, -0.28, 0.96]])


@pytest.mark.parametrize(
    ("text", "strengths"),
    [
        ("0.6 0 0.8\n0 0.6 0.8\n0 -0.28 0.96\n", None),
        ("# from the chrome ball\n\n0.6\t0   0.8\n0 0.6 0.8 # north\n0 -0.28 0.96", None),
        ("3\n0.6 0 0.8\n0 0.6 0.8\n0 -0.28 0.96\n", None),
        ("0.6,0,0.8,1\n0,0.6,0.8,2\n0,-0.28,0.96,3e0\n", [1, 2, 3]),
        ("x,y,z,intensity\n0.6,0,0.8,1\n0,0.6,0.8,2\n0,-0.28,0.96,3\n", [1, 2, 3]),
        ('file;x;y;z\nc.png;0;-0.28;0.96\n"a 1.png";0.6;0;0.8\nb.png;0;0.6;0.8\n', None),
        ("b 0 0.6 0.8 2\na 1.png 0.6 0 0.8 1\nc 0 -0.28 0.96 3\nd.png 0 0 1 9\n", [1, 2, 3]),
        ("b.png 0 6 8 1 2 3\na 1.png 6 0 8 1 1 1\nc.png 0 -28 96 3 2 1\n", [[1, 1, 1], [1, 2, 3], [3, 2, 1]]),
    ],
)
def test_text_of_all_layouts(tmp_path: Path, text: str, strengths: list | None) -> None:
    path = tmp_path / "lights.txt"
    path.write_text(text)
    read = read_lights(path, FILES)
    np.testing.assert_allclose(read.directions, LIGHTS, atol=1e-6)
    assert read.directions.dtype == np.float32
    if strengths is None:
        assert read.intensities is None
    else:
        np.testing.assert_allclose(read.intensities, strengths)


def test_lights_json_comes_back_as_written(tmp_path: Path) -> None:
    path = tmp_path / "lights.json"
    for strengths in (np.array([1.0, 2.0, 0.5]), np.arange(1.0, 10.0).reshape(3, 3), None):
        photos.write_lights(path, FILES[::-1], LIGHTS[::-1], None if strengths is None else strengths[::-1])
        read = read_lights(path, FILES)
        np.testing.assert_allclose(read.directions, LIGHTS, atol=1e-6)
        np.testing.assert_allclose(read.intensities, np.ones(3) if strengths is None else strengths, atol=1e-6)
    content = json.loads(path.read_text())
    assert content["frame"] == FRAME == "x right, y up, z to the camera"
    assert content["images"][0] == {"file": "c.png", "direction": [0.0, -0.28, 0.96], "intensity": 1.0}


@pytest.mark.parametrize(
    ("frame", "signs"),
    [("y-up", (1, 1, 1)), ("y-down", (1, -1, 1)), ("x-left, y-down", (-1, -1, 1)), ("Y-down,z-away", (1, -1, -1)),
     ("x-left,y-up", (-1, 1, 1)), ("x-left,y-down,z-away", (-1, -1, -1)), ("y-down,y-down", (1, -1, 1))],
)  # fmt: skip
def test_frames(tmp_path: Path, frame: str, signs: tuple[int, int, int]) -> None:
    assert (frame_matrix(frame) == np.diag(signs)).all()
    assert frame_matrix(frame_name(frame_matrix(frame))).tolist() == np.diag(signs).tolist()
    path = tmp_path / "lights.txt"
    np.savetxt(path, LIGHTS * signs)
    np.testing.assert_allclose(read_lights(path, FILES, frame).directions, LIGHTS, atol=1e-6)


def refusal(path: Path, text: str, frame: str = "y-up") -> str:
    """Return the one line a lights file is refused with."""
    path.write_text(text)
    with pytest.raises(InputError) as error:
        read_lights(path, FILES, frame)
    assert "\n" not in str(error.value)
    return str(error.value)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("0 0 1\n0 0 1\n", "2 rows for 3 pictures (a 1.png to c.png)"),
        ("", "no row in it"),
        ("0 0 1\n0 zero 1\n0 0 1\n", "line 2 is not x y z"),
        ("0 0 1\n0 nan 1\n0 0 1\n", "line 2 is not x y z"),
        ("0 0 1\n0 0 1 2\n0 0 1\n", "line 2 has another layout than the first"),
        ("0 0 1\n0 0 0\n0 0 1\n", "the light of b.png is 0 0 0"),
        ("0 0 1\n0 1 -.1\n0 0 1\n", "the light of b.png has z = -0.0995, behind the object (1 of 3)"),
        ("0 0 -1\n0 1 -.1\n0 0 -1\n", "3 of 3 lights have z <= 0, behind the object (a 1.png, b.png, c.png); so z"),
        ("0 0 1 1\n0 0 1 0\n0 0 1 1\n", "the intensity of b.png is not positive"),
        ("a 1.png 0 0 1\nb 0 0 1\n", "no row for c.png (1 of 3 pictures lack one)"),
        ("a 1.png 0 0 1\nb 0 0 1\nb 0 0 1\n", "b is there twice"),
    ],
)
def test_mistakes_in_text(tmp_path: Path, text: str, says: str) -> None:
    assert says in refusal(tmp_path / "lights.txt", text)


def test_mistakes_in_json_and_frames(tmp_path: Path) -> None:
    path = tmp_path / "lights.json"
    assert "not a lights.json" in refusal(path, "[1, 2]")
    assert "not a lights.json" in refusal(path, '{"frame": "x"')
    assert "its frame is 'y down'" in refusal(
        path, '{"frame": "y down", "images": [{"file": "a", "direction": [0, 0, 1]}]}'
    )
    photos.write_lights(path, FILES, LIGHTS)
    assert "states its own frame" in refusal(path, path.read_text(), "y-down")
    assert "unknown frame 'y-don'; did you mean 'y-down'" in refusal(path, "", "y-don")
    assert "both y-up and y-down" in refusal(path, "", "y-down,y-up")


def test_intensities_of_their_own(tmp_path: Path) -> None:
    path = tmp_path / "strength.txt"
    path.write_text("1\n2\n3\n")
    np.testing.assert_allclose(read_intensities(path, FILES), [1, 2, 3])
    path.write_text("c.png 1 2 3\nb.png 2 2 2\na 1.png 3 2 1\n")
    np.testing.assert_allclose(read_intensities(path, FILES), [[3, 2, 1], [2, 2, 2], [1, 2, 3]])
    for text, says in (
        ("1\n2\n", "2 rows for 3"),
        ("1\n-2\n3\n", "not positive"),
        ("1 2\n1 2\n1 2\n", "line 1 is not i"),
    ):
        path.write_text(text)
        with pytest.raises(InputError, match=says):
            read_intensities(path, FILES)


def test_the_folder_s_lights_are_used_when_asked_for(tmp_path: Path) -> None:
    images = np.linspace(0.2, 1, 3)[:, None, None, None] * np.ones((3, 8, 9, 3))
    folders.write_folder(tmp_path, images, np.ones((8, 9)))
    np.savetxt(tmp_path / "light_directions.txt", LIGHTS)
    np.savetxt(tmp_path / "light_intensities.txt", np.arange(1, 10).reshape(3, 3))
    unknown = photos.load(tmp_path)
    assert unknown.light_directions is None and unknown.intensities is None
    given = photos.load(tmp_path, lights="folder")
    np.testing.assert_allclose(given.light_directions, LIGHTS, atol=1e-6)
    assert given.intensities.shape == (3, 3)
    alone = photos.load(tmp_path, intensities="folder")
    assert alone.light_directions is None and alone.intensities.shape == (3, 3)
    photos.write_lights(tmp_path / "lights.json", given.files, LIGHTS[::-1])
    np.testing.assert_allclose(photos.load(tmp_path, lights="folder").light_directions, LIGHTS[::-1], atol=1e-6)
    with pytest.raises(InputError, match="holds intensities as well"):
        photos.load(tmp_path, lights="folder", intensities="folder")
    (tmp_path / "lights.json").unlink()
    (tmp_path / "light_directions.txt").unlink()
    with pytest.raises(InputError, match=r"no lights\.json or light_directions\.txt in it"):
        photos.load(tmp_path, lights="folder")
    with pytest.raises(InputError, match=r"none.txt: no such file"):
        photos.load(tmp_path, lights=tmp_path / "none.txt")
