"""Lamps that are near: positions in lights files, `--light-distance`, lights.json, and one line for each mistake."""

import json
from pathlib import Path

import numpy as np
import photo_folders as folders
import pytest

from render.shared.errors import InputError
from sdps import photos
from sdps.core.geometry import Capture
from sdps.photos.light_files import read_lights, write_lights

FILES = ("a.png", "b.png", "c.png")
PLACES = np.array([[30.0, 0.0, 40.0], [0.0, -60.0, 80.0], [28.0, 0.0, 96.0]])
DIRECTIONS = np.array([[0.6, 0.0, 0.8], [0.0, -0.6, 0.8], [0.28, 0.0, 0.96]])
ROWS = "30 0 40\n0 -60 80\n28 0 96\n"


def write(path: Path, text: str) -> Path:
    path.write_text(text)
    return path


@pytest.mark.parametrize(
    ("name", "text", "unit"),
    [
        ("l.txt", "# near, unit mm\n" + ROWS, "mm"),
        ("l.txt", "# from the CAD file\n\nnear lamps, unit cm, object 5 0 10\n35 0 50\n5 -60 90\n33 0 106\n", "cm"),
        ("l.lp", "3\n% near, unit: px\nc 28 0 96\nb.png 0 -60 80\na 30 0 40\n", "pixels"),
        ("l.csv", "# near; unit m\nfile,x,y,z\nb.png,0,-60,80\nc.png,28,0,96\na.png,30,0,40\n", "m"),
        ("l.json", json.dumps({"kind": "near", "unit": "mm", "positions": PLACES.tolist()}), "mm"),
        ("l.yaml", "kind: near\nunit: objects\nobject: [0, 0, -4]\npositions:\n- [30, 0, 36]\n- [0, -60, 76]\n"
                   "- {x: 28, y: 0, z: 92}\n", "objects"),
        ("l.yml", "kind: near\nunit: cm\npositions:\n  c.png: [28, 0, 96]\n  a.png: [30, 0, 40]\n  b: [0, -60, 80]\n",
         "cm"),
    ],
)  # fmt: skip
def test_positions_of_all_layouts(tmp_path: Path, name: str, text: str, unit: str) -> None:
    read = read_lights(write(tmp_path / name, text), FILES)
    np.testing.assert_allclose(read.directions, DIRECTIONS, atol=1e-6)
    np.testing.assert_allclose(read.distances, [50, 100, 100])
    assert (read.unit, read.intensities) == (unit, None)
    assert any(note.startswith("its lamps stand 50 to 100 ") for note in read.notes)


def test_intensities_and_axes_of_positions(tmp_path: Path) -> None:
    """A flag turns positions and the object's place alike."""
    text = "# near, unit mm, object 0 7 -9\n30 7 -49 1\n0 67 -89 2\n28 7 -105 3\n"
    read = read_lights(write(tmp_path / "l.txt", text), FILES, "y-down,z-away")
    np.testing.assert_allclose(read.directions, DIRECTIONS, atol=1e-6)
    np.testing.assert_allclose(read.intensities, [1, 2, 3])
    by_name = {"kind": "near", "unit": "m", "positions": dict(zip(FILES, PLACES.tolist(), strict=True))}
    for strengths in ([1.0, 2.0, 3.0], [[1.0, 2.0, 3.0]] * 3):
        content = by_name | {"intensities": dict(zip(FILES, strengths, strict=True))}
        read = read_lights(write(tmp_path / "l.json", json.dumps(content)), FILES[::-1])
        np.testing.assert_allclose(read.intensities, strengths[::-1])
    plain = read_lights(write(tmp_path / "l.txt", "# near the window\n" + ROWS), FILES)
    assert plain.distances is None  # a comment as before


