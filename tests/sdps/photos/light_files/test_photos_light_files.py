"""Light files as people have them: other programs' layouts, tables written in other ways, names that nearly fit."""

import io
import json
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import photo_folders as folders
import pytest
import scipy.io

from render.shared.errors import InputError
from sdps import photos
from sdps.photos.faults import Faults
from sdps.photos.light_files import find_lights, read_intensities, read_lights

COUNT = 8
FILES = tuple(f"img_{number:02d}.png" for number in range(1, COUNT + 1))
ORDER = [3, 0, 7, 5, 1, 6, 2, 4]
"""An order of rows that is not the pictures'."""


def dome(count: int) -> np.ndarray:  # (count, 3)
    """Return lights all around, at changing heights, as files with five decimals have them."""
    around, up = 2.4 * np.arange(count) + 0.3, np.radians(30 + 8.0 * (np.arange(count) % 6))
    return np.round(np.stack([np.cos(up) * np.cos(around), np.cos(up) * np.sin(around), np.sin(up)], axis=1), 5)


LIGHTS = dome(COUNT)
AZIMUTHS = np.degrees(np.arctan2(LIGHTS[:, 1], LIGHTS[:, 0])).round(4)
ELEVATIONS = np.degrees(np.arcsin(LIGHTS[:, 2])).round(4)
ROWS = [" ".join(map(str, row)) for row in LIGHTS.tolist()]
PLAIN = "\n".join(ROWS)
TURNED = "\n".join(" ".join(map(str, axis)) for axis in LIGHTS.T.tolist())


def comma(text: str) -> str:
    return text.replace(".", ",")


def named(row: str, order: list[int] | range = ORDER) -> str:
    """Return a line for each picture, of a pattern with the number n, the file f and the light's x, y, z."""
    return "\n".join(
        row.format(n=number + 1, f=FILES[number], x=LIGHTS[number, 0], y=LIGHTS[number, 1], z=LIGHTS[number, 2],
                   a=AZIMUTHS[number], e=ELEVATIONS[number], s=90 - ELEVATIONS[number],
                   X=round(2000 * LIGHTS[number, 0]), Y=round(2000 * LIGHTS[number, 1]),
                   Z=round(2000 * LIGHTS[number, 2]))
        for number in order
    )  # fmt: skip


