"""Files of lights as tools write them: RTIBuilder, RelightLab, Meshroom, DiLiGenT, HALCON, and lists of positions."""

import json
from pathlib import Path

import numpy as np
import photo_folders as folders
import pytest

from render.shared.errors import InputError
from sdps import photos
from sdps.core.geometry import Capture
from sdps.photos.light_files import find_lights, read_intensities, read_lights

AROUND = np.radians([20.0, 95.0, 165.0, 240.0, 310.0])
UP = np.radians([35.0, 60.0, 45.0, 30.0, 70.0])
LIGHTS = np.stack([np.cos(UP) * np.cos(AROUND), np.cos(UP) * np.sin(AROUND), np.sin(UP)], axis=1)
FILES = tuple(f"DSC_{number:04d}.JPG" for number in range(98, 103))
ORDER = [4, 1, 3, 0, 2]


def read(path: Path, text: str, **options: object):
    path.write_text(text, encoding="utf-8")
    return read_lights(path, FILES, **options)


def says(path: Path, text: str) -> str:
    with pytest.raises(InputError) as caught:
        read(path, text)
    assert "\n" not in str(caught.value) and str(caught.value).startswith(str(path))
    return str(caught.value)


def vectors(rows: np.ndarray) -> list[dict[str, float]]:
    return [dict(zip("xyz", row.tolist(), strict=True)) for row in rows]


# ---- RTIBuilder ----


@pytest.mark.parametrize("count", ["7\n", "7\r\n", ""])
@pytest.mark.parametrize("comma", [False, True])
def test_rti_builder(tmp_path: Path, count: str, comma: bool) -> None:
    """Folders of Windows, rows of pictures that were thrown away, decimal commas, with the count and without."""
    end = "\r\n" if "\r" in count else "\n"
    rows = [f"C:\\RTI\\Tablet 7\\jpeg-exports\\dsc_{98 + k:04d}.jpg " + " ".join(f"{v:.6f}" for v in LIGHTS[k])
            for k in ORDER]  # fmt: skip
    rows[2:2] = ["C:\\RTI\\Tablet 7\\jpeg-exports\\dsc_0090.jpg 0.1 0.2 0.97", "C:\\RTI\\x\\dsc_0091.jpg 0.2 0.1 0.97"]
    if comma:
        rows = [row.rpartition("jpg ")[0] + "jpg " + row.rpartition("jpg ")[2].replace(".", ",") for row in rows]
    found = read(tmp_path / "tablet.lp", count + end.join(rows) + end)
    np.testing.assert_allclose(found.directions, LIGHTS, atol=1e-5)
    assert any("dsc_0090.jpg" in note and "not used" in note for note in found.notes)


def test_names_that_do_not_fit_are_named(tmp_path: Path) -> None:
    rows = "".join(f"DSC_{number}.JPG 0.1 0.1 0.9\n" for number in (98, 99, 100, 1010, 102))
    said = says(tmp_path / "l.lp", "5\n" + rows.replace("DSC_98", "DSC_0098").replace("DSC_100", "DSC_0100"))
    assert "no row for DSC_0099.JPG, DSC_0101.JPG, DSC_0102.JPG (3 of 5 pictures lack one)" in said
    assert "the nearest to DSC_0099.JPG is DSC_99.JPG" in said


# ---- RelightLab ----


def dome(**more: object) -> dict:
    zeros = vectors(np.zeros((5, 3)))
    return {"label": "Dome 60", "notes": "", "imageWidth": 0, "domeDiameter": 0, "verticalOffset": 0,
            "lightConfiguration": "directional", "directions": vectors(LIGHTS), "positionsSphere": zeros,
            "positions3d": [], "ledAdjust": []} | more  # fmt: skip


