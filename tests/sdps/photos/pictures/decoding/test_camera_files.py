"""RAW, HEIC and AVIF: read linearly and all alike, turned as the camera was, refused where the package is missing."""

import io
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image, features
from raw_files import dng, mosaic

from render.shared.errors import InputError
from sdps import photos
from sdps.photos.measures import _camera_settings
from sdps.photos.picture_file import decode, orient_pixels

HERE = Path(__file__).parent
FLAT = np.broadcast_to(np.array([9000, 20000, 12000], np.uint16), (24, 32, 3))


def write(path: Path, data: bytes) -> Path:
    path.write_bytes(data)
    return path


def test_raw_is_linear_and_keeps_its_scale(tmp_path: Path) -> None:
    half = decode(write(tmp_path / "a.dng", dng(mosaic(FLAT // 2)))).pixels.astype(float)
    whole = decode(write(tmp_path / "b.dng", dng(mosaic(FLAT)))).pixels.astype(float)
    bright = FLAT.copy()
    bright[4:8, 4:8] = 60000  # by which LibRaw would set full scale by itself
    third = decode(write(tmp_path / "c.dng", dng(mosaic(bright)))).pixels.astype(float)
    np.testing.assert_allclose(whole, 2 * half, atol=3)
    np.testing.assert_array_equal(third[12:], whole[12:])
    gains = whole[10, 10] / FLAT[0, 0]
    assert gains.min() == pytest.approx(1.0, abs=1e-3) and gains.max() < 1.3
    assert np.ptp(whole, axis=(0, 1)).max() == 0


def test_raw_levels_and_the_white_balance_of_the_moment(tmp_path: Path) -> None:
    plain = decode(write(tmp_path / "a.dng", dng(mosaic(FLAT)))).pixels.astype(float)
    data = dng(mosaic(FLAT // 16 + 256), black=256, white=4095 + 256, as_shot=0.4)
    found = decode(write(tmp_path / "b.dng", data))
    np.testing.assert_allclose(found.pixels, plain, rtol=2e-3)
    assert (found.coding.kind, found.coding.bits) == ("RAW", 16)
    full = decode(write(tmp_path / "c.dng", dng(np.full((24, 32), 4351, np.uint16), black=256, white=4351))).pixels
    assert full.min() >= 65500


def test_raw_by_its_bytes_and_tiff_by_a_raw_name(tmp_path: Path) -> None:
    assert decode(write(tmp_path / "a.tif", dng(mosaic(FLAT)))).coding.kind == "RAW"
    data = cv2.imencode(".tif", np.ascontiguousarray(FLAT))[1].tobytes()
    assert decode(write(tmp_path / "b.nef", data)).coding.kind == "TIFF"


@pytest.mark.parametrize("orientation", [1, 3, 6, 8])
def test_a_folder_of_raw_files(tmp_path: Path, orientation: int) -> None:
    shade = np.linspace(0.2, 1, 32)[:, None]
    for number in range(3):
        values = (FLAT * np.roll(shade, 9 * number, 0)).astype(np.uint16)
        write(tmp_path / f"IMG_{number}.DNG", dng(mosaic(values), orientation=orientation))
    read = photos.load(tmp_path)
    assert (len(read), read.gamma, read.bits) == (3, "linear", 16)
    assert read.shape == ((32, 24) if orientation in (6, 8) else (24, 32))
    assert any("camera RAW is developed linearly" in note for note in read.notes)
    upright = orient_pixels((FLAT * shade).astype(np.float32) / 65535, orientation)
    inner = slice(2, -2)
    np.testing.assert_allclose(read[0:1][0][inner, inner, 1], upright[inner, inner, 1], rtol=0.3)


def test_originals_are_read_where_there_are_no_copies(tmp_path: Path) -> None:
    for number in range(4):
        write(tmp_path / f"{number}.DNG", dng(mosaic(FLAT // (number + 1))))
        Image.fromarray((FLAT // 256 // (number + 1)).astype(np.uint8)).save(tmp_path / f"{number}.jpg")
    (tmp_path / "names.txt").write_text("0\n2\n3\n")
    assert photos.load(tmp_path, mask=_all(tmp_path)).files == ("0.jpg", "2.jpg", "3.jpg")
    (tmp_path / "names.txt").unlink()
    read = photos.load(tmp_path, mask=_all(tmp_path))
    assert read.files == tuple(f"{number}.jpg" for number in range(4))
    assert "left out: 4 .dng (the other pictures are read; --images '*.DNG' takes these)" in read.notes
    assert photos.load(tmp_path, mask=_all(tmp_path), names=["*.DNG"]).coding.kind == "RAW"
    (tmp_path / "0.jpg").unlink()
    (tmp_path / "1.jpg").unlink()
    assert photos.load(tmp_path, mask=_all(tmp_path)).coding.kind == "RAW"


def _all(folder: Path) -> Path:
    mask = folder.parent / "all.png"
    Image.new("L", (32, 24), 255).save(mask)
    return mask


def test_heic_is_handed_on_as_the_sensor_saw_it() -> None:
    upright, turned = (decode(HERE / f"{name}.heic") for name in ("upright", "turned"))
    assert (upright.coding.kind, upright.orientation, turned.orientation) == ("HEIC", 1, 6)
    assert upright.pixels.shape == turned.pixels.shape == (32, 48, 3)
    np.testing.assert_allclose(upright.pixels.astype(int), turned.pixels.astype(int), atol=4)
    settings = _camera_settings(HERE / "turned.heic", "HEIC")
    assert settings == pytest.approx({"exposure time": 0.01, "aperture": 2.8, "ISO": 100})
    assert turned.lens.equivalent == 26 and turned.exposure == pytest.approx(100 * 0.01 / 2.8**2)


@pytest.mark.skipif(not features.check("avif"), reason="this Pillow reads no AVIF")
@pytest.mark.parametrize("orientation", range(1, 9))
def test_avif(tmp_path: Path, orientation: int) -> None:
    values = (FLAT // 256).astype(np.uint8)
    values[:10, :14] = 200
    picture, file = Image.fromarray(values), io.BytesIO()
    exif = picture.getexif()
    exif[274] = orientation
    picture.save(file, "AVIF", quality=98, subsampling="4:4:4", exif=exif)
    found = decode(write(tmp_path / "a.heic", file.getvalue()))
    assert (found.coding.kind, found.orientation) == ("AVIF", orientation)
    np.testing.assert_allclose(found.pixels.astype(int), values, atol=12)


@pytest.mark.parametrize(("module", "name", "extra"), [("rawpy", "a.dng", "raw"), ("pi_heif", "a.heic", "heic")])
def test_a_missing_package_is_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, module: str, name: str, extra: str
) -> None:
    data = dng(mosaic(FLAT)) if extra == "raw" else (HERE / "upright.heic").read_bytes()
    monkeypatch.setitem(sys.modules, module, None)  # as if it were not installed
    with pytest.raises(InputError, match=rf"{name}: is .*pip install 'sdps\[{extra}\]'$"):
        decode(write(tmp_path / name, data))


@pytest.mark.parametrize("name", ["a.dng", "upright.heic"])
@pytest.mark.parametrize("part", [0.02, 0.3, 0.6, 0.95])
def test_damage_is_one_line(tmp_path: Path, capfd: pytest.CaptureFixture[str], name: str, part: float) -> None:
    data = dng(mosaic(FLAT)) if name == "a.dng" else (HERE / name).read_bytes()
    with pytest.raises(InputError, match=name):
        decode(write(tmp_path / name, data[: int(part * len(data))]))
    assert capfd.readouterr() == ("", "")


def test_lists_of_parts_that_crash_the_library_do_not_reach_it(tmp_path: Path) -> None:
    data = (HERE / "upright.heic").read_bytes()
    start = data.index(b"iloc") + 10 + 2  # its first item: number, construction, reference, offset, count, extents
    wrong = (data.replace(b"Exif", b"\x99vx\xfe", 1), data[: start + 6] + b"\x7f" + data[start + 7 :], data[:70])
    for number, some in enumerate(wrong):
        assert some != data
        with pytest.raises(InputError, match=rf"{number}.heic: damaged or"):
            decode(write(tmp_path / f"{number}.heic", some))