ALL = range(COUNT)
TEXTS = {
    "mark and line ends of Windows": "\ufeff" + PLAIN.replace("\n", "\r\n"),
    "comments of MATLAB": "% lights\n\n" + PLAIN.replace("\n", " % and so on\n"),
    "comments of C": "// lights\n" + PLAIN.replace("\n", " // and so on\n"),
    "minus signs of a word processor": PLAIN.replace("-", "\N{MINUS SIGN}"),
    "decimal commas, semicolons": comma(PLAIN.replace(" ", "; ")),
    "decimal commas, blanks": comma(PLAIN),
    "decimal commas, tabs": comma(PLAIN.replace(" ", "\t")),
    "decimal commas, commas with blanks": comma(PLAIN).replace(" ", ", "),
    "decimal commas and a count": f"{COUNT}\n{comma(PLAIN)}",
    "decimal commas and names": "\n".join(f"{FILES[k]};{comma(ROWS[k].replace(' ', ';'))}" for k in ORDER),
    "a spreadsheet's CSV": '"file";"x";"y";"z"\n' + "\n".join(
        f'"{FILES[k]}";' + ";".join(f'"{comma(value)}"' for value in ROWS[k].split()) for k in ORDER),
    "transposed": TURNED,
    "transposed, commas": TURNED.replace(" ", ","),
    "transposed, decimal commas": comma(TURNED),
    "transposed, labelled": "\n".join(f"L{axis}: {row}" for axis, row in zip("xyz", TURNED.split("\n"), strict=True)),
    "MATLAB in a line": f"L = [{PLAIN}];".replace("\n", "; "),
    "MATLAB in lines": f"L = [\n{PLAIN}\n];".replace("\n", ";\n").replace("[;", "[ "),
    "MATLAB transposed": f"S = [{TURNED}]".replace("\n", ";\n"),
    "NumPy printed": str(LIGHTS),
    "NumPy repeated": repr(LIGHTS.astype(np.float32)),
    "a list of Python": str(LIGHTS.tolist()).replace("], ", "],\n"),
    "a dictionary of Python": "{" + named("'{f}': [{x}, {y}, {z}],") + "}",
    "a list of YAML": "directions:\n" + named("  - [{x}, {y}, {z}]", ALL),
    "millimetres by name": named("pic{n}: ({X},{Y},{Z})"),
    "stems and an equals sign": named("img_{n:02d} = ({x}, {y}, {z})"),
    "names with blanks": named("Light {n}: {x} {y} {z}"),
    "names that end in a number": named("pic {n} {x} {y} {z}"),
    "names at the end": named("{x} {y} {z} {f}"),
    "numbers": named("{n} {x} {y} {z}"),
    "numbers with zeros": named("{n:03d},{x},{y},{z}"),
    "numbers, millimetres": named("{n} {X} {Y} {Z}"),
    "numbers from 0": "\n".join(f"{k} {ROWS[k]}" for k in ORDER),
    "Windows' folders": "8\n" + named("C:\\Users\\a b\\jpeg-exports\\IMG_{n:02d}.JPG {x} {y} {z}"),
    "folders": "8\n" + named("/home/rti #2/img_{n:02d}.tif {x} {y} {z}"),
    "a wrong count": "9\n" + named("{f} {x} {y} {z}"),
    "more rows than pictures": named("{f} {x} {y} {z}") + "\nimg_09.png 0 0 1\nimg_10.png 0 0 1",
    "numbers, lengths that vary": "\n".join(
        f"{k + 1} {' '.join(str(round(value * (900 + 90 * k))) for value in LIGHTS[k])}" for k in ORDER),
    "other names": named("DSC{n}.tif {x} {y} {z}", ALL).replace("DSC", "DSC10"),
    "an index of pandas": ",x,y,z\n" + "\n".join(f"{k},{ROWS[k].replace(' ', ',')}" for k in ALL),
    "an index by name": "i x y z\n" + named("{n} {x} {y} {z}"),
    "columns in another order": "z,exposure,file,lx,ly\n" + named("{z},0.5,{f},{x},{y}"),
    "a caption": "Light directions x y z\n" + PLAIN,
    "azimuth and elevation": "azimuth elevation\n" + named("{a} {e}", ALL),
    "azimuth and elevation in a comment": "# azimuth and elevation in degrees\n" + named("{a} {e}", ALL),
    "elevation first": "file;Elevation [°];Azimuth [°]\n" + comma(named("img_{n:02d};{e};{a}")),
    "numbered angles": "azimuth, elevation\n" + named("{n}, {a}, {e}"),
    "slant and tilt": "slant\ttilt\n" + named("{s}\t{a}", ALL),
    "HALCON's vectors": f"Slants := {(90 - ELEVATIONS).tolist()}\nTilts := {AZIMUTHS.tolist()}",
    "radians": "azimuth_rad,elevation_rad\n" + "\n".join(f"{a},{e}" for a, e in np.radians([AZIMUTHS, ELEVATIONS]).T),
}  # fmt: skip


@pytest.mark.parametrize("name", TEXTS)
def test_text_in_the_ways_people_write_it(tmp_path: Path, name: str) -> None:
    path = tmp_path / "lights.txt"
    path.write_bytes(TEXTS[name].encode())
    read = read_lights(path, FILES)
    np.testing.assert_allclose(read.directions, LIGHTS, atol=1e-3)
    assert read.intensities is None


