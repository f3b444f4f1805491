"""The corpus of folders: names, layouts, masks, what lies beside photographs, and lights. One row is one folder."""

import json
from pathlib import Path

import numpy as np
import pytest
from folder_corpus import COUNT, LIGHTS, NORMALS, OUTLINE, SHOTS, Build, Row, raw, save_16, shots, single, text, try_row
from raw_files import dng

SHADE = OUTLINE.astype(float)
COLOURS = np.where(OUTLINE[..., None], (NORMALS + 1) / 2, 0)
FILE = {"mask": "file"}
LIT = {"lit": True, "options": {"lights": "folder"}}
NAMES = tuple(f"IMG_{number:04}.png" for number in range(1, COUNT + 1))


def at(place: str, *parts: Build) -> Build:
    """Return what writes parts into a folder of the folder."""

    def build(folder: Path) -> None:
        (folder / place).mkdir(parents=True, exist_ok=True)
        for part in parts:
            part(folder / place)

    return build


def rows_of(form: str, count: int = COUNT, comma: bool = False) -> list[str]:
    """Return lines of lights; `form` has n (number), x, y and z."""
    lines = [form.format(n=k + 1, x=x, y=y, z=z) for k, (x, y, z) in enumerate(LIGHTS[:count])]
    return [line.replace(".", ",") for line in lines] if comma else lines


def cut_out(folder: Path) -> None:
    """Write photographs that are transparent outside the object."""
    from PIL import Image

    for number in range(COUNT):
        rgb = np.rint(255 * np.clip(SHOTS[number], 0, 1))
        picture = np.dstack([rgb, 255 * OUTLINE]).astype(np.uint8)
        Image.fromarray(picture).save(folder / f"{number}.png")


def numpy_file(name: str, values: np.ndarray) -> Build:
    return lambda folder: np.save(folder / name, values)


MESHROOM = json.dumps({"lights": [{"viewId": str(k), "type": "directional", "direction": [x, -y, -z],
                                   "intensity": [1, 1, 1]} for k, (x, y, z) in enumerate(LIGHTS[:COUNT])]})  # fmt: skip
OURS = json.dumps({"frame": "x right, y up, z to the camera", "images": [
    {"file": name, "direction": list(light), "intensity": 1.0} for name, light in zip(NAMES, LIGHTS, strict=False)
]})  # fmt: skip

