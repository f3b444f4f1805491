"""Every kind of picture file is known by its bytes and read exactly, and refused in words that help."""

import io
import os
import struct
import sys
from pathlib import Path

import cv2
import numpy as np
import OpenEXR
import pytest
import tifffile
from PIL import Image

from render.shared.errors import InputError
from sdps.photos.picture_file import Picture, decode
from sdps.photos.pictures.picture_kinds import picture_kind

RNG = np.random.default_rng(0)
EIGHT = RNG.integers(0, 256, (11, 13, 3), np.uint8)
SIXTEEN = RNG.integers(0, 65536, (11, 13, 3), np.uint16)


def pillow(kind: str, mode: str = "RGB", **options: object) -> bytes:
    file = io.BytesIO()
    Image.fromarray(EIGHT).convert(mode).save(file, kind, **options)
    return file.getvalue()


def opencv(suffix: str, pixels: np.ndarray) -> bytes:
    return cv2.imencode(suffix, np.ascontiguousarray(pixels[..., ::-1]))[1].tobytes()


def exr() -> bytes:
    file = Path(os.environ.get("TMPDIR", "/tmp")) / f"kinds-{os.getpid()}.exr"
    OpenEXR.File({}, {"RGB": np.ascontiguousarray(EIGHT, np.float32)}).write(str(file))
    try:
        return file.read_bytes()
    finally:
        file.unlink()


def tiff() -> bytes:
    file = io.BytesIO()
    tifffile.imwrite(file, SIXTEEN, photometric="rgb")
    return file.getvalue()


def targa(flags: int = 0, grey: bool = False, encoded: bool = False) -> bytes:
    """Return a TGA: rows from the bottom up, or as `flags` say; `encoded` as single runs."""
    pixels = EIGHT[..., :1] if grey else EIGHT[..., ::-1]
    rows = pixels if flags & 0x20 else pixels[::-1]
    body = (
        b"".join(b"\x80" + value.tobytes() for value in rows.reshape(-1, rows.shape[2])) if encoded else rows.tobytes()
    )
    head = struct.pack(
        "<BBBHHBHHHHBB", 0, 0, (3 if grey else 2) + 8 * encoded, 0, 0, 0, 0, 0, 13, 11, 8 if grey else 24, flags
    )
    return head + body


def netpbm(magic: str, values: np.ndarray, greatest: int | None, text: bool = False) -> bytes:
    height, width = values.shape[:2]
    head = f"{magic}\n# by hand\n{width} {height}\n" + ("" if greatest is None else f"{greatest}\n")
    if text:
        return (head + "\n".join(" ".join(map(str, row)) for row in values.reshape(height, -1))).encode()
    return head.encode() + values.astype(">u2" if greatest is not None and greatest > 255 else np.uint8).tobytes()


def read(tmp_path: Path, data: bytes, name: str = "a.png") -> Picture:
    (tmp_path / name).write_bytes(data)
    return decode(tmp_path / name)


FILES = {
    "PNG": lambda: opencv(".png", SIXTEEN), "TIFF": tiff, "JPEG": lambda: pillow("JPEG"), "EXR": exr,
    "BMP": lambda: pillow("BMP"), "PNM": lambda: netpbm("P6", EIGHT, 255), "TGA": lambda: pillow("TGA"),
    "WebP": lambda: pillow("WEBP", lossless=True),
}  # fmt: skip


@pytest.mark.parametrize("kind", FILES)
@pytest.mark.parametrize("suffix", [".png", ".jpg", ".tif", ".exr", ".bmp", ".pgm", ".tga", ".webp"])
def test_the_bytes_say_the_kind_whatever_the_name(tmp_path: Path, kind: str, suffix: str) -> None:
    picture = read(tmp_path, FILES[kind](), f"a{suffix}")
    assert picture.coding.kind == kind
    wanted = SIXTEEN if kind in ("PNG", "TIFF") else EIGHT
    if kind != "JPEG":
        np.testing.assert_array_equal(picture.pixels, wanted)


def test_bitmaps(tmp_path: Path) -> None:
    np.testing.assert_array_equal(read(tmp_path, pillow("BMP"), "a.bmp").pixels, EIGHT)
    for mode in ("L", "P", "1"):
        expected = np.asarray(Image.fromarray(EIGHT).convert(mode).convert("RGB"))
        np.testing.assert_array_equal(read(tmp_path, pillow("BMP", mode), "a.bmp").pixels, expected)
    wide = np.dstack([EIGHT[..., ::-1], np.zeros((11, 13, 1), np.uint8)])[::-1]  # 32 bits, the fourth unused
    head = b"BM" + struct.pack("<IIIIiiHH", 54 + wide.size, 0, 54, 40, 13, 11, 1, 32) + bytes(24)
    found = read(tmp_path, head + wide.tobytes(), "a.bmp")
    np.testing.assert_array_equal(found.pixels, EIGHT)
    assert found.alpha is None