def test_names_are_counted_where_no_number_fits(tmp_path: Path) -> None:
    (tmp_path / "l.txt").write_text(named("pic{n}: ({X},{Y},{Z})"))
    read = read_lights(tmp_path / "l.txt", [f"DSC_{4510 + number}.jpg" for number in range(COUNT)])
    np.testing.assert_allclose(read.directions, LIGHTS, atol=1e-3)
    assert any("in the order of the pictures, DSC_4510.jpg" in note for note in read.notes)


@pytest.mark.parametrize("coding", ["utf-16", "cp1252", "utf-8"])
def test_text_in_the_codings_of_windows(tmp_path: Path, coding: str) -> None:
    path = tmp_path / "lights.lp"
    path.write_bytes(f"8\r\n{named('D:/Jörg/Röhre_{n}.jpg {x} {y} {z}')}".encode(coding))
    files = [f"Ro\u0308hre_{number}.png" for number in range(1, COUNT + 1)]  # as macOS spells it
    np.testing.assert_allclose(read_lights(path, files).directions, LIGHTS, atol=1e-4)


@pytest.mark.parametrize(
    ("text", "strengths"),
    [
        (named("{n} {x} {y} {z} 1.5"), (COUNT,)),
        (named("{n} {x} {y} {z} 1.5 1 2"), (COUNT, 3)),
        ("\n".join(f"{row} {k + 1}" for k, row in enumerate(ROWS)), (COUNT,)),
        (comma("\n".join(f"{row} 1.5" for row in ROWS)), (COUNT,)),
        (TURNED + "\n" + " ".join("12345678"), (COUNT,)),
        ("azimuth elevation intensity\n" + named("{a} {e} 1.5", ALL), (COUNT,)),
        ("file,x,y,z,r,g,b\n" + named("{f},{x},{y},{z},1,2,3"), (COUNT, 3)),
    ],
)
def test_intensities_are_told_from_numbers(tmp_path: Path, text: str, strengths: tuple[int, ...]) -> None:
    path = tmp_path / "lights.txt"
    path.write_text(text)
    read = read_lights(path, FILES)
    np.testing.assert_allclose(read.directions, LIGHTS, atol=1e-4)
    assert read.intensities is not None and read.intensities.shape == strengths


def test_what_was_decided_is_said(tmp_path: Path) -> None:
    def notes(text: str) -> str:
        (tmp_path / "l.txt").write_text(text)
        return "; ".join(read_lights(tmp_path / "l.txt", FILES).notes)

    assert "3 rows of 8 numbers were taken as 8 lights" in notes(TURNED)
    assert "in their order, img_01.png, img_02.png, img_03.png to img_08.png" in notes(PLAIN)
    assert "the first column was taken as the pictures' numbers" in notes(TEXTS["numbers"])
    assert "not used: img_09.png, img_10.png" in notes(TEXTS["more rows than pictures"])
    assert "none of its names (DSC101.tif" in notes(TEXTS["other names"])
    assert "says 9 lights, but 8 rows follow" in notes(TEXTS["a wrong count"])
    assert "columns that were not used: exposure" in notes(TEXTS["columns in another order"])
    assert "azimuth and elevation in degrees" in notes(TEXTS["numbered angles"])
    assert "lengths from 2000 to 200" in notes(TEXTS["millimetres by name"])


def packed(save: Callable[..., Any], *values: Any, **arrays: Any) -> bytes:
    buffer = io.BytesIO()
    save(buffer, *values, **arrays)
    return buffer.getvalue()


def matlab(packing: bool = False, form: str = "5", **arrays: Any) -> bytes:
    return packed(scipy.io.savemat, arrays, do_compression=packing, format=form)


