"""The corpus of folders: what is missing, damaged, too large, black or lit by the room. One row is one folder."""

import struct
import zlib
from pathlib import Path

import numpy as np
import pytest
from folder_corpus import (
    COUNT,
    OUTLINE,
    ROOM,
    SHOTS,
    Build,
    Row,
    codes,
    raw,
    save,
    save_16,
    shots,
    single,
    text,
    try_row,
)
from PIL import Image

SHADE = OUTLINE.astype(float)
FIVE = shots(count=5)
LINEAR = {"gamma": "linear", "bits": 16}
FINE = {**LINEAR, "exact": 1e-4}


def lit_room(name: str = "{}.png", room: np.ndarray = ROOM, write: object = save_16, **how: object) -> Build:
    """Return what writes photographs in the room's light."""
    return lambda folder: [write(folder / name.format(k), SHOTS[k] + room, **how) for k in range(COUNT)]


def exposed(*pictures: tuple[str, np.ndarray, float]) -> Build:
    """Return what writes 8-bit pictures with their exposure times."""

    def build(folder: Path) -> None:
        for name, image, seconds in pictures:
            picture = Image.fromarray(codes(image))
            exif = picture.getexif()
            exif[274] = 1
            exif.get_ifd(0x8769).update({33434: seconds, 33437: 4.0, 34855: 100})
            picture.save(folder / name, exif=exif)

    return build


def cut(name: str, share: float) -> Build:
    """Return what cuts a file short."""

    def build(folder: Path) -> None:
        data = (folder / name).read_bytes()
        (folder / name).write_bytes(data[: int(share * len(data))])

    return build


def huge_png(width: int, height: int) -> bytes:
    """Return a PNG whose header announces more pixels than it has."""
    parts = [(b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)), (b"IDAT", zlib.compress(bytes(99)))]
    chunks = (struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
              for kind, data in (*parts, (b"IEND", b"")))  # fmt: skip
    return b"\x89PNG\r\n\x1a\n" + b"".join(chunks)


def huge_tiff(side: int) -> bytes:
    """Return a TIFF whose header announces more pixels than it has."""
    tags = ((256, side), (257, side), (258, 8), (259, 1), (262, 1), (273, 8), (277, 1), (278, side), (279, side * side))
    rows = b"".join(struct.pack("<HHII", tag, 4, 1, value) for tag, value in tags)
    return struct.pack("<2sHIH", b"II", 42, 8, len(tags)) + rows + bytes(4)


def constant(value: float, count: int = COUNT) -> Build:
    return lambda folder: [save(folder / f"{k}.png", np.full(SHOTS[0].shape, value)) for k in range(count)]


def small(height: int, width: int) -> Build:
    return lambda folder: [save(folder / f"{k}.png", SHOTS[k][8 : 8 + height, 12 : 12 + width]) for k in range(COUNT)]


