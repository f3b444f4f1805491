"""The camera of photographs: flags, EXIF data of every kind of file, turned, reduced and cut pictures, and refusals."""

import struct
from pathlib import Path

import numpy as np
import photo_folders as folders
import pytest
import tifffile
from PIL import Image
from sdps_scenes import hemisphere_lights

from render.shared.errors import InputError
from sdps.core.geometry import Camera
from sdps.photos import Photographs, load
from sdps.photos.pictures.lens import FILM, NO_LENS, NOT_KNOWN, Lens, read_lens, read_wanted

LIGHTS = hemisphere_lights(4, np.random.default_rng(0))
IMAGES = folders.matte(LIGHTS)[0][:, :96, :80]  # (4, 96, 80, 3)


def write(folder: Path, *tags: dict[int, float], suffix: str = ".jpg", orientation: int = 1) -> Path:
    """Write the photographs with EXIF tags, those of the last for the rest."""
    for number, image in enumerate(IMAGES):
        exif = Image.Exif()
        exif[274] = orientation
        exif.get_ifd(0x8769).update(tags[min(number, len(tags) - 1)])
        pixels = np.rint(255 * image).astype(np.uint8)
        if suffix == ".tif":
            write_tiff(folder / f"{number}.tif", pixels, tags[min(number, len(tags) - 1)], orientation)
        else:
            Image.fromarray(pixels).save(folder / f"{number}{suffix}", exif=exif)
    return folder


def write_tiff(path: Path, pixels: np.ndarray, tags: dict[int, float], orientation: int) -> None:
    """Write a TIFF with EXIF tags behind the pixels, which Pillow leaves out."""
    extra = [(274, "H", 1, orientation, True), (0x8768, "I", 1, 9, True)]  # tifffile does not write 0x8769
    tifffile.imwrite(path, pixels, photometric="rgb", byteorder="<", extratags=extra)
    data, stand_in = path.read_bytes(), struct.pack("<HHII", 0x8768, 4, 1, 9)
    assert stand_in in data
    data = data.replace(stand_in, struct.pack("<HHII", 0x8769, 4, 1, len(data)))
    entries = b"".join(struct.pack("<HHIHH", tag, 3, 1, value, 0) for tag, value in sorted(tags.items()))
    path.write_bytes(data + struct.pack("<H", len(tags)) + entries + bytes(4))


def test_without_exif_data_nothing_is_known(tmp_path: Path) -> None:
    photos = load(folders.write_folder(tmp_path, IMAGES))
    assert photos.camera == Camera() and photos.camera_origin == NOT_KNOWN and photos.pixel_size is None
    assert photos.camera_summary == "orthographic, looking along -z"
    assert not any("focal" in note for note in photos.notes)


@pytest.mark.parametrize("suffix", [".jpg", ".png", ".tif", ".webp"])
@pytest.mark.parametrize("orientation", [1, 6])
def test_exif_data_give_the_focal_length(tmp_path: Path, suffix: str, orientation: int) -> None:
    photos = load(write(tmp_path, {41989: 26}, suffix=suffix, orientation=orientation))
    assert photos.shape == ((80, 96) if orientation == 6 else (96, 80))
    assert photos.camera.focal == pytest.approx(26 / FILM * np.hypot(96, 80)) and photos.camera.principal is None
    assert photos.camera_origin == "EXIF: 26 mm (35 mm equivalent)"
    assert photos.camera_summary == "perspective, focal length 75 px (EXIF: 26 mm (35 mm equivalent))"
    assert any("26 mm" in note and "75 pixels; --focal orthographic leaves it out" in note for note in photos.notes)
    flat = load(tmp_path, focal="orthographic")
    assert flat.camera == Camera() and flat.camera_origin == "--focal"


@pytest.mark.parametrize("tags", [({41989: 26}, {41989: 52}), ({41989: 26}, {})])
def test_exif_data_that_differ_are_not_used(tmp_path: Path, tags: tuple) -> None:
    photos = load(write(tmp_path, *tags))
    assert not photos.camera.is_perspective and photos.camera_origin == NOT_KNOWN
    assert any("differ in the focal length, so it is not used; give --focal" in note for note in photos.notes)
    assert load(tmp_path, focal="60mm").camera.focal == pytest.approx(60 / FILM * np.hypot(96, 80))


@pytest.mark.parametrize("value", [0, 3])
def test_exif_data_that_name_no_lens_are_no_fault(tmp_path: Path, value: int) -> None:
    assert not load(write(tmp_path, {41989: value})).camera.is_perspective