ROWS = [
    # ---- Names ----
    Row("10 comes after 9", (shots("{}.png", count=10),), files=tuple(f"{k}.png" for k in range(1, 11))),
    Row("blanks and brackets", (shots("my photo ({}) [cat].png"),)),
    Row("umlauts and kanji", (shots("Büste_照片_{}.png"),)),
    Row("a hash, a per cent sign and a quote", (shots("it's #{} 50%.png"),)),
    Row("suffixes in capitals", (shots("P{:07}.PNG"),)),
    Row("two dots", (shots("cat.{}.final.png"),)),
    Row("JPEG under the name of PNG", (shots("{}.png", kind="JPEG"),),
        notes=("are JPEG files in spite of the name, and read as such",)),
    Row("PNG under the name of JPEG", (shots("{}.jpg", kind="PNG"),), notes=("are PNG files in spite of the name",)),
    Row("one JPEG under the name of PNG", (shots(count=5), single("x.png", SHOTS[5], kind="JPEG")),
        error="x.png: is 8-bit JPEG, the other 5"),
    Row("what systems leave", (shots(), raw("Thumbs.db", b"\0" * 99), raw(".DS_Store", b"x"), raw("desktop.ini", b"[]"),
        raw("._IMG_0001.png", b"\0\5\x16\7")), files=NAMES),
    Row("notes, a page and an archive", (shots(), text("readme.txt", "the cat"), text("index.html", "<html>"),
        raw("all.zip", b"PK\3\4"))),
    Row("a film of the session", (shots(), raw("MVI_1.MOV", b"\0\0\0\x14ftypqt  ")), notes=("left out: 1 .mov",)),
    Row("a word that is in all names is the object's", (shots("african mask {}.png"),)),
    Row("normandy is no normal", (shots("normandy_{}.png"),)),
    # ---- Lists ----
    Row("a list in another order", (shots(), text("names.txt", *NAMES[::-1])), files=NAMES[::-1]),
    Row("a list of some", (shots(), text("filenames.txt", *NAMES[:4])), files=NAMES[:4], notes=("not in it: IMG_0005",),
        gamma="linear"),
    Row("a list from Windows, blanks in it", (shots("a b {}.png"), text("names.txt", *(f"C:\\ps\\a b {k}.png"
        for k in range(1, 7))))),
    Row("a list that names a missing picture", (shots(count=5), text("names.txt", *NAMES)),
        error="names IMG_0006.png, which is not there; copy it there or drop the line"),
    Row("a list that names one twice", (shots(), text("names.txt", NAMES[0], *NAMES)),
        error="'IMG_0001.png' is listed twice"),
    Row("an empty list", (shots(), text("names.txt", "")), error="names.txt"),
    # ---- Folders ----
    Row("all in a sub-folder", (at("photos", shots()),), notes=("the pictures are those of its folder photos",)),
    Row("two sub-folders", (at("cat", shots()), at("dog", shots())), error="but in its folders cat, dog; give one"),
    Row("photographs and old results in a sub-folder", (shots(), at("out", single("normal.png", COLOURS), single(
        "depth.png", SHOTS[0]), single("albedo.png", SHOTS[1])))),
    Row("developed pictures in a sub-folder of the RAW files", (at("tiff", shots("{}.tif", write=save_16)),
        lambda f: [(f / f"{k}.dng").write_bytes(dng(np.full((24, 32), 900, np.uint16))) for k in range(3)]),
        gamma="linear", bits=16, exact=1e-4),
    Row("RAW beside JPEG", (shots("IMG_{}.JPG"), lambda f: [(f / f"IMG_{k}.DNG").write_bytes(dng(np.full((24, 32), 900,
        np.uint16))) for k in range(1, 7)]), notes=(
        "left out: 6 .dng (the other pictures are read; --images '*.DNG'",)),
    Row("UniPS", (at("cat.data", shots("L ({}).png"), single("mask.png", SHADE, mode="L")),), **FILE),
    Row("UW class set", (shots("gray.{}.png"), single("gray.mask.png", SHADE, mode="L")), **FILE),
    Row("DiLiGenT", (shots("{:03}.png", write=save_16), text("filenames.txt", *(f"{k:03}.png" for k in range(1, 7))),
        text("light_directions.txt", *rows_of("{x} {y} {z}")), text("light_intensities.txt", *["1 1 1"] * 6),
        single("mask.png", SHADE, mode="L"), single("Normal_gt.png", COLOURS)), gamma="linear", bits=16, mask="file",
        exact=1e-4, **LIT),
    # ---- Masks ----
    Row("a mask", (shots(), single("mask.png", SHADE, mode="L")), notes=("the mask is mask.png",), **FILE),
    Row("a mask of one bit", (shots(), single("mask.png", SHADE, mode="1")), **FILE),
    Row("a mask in JPEG", (shots(), single("mask.jpg", SHADE, mode="L")), **FILE),
    Row("a mask of 16 bits", (shots(), single("cat_mask.png", SHADE, save_16)), **FILE),
    Row("a German mask", (shots(), single("Maske.png", SHADE, mode="L")), **FILE),
    Row("a mask without a name", (shots(), single("bw.png", SHADE)), notes=("left out: bw.png (has two values only",)),
    Row("a mask for each, all alike", (shots(), *(single(f"m_{k}_mask.png", SHADE, mode="L") for k in range(6))),
        **FILE),
    Row("two masks that differ", (shots(), single("a_mask.png", SHADE, mode="L"), single("b_mask.png",
        np.roll(SHADE, 3, 1), mode="L")), error="several masks that differ (a_mask.png, b_mask.png)"),
    Row("a mask of another size", (shots(), single("mask.png", SHADE[:-3], mode="L")),
        error="mask.png: the mask is 40x29 pixels, the pictures are 40x32"),
    Row("an empty mask", (shots(), single("mask.png", 0 * SHADE, mode="L")), error="mask.png: the mask is empty"),
    Row("a mask in the transparency", (shots(), lambda f: cut_out_one(f / "mask.png")), **FILE),
    Row("cut-out photographs", (cut_out,), **FILE),
    Row("a mask elsewhere", (shots(), single("../outline.png", SHADE, mode="L")),
        options={"mask": "{}/../outline.png"}, **FILE),
    Row("a mask that is not there", (shots(),), options={"mask": "{}/outline.png"},
        error="outline.png: no such picture"),
    # ---- Beside the photographs ----
    Row("normals by name", (shots(), single("cat_normal.png", COLOURS)), notes=("cat_normal.png (normals by name)",)),
    Row("normals by their colours", (shots(), single("out.png", COLOURS)), notes=("out.png (has the colours of",)),
    Row("maps of a material", (shots(), single("baseColor.png", SHOTS[0]), single("roughness.png", SHOTS[1]),
        single("metallic.png", SHOTS[2])), notes=("baseColor.png (albedo by name)", "a map of the material by name")),
    Row("what sdps wrote", (shots(), single("normal.png", COLOURS), single("depth.png", SHOTS[0]), text("report.html",
        "<html>"), text("summary.json", "{}")), files=NAMES),
    Row("one of a smaller size among many", (shots(count=9), single("small.png", SHOTS[0][::2, ::2])), files=9,
        notes=("left out: small.png (20x16 pixels); the others are 40x32 pixels",)),
    Row("a preview of another kind among many", (shots(count=9), single("preview.jpg", SHOTS[0])), files=9,
        notes=("left out: preview.jpg (8-bit JPEG)",)),
    Row("some chosen by a pattern", (shots(), shots("b_{}.png", count=3)), options={"names": ["IMG*"]}, files=NAMES),
    Row("some left out by a pattern", (shots(), shots("b_{}.png", count=3)), options={"names": ["!b_*"]}, files=NAMES),
    Row("a pattern that fits none", (shots(),), options={"names": ["DSC*"]}, error="no picture 'DSC*' in it"),
    # ---- Lights ----
    Row("lights in order", (shots(), text("lights.txt", *rows_of("{x} {y} {z}"))), **LIT),
    Row("lights lie there and are not asked for", (shots(), text("lights.txt", *rows_of("{x} {y} {z}")))),
    Row("an .lp with the count", (shots(), text("dome.lp", "6", *rows_of("IMG_{n:04}.png {x} {y} {z}"))), **LIT),
    Row("an .lp without the count", (shots(), text("dome.lp", *rows_of("IMG_{n:04}.png {x} {y} {z}"))), **LIT),
    Row("an .lp from Windows for JPEG", (shots(), text("d.lp", "6", *rows_of("C:\\rti\\IMG_{n:04}.jpg {x} {y} {z}"))),
        **LIT),
    Row("an .lp with more rows than pictures", (shots(), text("d.lp", "8", *rows_of("IMG_{n:04}.png {x} {y} {z}", 8))),
        **LIT),
    Row("an .lp with other names and the same numbers", (shots(), text("d.lp", "6",
        *rows_of("DSC{n}.png {x} {y} {z}"))),
        notes=("its rows were taken by the numbers in the names",), **LIT),
    Row("an .lp of another folder", (shots(), text("d.lp", "6", *rows_of("DSC{n}7.png {x} {y} {z}"))),
        notes=("so its rows were taken in the order of the pictures",), **LIT),
    Row("decimal commas", (shots(), text("lights.csv", *rows_of("{x:.5f};{y:.5f};{z:.5f}", comma=True))), **LIT),
    Row("a table with a heading", (shots(), text("lights.csv", "name,x,y,z", *rows_of("IMG_{n:04}.png,{x},{y},{z}"))),
        **LIT),
    Row("rows for too few pictures", (shots(), text("lights.txt", *rows_of("{x} {y} {z}", 5))), error="5 rows for 6",
        options={"lights": "folder"}),
    Row("lights transposed", (shots(), numpy_file("lights.npy", LIGHTS[:COUNT].T)), **LIT),
    Row("our lights", (shots(), text("lights.json", OURS)), gamma="linear", **LIT),
    Row("Meshroom's lights", (shots("{}.png"), text("lights_mr.json", MESHROOM)),
        notes=("axes are Meshroom's",), **LIT),
    Row("lights that are no numbers", (shots(), text("lights.txt", *["nan 0 1"] * 6)), error="lights.txt",
        options={"lights": "folder"}),
    Row("lights asked for that are not there", (shots(),), error="lights", options={"lights": "folder"}),
    Row("two files of lights", (shots(), text("lights_a.txt", *rows_of("{x} {y} {z}")), text("lights_b.txt",
        *rows_of("{y} {x} {z}"))), error="lights_a.txt", options={"lights": "folder"}),
]  # fmt: skip


def cut_out_one(path: Path) -> None:
    from PIL import Image

    Image.fromarray(np.dstack([np.full((*OUTLINE.shape, 3), 90), 255 * OUTLINE]).astype(np.uint8)).save(path)


@pytest.mark.parametrize("row", ROWS, ids=[row.name for row in ROWS])
def test_folder(row: Row, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    try_row(row, tmp_path, capfd)