def test_a_dome_with_its_diameter_and_width_has_near_lamps(tmp_path: Path) -> None:
    path, places = tmp_path / "studio.dome", 300 * LIGHTS + [0, 0, -20]
    far = read(path, json.dumps(dome(domeDiameter=600)))
    assert far.distances is None and far.image_width == 0
    assert "studio.dome does not say the width of its pictures (imageWidth), so its lamps are taken for distant" in (
        far.notes
    )
    sizes = {"domeDiameter": 600, "imageWidth": 120, "verticalOffset": -20}
    for more in ({}, {"positionsSphere": vectors(places)},
                 {"positions3d": vectors(places), "lightConfiguration": "lights3d"},
                 {"positions3d": vectors(places / 120), "lightConfiguration": "lights3d"}):  # fmt: skip
        near = read(path, json.dumps(dome(**sizes, **more)))  # the last: in widths of the picture, and not used
        np.testing.assert_allclose(near.distances, np.linalg.norm(places, axis=1), rtol=1e-5)
        np.testing.assert_allclose(near.directions, places / np.linalg.norm(places, axis=1)[:, None], atol=1e-6)
        assert (near.unit, near.image_width, near.intensities) == ("mm", 120, None)


def test_the_lamps_of_a_dome_are_corrected_by_its_factors(tmp_path: Path) -> None:
    adjust = [{"r": 1.0, "g": 2.0, "b": 1.0 + k} for k in range(5)]
    found = read(tmp_path / "l.dome", json.dumps(dome(ledAdjust=adjust)))
    np.testing.assert_allclose(found.intensities, [[1, 0.5, 1 / (1 + k)] for k in range(5)], rtol=1e-6)
    same = read(tmp_path / "l.dome", json.dumps(dome(ledAdjust=adjust[:1] * 5)))
    assert same.intensities is None  # as it writes them where it has measured none
    assert "find the lights in RelightLab first" in says(tmp_path / "l.dome", json.dumps(dome(directions=[])))
    assert "light '[1, 2]' is not three numbers" in says(tmp_path / "l.dome", json.dumps(dome(directions=[[1, 2]])))


def project(**more: object) -> str:
    """A project: a skipped picture has no light; names stand with the folder that they lay in."""
    images = [{"filename": f"raw/{FILES[k]}", "skip": False, "direction": {"x": 0, "y": 0, "z": 0},
               "position": {"x": 0, "y": 0, "z": 0}} for k in ORDER]  # fmt: skip
    images.insert(1, {"filename": "raw/DSC_0001.JPG", "skip": True})
    return json.dumps({"application": "RelightLab", "version": "2025.02", "width": 200, "height": 100, "images": images,
                       "crop": {"left": 0, "top": 0, "width": 100, "height": 50}, "spheres": []} | more)  # fmt: skip


def test_projects_of_relightlab(tmp_path: Path) -> None:
    path, lamps = tmp_path / "coin.relight", vectors(LIGHTS[ORDER])
    for directions in (lamps, [lamps[0], *vectors(np.array([[0.0, 0.0, 0.5]])), *lamps[1:]]):  # of all, of the used
        found = read(path, project(dome=dome(directions=directions, positionsSphere=[])))
        np.testing.assert_allclose(found.directions, LIGHTS, atol=1e-6)
        assert found.distances is None
        sizes = {"domeDiameter": 500, "positionsSphere": []}
        near = read(path, project(dome=dome(directions=directions, **sizes), scale=0.25))
        np.testing.assert_allclose(near.directions, LIGHTS, atol=1e-6)
        np.testing.assert_allclose(near.distances, 250, rtol=1e-6)
        assert near.image_width == 50.0
    given = json.loads(project(scale=0.25))
    for image, row in zip([one for one in given["images"] if not one["skip"]], lamps, strict=True):
        image["direction"] = row
    found = read(path, json.dumps(given))
    np.testing.assert_allclose(found.directions, LIGHTS, atol=1e-6)
    assert found.image_width == 50.0 and found.distances is None
    assert "no light directions; find the lights in RelightLab first" in says(path, project())


def test_the_size_of_a_pixel_is_that_of_the_dome_s_pictures(tmp_path: Path) -> None:
    images, mask = folders.matte(LIGHTS, size=48)
    folder = folders.write_folder(tmp_path / "coin", images, mask)
    (folder / "rig.dome").write_text(json.dumps(dome(domeDiameter=600, imageWidth=40.0)))
    read = photos.load(folder, lights="folder")
    assert read.pixel_size == 40.0 / mask.shape[1]
    np.testing.assert_allclose(read.light_nearness, Capture.of(read.mask).radius * read.pixel_size / 300, rtol=1e-5)
    half = photos.load(folder, lights="folder", scale=0.5)
    assert half.pixel_size == 80.0 / mask.shape[1]
    np.testing.assert_allclose(half.light_nearness, read.light_nearness, rtol=0.05)
    assert photos.load(folder, lights="folder", pixel_size=0.1).pixel_size == 0.1
    far = photos.load(folder, lights="folder", light_distance="far")
    assert not far.light_nearness.any() and photos.load(folder).pixel_size is None