PICTURES = np.zeros((5, 4, COUNT))
ARRAYS = {
    "l.npy": packed(np.save, LIGHTS),
    "transposed.npy": packed(np.save, LIGHTS.T.astype(">f4")),
    "columns.npy": packed(np.save, np.asfortranarray(LIGHTS)[:, None]),
    "l.npz": packed(np.savez_compressed, anything=LIGHTS),
    "named.npz": packed(np.savez, light_dirs=LIGHTS.T, images=PICTURES, centres=np.ones((COUNT, 3))),
    "l.mat": matlab(L=LIGHTS, I=PICTURES, mask=np.ones((5, 4), bool), about={"a": "b"}),
    "transposed.mat": matlab(True, S=LIGHTS.T),
    "old.mat": matlab(form="4", anything=LIGHTS),
    "without-suffix": packed(np.save, LIGHTS),
}


@pytest.mark.parametrize("name", ARRAYS)
def test_arrays(tmp_path: Path, name: str) -> None:
    (tmp_path / name).write_bytes(ARRAYS[name])
    read = read_lights(tmp_path / name, FILES)
    np.testing.assert_allclose(read.directions, LIGHTS, atol=1e-5)
    assert read.intensities is None


def test_intensities_of_arrays(tmp_path: Path) -> None:
    strengths = np.arange(1.0, 25.0).reshape(COUNT, 3)
    (tmp_path / "a.npy").write_bytes(packed(np.save, np.hstack([LIGHTS, strengths]).T))
    (tmp_path / "a.mat").write_bytes(matlab(L=LIGHTS, light_intensities=strengths))
    (tmp_path / "a.npz").write_bytes(packed(np.savez, L=LIGHTS, intensities=strengths.T))
    (tmp_path / "alone.npy").write_bytes(packed(np.save, strengths))
    for name in ("a.npy", "a.mat", "a.npz"):
        np.testing.assert_allclose(read_lights(tmp_path / name, FILES).intensities, strengths)
    for name in ("alone.npy", "a.npz"):
        np.testing.assert_allclose(read_intensities(tmp_path / name, FILES), strengths)
    (tmp_path / "row.txt").write_text("1 2 3 4 5 6 7 8")
    (tmp_path / "numbered.txt").write_text("\n".join(f"{k + 1} {k + 1},5" for k in ORDER))
    np.testing.assert_allclose(read_intensities(tmp_path / "row.txt", FILES), np.arange(1, 9))
    np.testing.assert_allclose(read_intensities(tmp_path / "numbered.txt", FILES), np.arange(1, 9) + 0.5)


def refusal(path: Path, content: bytes | str, files: tuple[str, ...] = FILES, frame: str = "y-up") -> str:
    """Return the one line a light file is refused with."""
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    with pytest.raises(InputError) as error:
        read_lights(path, files, frame)
    return str(error.value)


def test_arrays_that_are_refused(tmp_path: Path) -> None:
    pickled = packed(np.save, np.array([{"a": 1}], object), allow_pickle=True)
    assert "holds no numbers" in refusal(tmp_path / "l.npy", pickled)
    assert "5 rows for 8 pictures" in refusal(tmp_path / "l.npy", packed(np.save, LIGHTS[:5]))
    huge = b"\x93NUMPY\x01\x00v\x00" + b"{'descr': '<f8', 'fortran_order': False, 'shape': (8, 3), }".ljust(118)
    assert "damaged or not a NumPy file (it ends too early)" in refusal(tmp_path / "l.npy", huge)
    assert "several arrays may be lights (a, b)" in refusal(tmp_path / "l.npz", packed(np.savez, a=LIGHTS, b=LIGHTS))
    assert "holds about (struct)" in refusal(tmp_path / "l.mat", matlab(about={"L": LIGHTS}))
    assert "damaged or not a MATLAB file" in refusal(tmp_path / "l.mat", ARRAYS["l.mat"][:300])
    later = b"MATLAB 7.3 MAT-file".ljust(512) + b"\x89HDF\r\n\x1a\n"
    assert "version 7.3 and which is not read; save it in MATLAB with save('l.mat'" in refusal(
        tmp_path / "l.mat", later
    )
    sheet = io.BytesIO()
    with zipfile.ZipFile(sheet, "w") as archive:
        archive.writestr("xl/workbook.xml", "")
    assert "is a spreadsheet; save the sheet as CSV" in refusal(tmp_path / "l.xlsx", sheet.getvalue())