ROWS = [
    # ---- Missing ----
    Row("an empty folder", (), error="no pictures in it; put PNG"),
    Row("one picture", (shots(count=1),),
        error="only one picture, IMG_0001.png; photometric stereo compares at least 3"),
    Row("one picture and a mask", (shots(count=1), single("mask.png", SHADE, mode="L")), error="only one picture"),
    Row("two pictures", (shots(count=2),), files=2),
    Row("nothing but a mask and normals", (single("mask.png", SHADE), single("normal.png", SHOTS[0])),
        error="no pictures in it"),
    Row("a film and nothing else", (raw("MVI_0001.MP4", b"\0\0\0\x18ftypmp42" + bytes(99)),),
        error="MVI_0001.MP4"),
    Row("GIF files", (shots("{}.gif"),), error="6 .gif, which are not read"),
    Row("text files", (text("notes.txt", "a"), text("more.txt", "b")), error="2 .txt, which are not read"),
    Row("empty sub-folders", (lambda f: (f / "photos").mkdir(),), error="no pictures in it"),
    # ---- Damaged ----
    Row("an empty file", (FIVE, raw("z.png", b"")), error="z.png: damaged, the file is empty"),
    Row("a JPEG cut short", (shots("{}.jpg"), cut("3.jpg", 0.6)), error="3.jpg: damaged or not a JPEG"),
    Row("a PNG cut short", (shots("{}.png"), cut("3.png", 0.6)), error="3.png: damaged or not a PNG"),
    Row("a TIFF cut short", (shots("{}.tif", write=save_16), cut("3.tif", 0.6)),
        error="3.tif: damaged or truncated TIFF"),
    Row("a text under the name of a picture", (FIVE, text("z.png", "no picture")), error="z.png: damaged or not a PNG"),
    Row("a web page that was saved as a picture", (FIVE, raw("z.jpg", b"<!DOCTYPE html><html>")),
        error="z.jpg: is a web page"),
    Row("pictures that Git LFS keeps", tuple(raw(f"{k}.png", b"version https://git-lfs.github.com/spec/v1\n")
        for k in range(4)), error="0.png: is a placeholder of Git LFS"),
    Row("RAW cut short", (raw("a.NEF", b"MM\0*\0\0\0\x08" + bytes(99)), raw("b.NEF", b"MM\0*" + bytes(99))),
        error="a.NEF"),
    Row("RAW of a kind that is not read", (FIVE, raw("z.tif", b"IIII" + bytes(99))),
        error="z.tif: is camera RAW of a kind"),
    Row("HEIC cut short", tuple(raw(f"{k}.heic", b"\0\0\0\x18ftypheic" + bytes(60)) for k in range(3)),
        error="0.heic: damaged or not a HEIC"),
    # ---- Size ----
    Row("a PNG that announces ten gigapixels", (FIVE, raw("z.png", huge_png(100000, 100000))), error="z.png: "),
    Row("a TIFF that announces four gigapixels", (FIVE, raw("z.tif", huge_tiff(60000))), error="z.tif: "),
    Row("a PGM that announces 90,000 lines", (FIVE, raw("z.pgm", b"P5 90000 90000 255\n12")), error="z.pgm: "),
    Row("tiny pictures", (small(5, 7),), shape=(5, 7)),
    Row("single pixels", (small(1, 1),), shape=(1, 1)),
    Row("a single line", (small(1, 24),), shape=(1, 24)),
    Row("one of five is smaller", (shots(count=4), single("z.png", SHOTS[5][:-4])),
        error="z.png: is 40x28 pixels, the other 4 (as IMG_0001.png) are 40x32"),
    Row("two of nine are smaller", (shots(count=7), single("y.png", SHOTS[5][:-4]), single("z.png", SHOTS[6][:-4])),
        error="2 differ: y.png, z.png"),
    Row("each has its own size", tuple(single(f"{k}.png", SHOTS[k][: 32 - k]) for k in range(4)),
        error="must have one size"),
    Row("reduced as they are read", (shots(write=save_16),), options={"scale": 0.5}, shape=(16, 20),
        gamma="linear", bits=16),
    # ---- Light ----
    Row("the same picture six times", (lambda f: [save(f / f"{k}.png", SHOTS[0]) for k in range(6)],),
        error="nothing changes between the pictures"),
    Row("black pictures", (constant(0.0),), error="nothing changes between the pictures"),
    Row("white pictures", (constant(1.0),), error="nothing changes between the pictures"),
    Row("black pictures with a mask", (constant(0.0), single("mask.png", SHADE, mode="L")), mask="file"),
    # ---- The room's light and dark frames ----
    Row("an ambient picture", (lit_room(), single("ambient.png", ROOM, save_16)),
        notes=("ambient.png was subtracted, as an ambient picture",), **FINE),
    Row("the lights are off", (lit_room("{}.tif"), single("IMG_lights_off.tif", ROOM, save_16)),
        notes=("IMG_lights_off.tif was subtracted",), **FINE),
    Row("an ambient picture that is named", (lit_room(), single("z.png", ROOM, save_16)),
        options={"ambient": "{}/z.png"},
        notes=("z.png was subtracted",), **FINE),
    Row("an ambient picture that is not wanted", (shots(write=save_16), single("ambient.png", ROOM, save_16)),
        options={"ambient": "none"}, quiet="subtracted", **FINE),
    Row("two ambient pictures", (lit_room(), single("ambient1.png", 0.9 * ROOM, save_16),
        single("ambient2.png", 1.1 * ROOM,
        save_16)), notes=("ambient1.png, ambient2.png were subtracted",), **FINE),
    Row("an ambient picture in JPEG", (shots("{}.jpg"), single("ambient.jpg", 0.01 * ROOM)), notes=("was subtracted",)),
    Row("an ambient picture of another size", (shots(), single("ambient.png", ROOM[:-2])),
        notes=("left out: ambient.png (an ambient picture by name, but it is 40x30 pixels",)),
    Row("an ambient picture of another size that is named", (shots(), single("z.png", ROOM[:-2])),
        options={"ambient": "{}/z.png"}, error="z.png: is 40x30 pixels, the photographs are 40x32"),
    Row("an ambient picture of another kind", (shots(), single("ambient.jpg", ROOM)),
        notes=("it is 8-bit JPEG, the photographs are 8-bit PNG",)),
    Row("an ambient picture as bright as the others", (shots(), single("ambient.png", SHOTS[7])),
        notes=("it is as bright as the photographs",)),
    Row("an ambient picture that is not there", (shots(),), options={"ambient": "{}/z.png"},
        error="z.png: no such picture"),
    Row("a longer exposure of the room", (exposed(*((f"{k}.png", SHOTS[k] + ROOM / 4, 0.05) for k in range(COUNT)),
        ("ambient.png", ROOM, 0.2)),), options={"gamma": "linear"}, gamma="linear", exact=4e-3, notes=("times 0.25",)),
    Row("a dark frame", (lit_room(room=ROOM * 0 + 0.01), single("dark_frame.png", ROOM * 0 + 0.01, save_16)),
        notes=("dark_frame.png was subtracted, as a dark frame",), **FINE),
    Row("a dark frame and an ambient picture", (lit_room(room=ROOM + 0.01),
        single("dark.png", ROOM * 0 + 0.01, save_16),
        single("ambient.png", ROOM + 0.01, save_16)), notes=("ambient.png was subtracted", "dark.png was"), **FINE),
    Row("the dark cat", (shots("dark cat {}.png"),), quiet="subtracted"),
    Row("a picture named dark that is bright", (FIVE, single("dark.png", SHOTS[5])), quiet="subtracted"),
]  # fmt: skip


@pytest.mark.parametrize("row", ROWS, ids=[row.name for row in ROWS])
def test_folder(row: Row, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    try_row(row, tmp_path, capfd)