def test_lights_json_with_positions_comes_back(tmp_path: Path) -> None:
    path, nearness = tmp_path / "lights.json", np.array([0.2, 0.0, 0.4])
    write_lights(path, FILES, DIRECTIONS, np.array([1.0, 2.0, 3.0]), nearness)
    content = json.loads(path.read_text())
    assert (content["kind"], content["unit"]) == ("near", "objects")
    assert content["images"][0]["position"] == [1.5, 0.0, 2.0]
    assert "position" not in content["images"][1]
    read = read_lights(path, FILES)
    np.testing.assert_allclose(read.directions, DIRECTIONS, atol=1e-6)
    np.testing.assert_allclose(read.intensities, [1, 2, 3])
    np.testing.assert_allclose(0.5 / read.distances, nearness, atol=1e-6)
    assert 0.5 / read.distances[1] == 0.0
    for distant in (None, np.zeros(3)):  # the same bytes as before
        write_lights(path, FILES, DIRECTIONS, None, distant)
        assert list(json.loads(path.read_text())) == ["frame", "images"]


@pytest.mark.parametrize(
    ("name", "text", "said"),
    [
        ("l.txt", "# near, unit inches\n" + ROWS, "unknown unit 'inches'.*mm, cm, m, pixels, objects"),
        ("l.txt", "# near\n" + ROWS, "line 1 says near lamps without a unit; write '# near, unit mm'"),
        ("l.txt", "# near, unit mm, object 0 0\n" + ROWS, "object .* is not three numbers x y z"),
        ("l.txt", "# near, unit mm\nazimuth elevation\n0 40\n90 40\n180 40\n", "need positions x y z"),
        ("l.txt", "# near, unit mm\n30 0 40\n0 0 0\n28 0 96\n", "the lamp of b.png stands in the object's middle"),
        ("l.txt", "# near, unit mm\n30 0 40\n0 -60 -80\n28 0 96\n", "b.png has z = -0.8, behind the object"),
        ("l.txt", "# near, unit mm\n30 0 40\n0 -60 80\n", "2 rows for 3 pictures"),
        ("l.yaml", "kind: near\npositions: [[0, 0, 1]]\n", "no unit; write unit: mm, cm, m, pixels or objects"),
        ("l.yaml", "kind: neer\nunit: mm\npositions: [[0, 0, 1]]\n", "unknown kind of lights 'neer'.*'near'"),
        ("l.yaml", "kind: near\nunit: mm\nposition: [[0, 0, 1]]\n", "unknown field 'position'.*'positions'"),
        ("l.yaml", "kind: near\nunit: mm\n", "no positions in it"),
        ("l.yaml", "kind: near\nunit: mm\npositions: [[0, 0, 1], [0, 1]]\n", r"position '\[0, 1\]' is not three num"),
        ("l.yaml", "kind: near\nunit: mm\npositions: [[0, 0, .inf]]\n", "is not three numbers x y z, finite"),
        ("l.yaml", "kind: near\nunit: mm\npositions: {010: [0, 0, 1]}\n", "must be in quotes"),
        ("l.yaml", "kind: near\nunit: mm\npositions: [[0, 0, 1]]\nintensities: [1, 2]\n", "one for each of its 1 pos"),
        ("l.yaml", "kind: near\nunit: mm\npositions: {a: [0, 0, 1]}\nintensities: {b: 1}\n", "names of its positions"),
        ("l.yaml", "kind: [near\n", "l.yaml"),
    ],
)  # fmt: skip
def test_each_mistake_has_one_line(tmp_path: Path, name: str, text: str, said: str) -> None:
    path = write(tmp_path / name, text)
    with pytest.raises(InputError, match=said) as caught:
        read_lights(path, FILES)
    assert str(caught.value).startswith(str(path)) and "\n" not in str(caught.value)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder of five photographs of a matte object, with a mask; its lights point as `TURNED`."""
    images, mask = folders.matte(TURNED, size=48)
    return folders.write_folder(tmp_path_factory.mktemp("photographs"), images, mask)


TURNED = np.array([[0.6, 0.0, 0.8], [0.0, 0.6, 0.8], [-0.6, 0.0, 0.8], [0.0, -0.6, 0.8], [0.0, 0.0, 1.0]])


def rows(lights: np.ndarray, heading: str = "") -> str:
    return heading + "".join(f"{x} {y} {z}\n" for x, y, z in lights)


@pytest.mark.parametrize(
    ("unit", "options", "length"),
    [("objects", {}, 2.0), ("pixels", {}, 1.0), ("pixels", {"scale": 0.5}, 0.5), ("mm", {"pixel_size": 0.2}, 5.0),
     ("cm", {"pixel_size": 0.2}, 50.0), ("m", {"pixel_size": 4.0, "scale": 0.5}, 125.0)],
)  # fmt: skip
def test_units(folder: Path, unit: str, options: dict, length: float) -> None:
    """`length`: of the unit, in pixels as they are read; in radii for sizes of the object."""
    distances = 100.0 * np.array([1.0, 2.0, 3.0, 4.0, 5.0])
    path = write(folder / "lights.txt", rows(TURNED * distances[:, None], f"# near, unit {unit}\n"))
    read = photos.load(folder, lights=path, **options)
    radius = 1.0 if unit == "objects" else Capture.of(read.mask).radius
    np.testing.assert_allclose(read.light_nearness, radius / (distances * length), rtol=1e-6)
    assert read.light_nearness.dtype == np.float32
    np.testing.assert_allclose(read.light_directions, TURNED, atol=1e-6)


def test_the_distance_of_all_lamps(folder: Path) -> None:
    lights = write(folder / "directions.txt", rows(TURNED))
    radius = Capture.of(photos.load(folder).mask).radius
    for value, options, nearness in (
        (None, {}, None), ("auto", {}, None), ("far", {}, 0.0), (2.5, {}, 0.2), ("2.5 objects", {}, 0.2),
        ("inf", {}, 0.0), ("100px", {}, radius / 100), ("0.1m", {"pixel_size": 2.0}, radius / 50),
    ):  # fmt: skip
        for given in (None, lights):
            read = photos.load(folder, lights=given, light_distance=value, **options)
            if nearness is None:
                assert read.light_nearness is None
            else:
                np.testing.assert_allclose(read.light_nearness, np.full(5, nearness), rtol=1e-6)
            assert not read.nearness_each
    each = photos.load(folder, light_distance="each")
    assert each.light_nearness is None and each.nearness_each


@pytest.mark.parametrize(
    ("heading", "options", "said"),
    [
        ("", {"light_distance": "fra"}, "--light-distance: unknown distance 'fra'; did you mean 'far'"),
        ("", {"light_distance": "40 ft"}, "--light-distance: unknown unit 'ft'"),
        ("", {"light_distance": 0}, "--light-distance 0: must be above 0; write far"),
        ("", {"light_distance": "nan"}, "--light-distance: unknown distance 'nan'"),
        ("", {"light_distance": 0.4}, "0.4 objects: the lamps would stand inside .* reaches 0.5 objects"),
        ("", {"light_distance": "400mm"}, "--light-distance: distances in mm need .* give --pixel-size"),
        ("# near, unit m\n", {}, "lights.txt: distances in m need the size of a pixel; give --pixel-size"),
        ("# near, unit pixels\n", {}, "lights.txt: the lamps of 1.png, 2.png, 3.png, 4.png, 5.png stand inside "),
        ("# near, unit objects, object 0 0 0.6\n", {}, "the lamp of 5.png stands inside the object, 0.4 objects from"),
        ("# near, unit objects\n", {"light_distance": 3}, "lights.txt says where each lamp stood; leave --light-dist"),
    ],
)  # fmt: skip
def test_each_lamp_that_cannot_be_has_one_line(folder: Path, heading: str, options: dict, said: str) -> None:
    path = write(folder / "lights.txt", rows(TURNED, heading))
    with pytest.raises(InputError, match=said) as caught:
        photos.load(folder, lights=path, **options)
    assert "\n" not in str(caught.value)


def test_lamps_with_positions_may_be_taken_for_distant(folder: Path) -> None:
    path = write(folder / "lights.txt", rows(3 * TURNED, "# near, unit objects\n"))
    assert not photos.load(folder, lights=path, light_distance="far").light_nearness.any()