def meshroom(keys: list[Any], key: str = "viewId", **more: Any) -> str:
    rows = (LIGHTS * [1, -1, -1]).tolist()  # x right, y down, z away
    lights = [{key: name, "type": "directional", "direction": [*map(str, row)], "intensity": ["1", "1", "1"]} | more
              for name, row in zip(keys, rows, strict=True)]  # fmt: skip
    return json.dumps({"lights": lights})


def vector(row: np.ndarray) -> dict[str, float]:
    return dict(zip("xyz", row.tolist(), strict=True))


JSON = {
    "ids from 0": meshroom([str(number) for number in range(COUNT)]),
    "ids from 1": meshroom([str(number) for number in range(1, COUNT + 1)], "lightId"),
    "names": meshroom([file[:-4] for file in FILES]),
    "no ids": meshroom([""] * COUNT),
    "the older layout": json.dumps({"lights": {
        FILES[k][:-4]: {"direction": (LIGHTS[k] * [1, -1, -1]).tolist(), "intensity": [1, 1, 1]} for k in ORDER}}),
    "RelightLab's project": json.dumps({"images": [
        {"filename": f"{FILES[k][:-4]}.jpg", "skip": False, "direction": vector(LIGHTS[k])} for k in ORDER]}),
    "RelightLab's dome in a project": json.dumps({
        "images": [{"filename": file, "direction": vector(np.zeros(3))} for file in FILES],
        "dome": {"directions": [vector(row) for row in LIGHTS]}}),
    "a dome": json.dumps({"domeDiameter": 500, "positions3d": [vector(250 * row) for row in LIGHTS]}),
    "rows": json.dumps(LIGHTS.tolist()),
    "names and rows": json.dumps({FILES[k]: LIGHTS[k].tolist() for k in ORDER}),
}  # fmt: skip


@pytest.mark.parametrize("name", JSON)
def test_json(tmp_path: Path, name: str) -> None:
    (tmp_path / "l.json").write_text(JSON[name])
    read = read_lights(tmp_path / "l.json", FILES)
    np.testing.assert_allclose(read.directions, LIGHTS, atol=1e-5)
    assert read.intensities is None


def test_meshroom(tmp_path: Path) -> None:
    path = tmp_path / "lights.json"
    numbers = list(range(COUNT))
    path.write_text(meshroom(numbers, intensity=[1, 2, 3]))
    assert read_lights(path, FILES).intensities.tolist() == [[1, 2, 3]] * COUNT
    path.write_text(meshroom(numbers, type="SH", direction=[0.0, -0.6, -0.8, *[0.1] * 6]))
    np.testing.assert_allclose(read_lights(path, FILES).directions, [[0, 0.6, 0.8]] * COUNT, atol=1e-6)
    path.write_text(meshroom(numbers, direction=[0.0, 0.6, -0.8]))
    np.testing.assert_allclose(read_lights(path, FILES, "y-down").directions, [[0, 0.6, 0.8]] * COUNT, atol=1e-6)
    near = json.dumps({"lights": [{"viewId": 1, "position": [0, 0, 1]}]})
    assert "1 of its lights are near ones" in refusal(path, near)


def test_meshroom_s_own_numbers_need_its_list_of_views(tmp_path: Path) -> None:
    """It writes views by hash, so in no order of the pictures."""
    hashes = sorted(int(k * 7919 + 13) ** 3 for k in range(COUNT))
    path = tmp_path / "lights.json"
    assert "put its cameraInit.sfm, which names them, next to the file" in refusal(path, meshroom(hashes))
    faults = Faults(anyway=True)
    np.testing.assert_allclose(read_lights(path, FILES, faults=faults).directions, LIGHTS, atol=1e-5)
    assert len(faults.overridden) == 1
    views = [{"viewId": str(view), "path": f"/data/{FILES[k]}"} for view, k in zip(hashes, ORDER, strict=True)]
    (tmp_path / "cameraInit.sfm").write_text(json.dumps({"views": views}))
    np.testing.assert_allclose(read_lights(path, FILES).directions[ORDER], LIGHTS, atol=1e-5)