# ---- Meshroom ----


def meshroom(kind: str, numbers: list[str], **more: object) -> str:
    """Lights as AliceVision writes them: y down, z away, numbers as texts."""
    rows = LIGHTS[ORDER] * [1, -1, -1]
    extra = ["0.02", "-0.01", "0.3", "0.1", "0.05", "0.4"] if more.get("type") == "SH" else []
    lights = [{kind: number, "type": "directional", "intensity": ["0.9", "1", "1.1"],
               "direction": [f"{value:.6f}" for value in row] + extra} | more
              for number, row in zip(numbers, rows, strict=True)]  # fmt: skip
    return json.dumps({"lights": lights})


@pytest.mark.parametrize("more", [{}, {"type": "SH"}])
def test_meshroom(tmp_path: Path, more: dict) -> None:
    path = tmp_path / "lights.json"
    found = read(path, meshroom("lightId", [str(k) for k in ORDER], **more))
    np.testing.assert_allclose(found.directions, LIGHTS, atol=1e-5)
    np.testing.assert_allclose(found.intensities, [[0.9, 1, 1.1]] * 5)
    views = [str(1_000_003 * (k + 3) ** 2) for k in ORDER]
    scene = [{"viewId": view, "path": f"/data/scan/{FILES[k]}"} for view, k in zip(views, ORDER, strict=True)]
    (tmp_path / "cameraInit.sfm").write_text(json.dumps({"version": ["1", "2", "9"], "views": scene}))
    np.testing.assert_allclose(read(path, meshroom("viewId", views, **more)).directions, LIGHTS, atol=1e-5)


def test_views_of_several_poses_are_told_apart(tmp_path: Path) -> None:
    """The poses' pictures have the same names; Meshroom's list of views has their folders."""
    images, mask = folders.matte(LIGHTS, size=32)
    views: list[dict] = []
    lights: list[dict] = []
    for turn, pose in enumerate(("ps_a", "ps_b")):
        folders.write_folder(tmp_path / "rig" / pose, images, mask)
        for number, row in enumerate(np.roll(LIGHTS, turn, axis=0) * [1, -1, -1], start=1):
            view = str(7919 * (number + 10 * turn) ** 3)
            views.append({"viewId": view, "path": f"D:/rig/{pose}/{number}.png"})
            lights.append({"viewId": view, "type": "directional", "direction": row.tolist(), "intensity": [1, 1, 1]})
    (tmp_path / "rig" / "lights.json").write_text(json.dumps({"lights": lights}))
    (tmp_path / "rig" / "cameraInit.sfm").write_text(json.dumps({"views": views}))
    for turn, pose in enumerate(photos.find_poses(tmp_path / "rig")):
        found = photos.load(pose, lights="folder").light_directions
        np.testing.assert_allclose(found, np.roll(LIGHTS, turn, axis=0), atol=1e-5)


# ---- Others ----


def test_diligent(tmp_path: Path) -> None:
    images, mask = folders.matte(LIGHTS, size=32)
    folder = folders.write_folder(tmp_path / "bear", images, mask)
    (folder / "filenames.txt").write_text("".join(f"{k}.png\n" for k in range(1, 6)))
    (folder / "light_directions.txt").write_text("\n".join("   ".join(f"{v:.7e}" for v in row) for row in LIGHTS))
    (folder / "light_intensities.txt").write_text("".join(f"{1 + k}   2.0000000e+00   3.0\n" for k in range(5)))
    read = photos.load(folder, lights="folder")
    np.testing.assert_allclose(read.light_directions, LIGHTS, atol=1e-6)
    np.testing.assert_allclose(read.intensities, [[1 + k, 2, 3] for k in range(5)])