@pytest.mark.parametrize("encoded", [False, True])
@pytest.mark.parametrize("grey", [False, True])
@pytest.mark.parametrize("flags", [0x00, 0x20])
def test_targa(tmp_path: Path, flags: int, grey: bool, encoded: bool) -> None:
    found = read(tmp_path, targa(flags, grey, encoded), "a.tga").pixels
    np.testing.assert_array_equal(found, np.repeat(EIGHT[..., :1], 3, axis=2) if grey else EIGHT)


@pytest.mark.parametrize("text", [False, True])
@pytest.mark.parametrize("greatest", [1, 15, 100, 255, 1023, 4095, 65535])
@pytest.mark.parametrize("grey", [False, True])
def test_netpbm(tmp_path: Path, grey: bool, greatest: int, text: bool) -> None:
    shape = (11, 13) if grey else (11, 13, 3)
    values = RNG.integers(0, greatest + 1, shape)
    magic = {(True, True): "P2", (True, False): "P5", (False, True): "P3", (False, False): "P6"}[grey, text]
    found = read(tmp_path, netpbm(magic, values, greatest, text), "a.pgm")
    full = 255 if greatest < 256 else 65535
    assert (found.coding.bits, found.pixels.dtype.itemsize) == ((8, 1) if full == 255 else (16, 2))
    expected = np.rint(values * (full / greatest))
    np.testing.assert_array_equal(found.pixels, expected[..., None].repeat(3, axis=2) if grey else expected)


def test_bits_of_one(tmp_path: Path) -> None:
    ink = RNG.integers(0, 2, (11, 13))
    packed = b"P4 13 11\n" + np.packbits(ink, axis=1).tobytes()
    spaced, tight = netpbm("P1", ink, None, True), b"P1\n13 11\n" + "".join(map(str, ink.ravel())).encode()
    for data in (packed, spaced, tight):
        np.testing.assert_array_equal(read(tmp_path, data, "a.pbm").pixels[..., 0], 255 * (1 - ink))


@pytest.mark.parametrize("kind", FILES)
@pytest.mark.parametrize("part", [0.0, 0.05, 0.5, 0.9])
def test_damage_is_one_line_without_addresses_and_nothing_is_printed(
    tmp_path: Path, kind: str, part: float, capfd: pytest.CaptureFixture[str]
) -> None:
    data = FILES[kind]()
    with pytest.raises(InputError) as error:
        read(tmp_path, data[: int(part * len(data))], "x.tga" if kind == "TGA" else "x.png")
    assert "0x" not in str(error.value) and "BytesIO" not in str(error.value) and "\n" not in str(error.value)
    assert "x." in str(error.value) and ";" in str(error.value)
    sys.stdout.flush()
    assert capfd.readouterr() == ("", "")


def test_odd_profiles_and_tags_print_nothing(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    np.testing.assert_array_equal(read(tmp_path, pillow("PNG", icc_profile=b"nonsense" * 30)).pixels, EIGHT)
    data = bytearray(tiff())
    with tifffile.TiffFile(io.BytesIO(data)) as file:
        entry = file.pages[0].tags["XResolution"].offset
    data[entry + 8 : entry + 12] = b"\xff\xff\xff\x7f"  # where its value lies
    np.testing.assert_array_equal(read(tmp_path, bytes(data), "a.tif").pixels, SIXTEEN)
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (b"\0\0\0\x18ftypheic" + bytes(90), "damaged or not a HEIC"),
        (b"GIF89a" + bytes(90), "is a GIF"),
        (b"II*\0\x10\0\0\0CR\x02\0" + bytes(90), "damaged or not camera RAW"),
        (b"IIII" + bytes(90), "is camera RAW of a kind, which is not read; convert it"),
        (b"<!DOCTYPE html><html>", "is a web page"),
        (b"version https://git-lfs.github.com/spec/v1\n", "is a placeholder of Git LFS"),
        (b"", "the file is empty"),
        (b"this is no picture at all", "damaged or not a JPEG"),
    ],
)
def test_what_is_not_read_is_named(tmp_path: Path, data: bytes, words: str) -> None:
    with pytest.raises(InputError, match=words):
        read(tmp_path, data, "a.jpg")


def test_headers_that_announce_too_much(tmp_path: Path) -> None:
    for data, name in ((b"P5 90000 90000 255\n12", "a.pgm"), (b"P5 0 4 255\n", "b.pgm"), (b"P5 4 4 70000\n", "c.pgm"),
                       (b"P5 4", "d.pgm"), (b"P2 2 1 9 5 77", "e.pgm"), (b"P2 2 1 9 5 x", "f.pgm")):  # fmt: skip
        with pytest.raises(InputError, match=rf"{name}: "):
            read(tmp_path, data, name)


def test_messages_show_no_objects_of_libraries() -> None:
    text = str(InputError("a.png: damaged (cannot identify image file <_io.BytesIO object at 0x7f2a8c0>); copy it"))
    assert text == "a.png: damaged (cannot identify image file); copy it"
    assert str(InputError("a <b> 0x1f and <function f at 0x7f00aa11>")) == "a <b> 0x1f and"
    assert picture_kind(b"anything", "a.tga") is None