@pytest.mark.parametrize("count", [3, 4, 6])
def test_rows_and_columns_of_square_tables(tmp_path: Path, count: int) -> None:
    lights, files = dome(count), [f"{number}.png" for number in range(count)]
    for table in (lights, lights.T, np.hstack([lights, np.ones((count, 3))])[:, : max(count, 4)]):
        np.savetxt(tmp_path / "l.txt", table)
        np.testing.assert_allclose(read_lights(tmp_path / "l.txt", files).directions, lights, atol=1e-4)


def test_a_square_table_that_may_be_either_is_refused(tmp_path: Path) -> None:
    third = np.array([[2, -2, 1], [1, 2, 2], [2, 1, 2]]) / 3  # rows and columns are unit and in front
    np.savetxt(tmp_path / "l.txt", third)
    said = refusal(tmp_path / "l.txt", (tmp_path / "l.txt").read_bytes(), ("a.png", "b.png", "c.png"))
    assert "both rows and columns may be lights; write the pictures' names before the rows" in said


def test_numbers_that_may_be_x_are_refused(tmp_path: Path) -> None:
    rows = "\n".join(f"{k} {3 * k} {300 + 70 * k} {400 - 30 * k}" for k in range(1, COUNT + 1))
    assert "may be 'number x y z' or 'x y z i'" in refusal(tmp_path / "l.txt", rows)
    (tmp_path / "l.txt").write_text(f"x y z i\n{rows}")
    assert read_lights(tmp_path / "l.txt", FILES).intensities is not None
    (tmp_path / "l.txt").write_text(f"number x y z\n{rows}")
    assert read_lights(tmp_path / "l.txt", FILES).intensities is None
    rail = "\n".join(f"{k} 10 50 1" for k in range(1, COUNT + 1))  # a lamp on a rail, and its intensity
    (tmp_path / "l.txt").write_text(rail)
    np.testing.assert_allclose(read_lights(tmp_path / "l.txt", FILES).intensities, 1)


@pytest.mark.parametrize(
    ("text", "line"),
    [
        ("# a\n\n8\n" + comma(PLAIN).replace(comma(ROWS[3]), "0,1 x 0,2"), 7),
        (comma(PLAIN.replace(" ", "; ")).replace(";", ";x", 1), 1),
        ("\r\n\r\n" + PLAIN.replace("\n", "\r\n").replace(ROWS[5], "0.1 0.2"), 8),
        ("0.1 0.2\n" + PLAIN.split("\n", 1)[1], 1),
        ("file,x,y,z\n\n" + named("{f},{x},{y},{z}").replace("img_02.png", "img_02.png,nan"), 7),
        (PLAIN.replace(" ", " \x0c", 1).replace(ROWS[7], "a b c"), 8),
    ],
)
def test_the_line_that_is_wrong_is_blamed(tmp_path: Path, text: str, line: int) -> None:
    assert f"line {line} is not x y z" in refusal(tmp_path / "l.txt", text)


def test_angles_that_cannot_be_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "l.txt"
    assert "does not say which angle is which" in refusal(path, "theta phi\n" + named("{a} {e}", ALL))
    assert "write 'azimuth elevation' or 'slant tilt' as first line" in refusal(path, named("{a} {e}", ALL))
    assert "look like radians" in refusal(path, "azimuth elevation\n" + "1.5 0.4\n" * COUNT)
    assert "go beyond 360 around or 90 up" in refusal(path, "azimuth elevation\n" + "30 120\n" * COUNT)