def test_damaged_exif_data_are_no_fault() -> None:
    def broken() -> dict:
        raise SyntaxError("not a directory")

    assert read_lens(broken) == NO_LENS
    assert read_lens(lambda: {41989: "wide", 40962: 3}) == NO_LENS
    assert read_lens(lambda: {41989: float("nan"), 40962: 3, 40963: float("inf")}) == NO_LENS


@pytest.mark.parametrize(
    ("frame", "diagonal", "said"),
    [
        ((96, 80), np.hypot(96, 80), ""),
        ((80, 96), np.hypot(96, 80), ""),
        ((400, 300), 500.0, "cut out; --principal COLUMN,ROW"),
        ((960, 800), np.hypot(96, 80), "the whole view at another size"),
    ],
)
@pytest.mark.parametrize("focal", [None, "50mm"])
def test_pictures_that_were_cut(tmp_path: Path, frame: tuple, diagonal: float, said: str, focal: str | None) -> None:
    photos = load(write(tmp_path, {41989: 50, 40962: frame[0], 40963: frame[1]}), focal=focal)
    assert photos.camera.focal == pytest.approx(50 / FILM * diagonal)
    assert any("EXIF data say" in note for note in photos.notes) == bool(said)
    assert said in " ".join(photos.notes)


@pytest.mark.parametrize("focal", ["150px", " 150 PX", 150, 150.0, "1.5e2", np.float32(150)])
def test_focal_lengths_in_pixels_shrink_with_the_pictures(tmp_path: Path, focal: object) -> None:
    folders.write_folder(tmp_path, IMAGES)
    whole = load(tmp_path, focal=focal, principal="10,20", pixel_size=0.1)
    assert whole.camera == Camera(150.0, (10.0, 20.0)) and whole.pixel_size == 0.1
    half = load(tmp_path, focal=focal, principal=(10, 20), pixel_size=0.1, scale=0.5)
    assert half.camera == Camera(75.0, (4.75, 9.75)) and half.pixel_size == pytest.approx(0.2)
    assert half.camera_summary == "perspective, focal length 75 px (--focal), principal point 4.75, 9.75"
    places = [photos.camera.sights(photos.shape) for photos in (whole, half)]
    assert np.allclose(places[0].reshape(48, 2, 40, 2, 3).mean(axis=(1, 3)), places[1])


def test_a_principal_point_alone_does_nothing(tmp_path: Path) -> None:
    photos: Photographs = load(folders.write_folder(tmp_path, IMAGES), principal="10,20")
    assert photos.camera == Camera()
    assert "--principal does nothing without a focal length; give --focal" in photos.notes


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        ({"focal": "0"}, "--focal 0: must be above 0"),
        ({"focal": 0}, "--focal 0: must be above 0"),
        ({"focal": "-3mm"}, "--focal -3mm: must be above 0"),
        ({"focal": float("inf")}, "--focal"),
        ({"focal": "28cm"}, "unknown unit of --focal 'cm'; did you mean 'mm'"),
        ({"focal": "28 inch"}, "unknown unit of --focal 'inch'; known: mm, px"),
        ({"focal": "ortographic"}, "did you mean 'orthographic'"),
        ({"focal": 28}, "28 pixels are too few .* write 28mm"),
        ({"principal": "3"}, "--principal 3: must be two numbers, COLUMN,ROW"),
        ({"principal": "3,x"}, "--principal 3,x: must be two numbers"),
        ({"principal": (1, 2, 3)}, "--principal 1,2,3: must be two numbers"),
        ({"principal": "nan,1"}, "must be two numbers"),
        ({"pixel_size": 0.0}, "--pixel-size 0: must be above 0"),
        ({"pixel_size": -1.0}, "--pixel-size -1: must be above 0"),
        ({"pixel_size": float("nan")}, "--pixel-size nan: must be above 0"),
        ({"pixel_size": 1e308}, r"--pixel-size 1e\+308: must be above 0 and under a million"),
        ({"focal": "1e308"}, r"--focal: 1e\+308 pixels are too many for a picture of 400x300; .* write orthographic"),
        ({"principal": "1e308,5"}, "--principal 1e308,5: must be two numbers"),
    ],
)
def test_what_is_refused(flags: dict, message: str) -> None:
    with pytest.raises(InputError, match=message) as error:
        read_wanted(**flags).find([Lens()], (300, 400), (300, 400))
    assert "\n" not in str(error.value)