@pytest.mark.parametrize(
    "text",
    ["Slants := [{s}]\nTilts := [{t}]", "* HDevelop\nSlants := [{s}] \n\nTilts := [{t}]\n* the end\n",
     "tilt = [{t}];\nslant = [{s}];", "slants: {s}\ntilts: {t}", "[{s}]\n[{t}]"],
)  # fmt: skip
def test_halcon_s_tuples(tmp_path: Path, text: str) -> None:
    slants, tilts = (", ".join(f"{value:.4f}" for value in np.degrees(angles)) for angles in (np.pi / 2 - UP, AROUND))
    if not text.lower().startswith(("slant", "tilt", "*")):
        text = "slant tilt\n" + text
    np.testing.assert_allclose(read(tmp_path / "l.txt", text.format(s=slants, t=tilts)).directions, LIGHTS, atol=1e-5)


def write_tuple(path: Path, values: np.ndarray, kind: int = 2) -> Path:
    rows = "".join(f"{kind} {value:.16e}\n" if kind == 2 else f"{kind} {round(value)}\n" for value in values)
    path.write_text(f"{len(values):03d}\n{rows}")
    return path


@pytest.mark.parametrize(("slants", "tilts"), [("slants.tup", "tilts.tup"), ("DomeSlant.TUP", "DomeTilt.TUP")])
def test_halcon_s_files_of_tuples(tmp_path: Path, slants: str, tilts: str) -> None:
    """Either file brings the other; whole numbers have another kind."""
    one = write_tuple(tmp_path / slants, np.degrees(np.pi / 2 - UP))
    other = write_tuple(tmp_path / tilts, np.degrees(AROUND), kind=1)
    for path in (one, other):
        found = read_lights(path, FILES)
        np.testing.assert_allclose(found.directions, LIGHTS, atol=1e-6)
        assert any(f"{path.name} was read with " in note for note in found.notes)
    assert find_lights(tmp_path) == one


def test_halcon_s_tuples_of_another_form_say_so(tmp_path: Path) -> None:
    path = write_tuple(tmp_path / "slants.tup", np.degrees(np.pi / 2 - UP))
    whole = path.read_text()
    assert "needs the tilts as well; write_tuple (Tilts, 'tilts.tup') beside it" in says(path, whole)
    write_tuple(tmp_path / "tilts.tup", np.degrees(AROUND)[:4])
    assert "has 5 numbers, tilts.tup another number" in says(path, whole)
    assert "line 3 is not a number as write_tuple writes it" in says(
        path, whole.replace("\n2 ", "\n4 ", 2).replace("\n4 ", "\n2 ", 1)
    )
    assert "whose first line counts the others" in says(path, whole.replace("005", "006"))
    assert "whose first line counts the others" in says(path, "")
    assert "name the two files slants.tup and tilts.tup" in says(tmp_path / "lights.tup", whole)
    bright = write_tuple(tmp_path / "strengths.tup", np.arange(1.0, 6.0))
    np.testing.assert_allclose(read_intensities(bright, FILES), np.arange(1.0, 6.0))


@pytest.mark.parametrize("heading", ["Slant Tilt", "Slants, Tilts", "slant [deg];tilt [deg]", "image,slant,tilt"])
def test_halcon_s_columns(tmp_path: Path, heading: str) -> None:
    cut = next((sign for sign in ";," if sign in heading), " ")
    rows = [[f"{value:.4f}" for value in np.degrees([np.pi / 2 - up, around])]
            for up, around in zip(UP, AROUND, strict=True)]  # fmt: skip
    if "image" in heading:
        rows = [[FILES[k], *rows[k]] for k in ORDER]
    text = "\n".join([heading, *(cut.join(row) for row in rows)])
    np.testing.assert_allclose(read(tmp_path / "l.csv", text).directions, LIGHTS, atol=1e-5)


def test_positions_in_millimetres_by_name(tmp_path: Path) -> None:
    rows = "".join(
        f"{FILES[k]};" + ";".join(f"{v:.2f}".replace(".", ",") for v in 400 * LIGHTS[k]) + "\n" for k in ORDER
    )
    found = read(tmp_path / "rig.csv", "# near, unit mm\nfile;x;y;z\n" + rows)
    np.testing.assert_allclose(found.distances, 400, rtol=1e-4)
    np.testing.assert_allclose(found.directions, LIGHTS, atol=1e-4)
    assert found.unit == "mm"