def test_all_that_are_wrong_are_named(tmp_path: Path) -> None:
    path, files = tmp_path / "l.txt", tuple(f"p{number}.png" for number in range(1, 41))
    lights = dome(40)

    def said(table: np.ndarray, frame: str = "y-up") -> str:
        buffer = io.BytesIO()
        np.savetxt(buffer, table)
        return refusal(path, buffer.getvalue(), files, frame)

    some = lights * np.where(np.arange(40) < 15, -1, 1)[:, None] ** np.array([0, 0, 1])
    assert f"15 of 40 lights have z <= 0, behind the object ({', '.join(files[:15])});" in said(some)
    assert "p20.png and 20 more); so z points the other way in this file: use --frame z-away" in said(
        lights * [1, 1, -1]
    )
    assert "use --frame y-down,z-away" in said(lights * [1, -1, -1], "y-down")
    assert "use --frame y-down" in said(lights, "y-down,z-away")
    assert "if y points to the camera in this file, exchange y and z" in said(lights[:, [0, 2, 1]])
    assert "the lights of p1.png, p2.png are 0 0 0" in said(lights * (np.arange(40) > 1)[:, None])
    dark = np.hstack([lights, (np.arange(40) > 1)[:, None]])
    assert "the intensities of p1.png, p2.png are not positive" in said(dark)
    rows = "".join("{} {} {} {}\n".format(file, *row) for file, row in zip(files[12:], lights[12:], strict=True))
    assert "no row for p1.png, p2.png, " in refusal(path, rows, files)
    assert "p10.png and 2 more (12 of 40 pictures lack one)" in refusal(path, rows, files)
    twice = rows + "p13.png 0 0 1\np14.png 0 0 1\n"
    assert "p13.png, p14.png are there twice" in refusal(path, twice, files)


def test_rows_that_fit_two_pictures_or_none(tmp_path: Path) -> None:
    path = tmp_path / "l.txt"
    rows = "left\\a.png 0 0 1\nright\\a.png 0 0.6 0.8\nb.png 0 0 1\n"
    assert "left\\a.png, right\\a.png all fit a.png" in refusal(path, rows, ("a.png", "b.png"))
    assert "the row of a fits a.png, a.jpg" in refusal(path, "a 0 0 1\nb 0 0 1", ("a.png", "a.jpg", "b.png"))
    shuffled = "zebra 0 0 1\nape 0 0 1\nlion 0 0 1"
    assert "no row for 1.png, 2.png, 3.png" in refusal(path, shuffled, ("1.png", "2.png", "3.png"))


def test_the_light_file_of_a_folder_is_found(tmp_path: Path) -> None:
    images = np.linspace(0.2, 1, 3)[:, None, None, None] * np.ones((3, 8, 9, 3))
    folders.write_folder(tmp_path, images, np.ones((8, 9)))
    (tmp_path / "light_intensities.txt").write_text("1\n2\n3\n")
    (tmp_path / "lights_intensities.csv").write_text("1\n2\n3\n")
    assert find_lights(tmp_path) is None and find_lights(tmp_path / "none") is None
    (tmp_path / "assembly.lp").write_text("3\n" + "".join(f"C:\\x\\{n}.jpg 0 0 1\n" for n in range(1, 4)))
    assert find_lights(tmp_path) == tmp_path / "assembly.lp"
    np.testing.assert_allclose(photos.load(tmp_path, lights="folder").light_directions, [[0, 0, 1]] * 3)
    (tmp_path / "lightsource.txt").write_text("0 0 1\n" * 3)
    with pytest.raises(InputError, match=r"several files of lights \(assembly.lp, lightsource.txt\)"):
        find_lights(tmp_path)
    np.savetxt(tmp_path / "light_directions.txt", [[0, 0, 1]] * 3)
    assert find_lights(tmp_path) == tmp_path / "light_directions.txt"
