"""The room's light and the sensor's offset are subtracted in linear radiance, and clipped values are still known."""

from pathlib import Path

import numpy as np
import photo_folders as folders
import pytest
from PIL import Image
from raw_files import dng, mosaic

from render.shared.errors import InputError
from sdps import photos

RNG = np.random.default_rng(0)
LAMP = RNG.uniform(0.1, 0.6, (4, 24, 32, 3)).astype(np.float32)
ROOM = RNG.uniform(0.05, 0.2, (24, 32, 3)).astype(np.float32)
OFFSET = np.full((24, 32, 3), 0.02, np.float32)
ALL = np.ones((24, 32))
FINE = {"atol": 4 / 65535}


def write(folder: Path, **frames: np.ndarray) -> Path:
    """Write photographs in the room's light, a mask, and other pictures by their names, 16 bits."""
    folders.write_folder(folder, np.clip(LAMP + ROOM + OFFSET, 0, 1), ALL)
    for name, frame in frames.items():
        folders.write(folder / f"{name}.png", frame, 16)
    return folder


@pytest.mark.parametrize("name", ["ambient", "cat_ambient", "lights_off", "lightsOff", "no-flash"])
def test_an_ambient_picture_is_subtracted(tmp_path: Path, name: str) -> None:
    read = photos.load(write(tmp_path, **{name: ROOM + OFFSET}))
    np.testing.assert_allclose(read[0:4], LAMP, **FINE)
    np.testing.assert_allclose(read.window(slice(1, 3), slice(2, 9), slice(4, 5)), LAMP[1:3, 2:9, 4:5], **FINE)
    assert f"{name}.png was subtracted, as an ambient picture" in read.notes
    plain = photos.load(tmp_path, ambient="none")
    np.testing.assert_allclose(plain[0:4], LAMP + ROOM + OFFSET, **FINE)
    assert plain.background is None and plain.files == read.files
    np.testing.assert_allclose(photos.load(tmp_path, names=[f"!{name}*"])[0:4], plain[0:4])


def test_a_dark_frame_and_several_ambient_pictures(tmp_path: Path) -> None:
    noise = 0.01 * RNG.standard_normal(ROOM.shape).astype(np.float32)
    write(tmp_path, dark_frame=OFFSET, ambient_1=ROOM + OFFSET + noise, ambient_2=ROOM + OFFSET - noise)
    read = photos.load(tmp_path)
    np.testing.assert_allclose(read[0:4], LAMP, **FINE)
    assert "ambient_1.png, ambient_2.png were subtracted, as an ambient picture" in read.notes
    assert "dark_frame.png was subtracted, as a dark frame" in read.notes
    np.testing.assert_allclose(photos.load(tmp_path, ambient="none")[0:4], LAMP + ROOM, **FINE)
    half = photos.load(tmp_path, scale=0.5)[0:4]
    np.testing.assert_allclose(half, LAMP.reshape(4, 12, 2, 16, 2, 3).mean((2, 4)), **FINE)


def test_files_that_are_asked_for(tmp_path: Path) -> None:
    write(tmp_path, **{"5": ROOM + OFFSET, "6": OFFSET})
    shots = tuple(f"{number}.png" for number in range(1, 5))
    for ambient, dark in (("5.png", "6.png"), (tmp_path / "5.png", str(tmp_path / "6.png"))):
        read = photos.load(tmp_path, ambient=ambient, dark=dark)
        assert read.files == shots
        np.testing.assert_allclose(read[0:4], LAMP, **FINE)
    with pytest.raises(InputError, match=r"--ambient room.png: no such picture; name the file, or none"):
        photos.load(tmp_path, ambient="room.png")


def test_clipped_values_are_those_of_the_files(tmp_path: Path) -> None:
    write(tmp_path, ambient=ROOM)
    bright = LAMP[0] + ROOM
    bright[3:6, 4:9, 1] = 1.2
    folders.write(tmp_path / "1.png", bright, 16)
    read = photos.load(tmp_path)
    np.testing.assert_array_equal(read[0:1][0] >= read.saturation, bright >= 1)
    np.testing.assert_allclose(read[0:1][0][bright < 1], LAMP[0][bright < 1], **FINE)


def test_pictures_that_were_clipped_before_they_were_saved_are_found(tmp_path: Path) -> None:
    write(tmp_path, ambient=ROOM)
    for number, image in enumerate(LAMP):
        folders.write(tmp_path / f"{number + 1}.png", np.minimum(1.2 * image + ROOM, 0.8), 16)
    for ambient in (None, "none"):
        texts = [finding.text for finding in photos.check(photos.load(tmp_path, ambient=ambient))]
        assert any(text.startswith("Clipped before it was saved") for text in texts), texts


def test_an_ambient_picture_that_does_not_fit(tmp_path: Path) -> None:
    write(tmp_path, ambient=ROOM[:-2])
    read = photos.load(tmp_path)
    assert read.background is None
    assert "left out: ambient.png (an ambient picture by name, but it is 32x22 pixels, the photographs are 32x24)" in (
        read.notes
    )
    with pytest.raises(InputError, match=r"ambient.png: is 32x22 pixels, .*must be taken as the photographs are"):
        photos.load(tmp_path, ambient="ambient.png")
    folders.write(tmp_path / "ambient.png", ROOM, 8)
    with pytest.raises(InputError, match=r"is 8-bit PNG, the photographs are 16-bit PNG"):
        photos.load(tmp_path, ambient="ambient.png")
    folders.write(tmp_path / "ambient.png", LAMP[1] + ROOM, 16)
    assert "but it is as bright as the photographs)" in " ".join(photos.load(tmp_path).notes)


def shoot(path: Path, image: np.ndarray, seconds: float | None) -> None:
    """Write 8 bits, with the exposure in the EXIF data."""
    picture = Image.fromarray(np.rint(255 * image).astype(np.uint8))
    exif = picture.getexif()
    exif[274] = 1
    if seconds is not None:
        exif.get_ifd(0x8769).update({33434: seconds, 33437: 4.0, 34855: 100})
    picture.save(path, exif=exif)


def test_exposures_scale_the_ambient_picture(tmp_path: Path) -> None:
    folders.write(tmp_path / "mask.png", ALL)
    times = (0.1, 0.1, 0.2, 0.05)
    for number, (image, time) in enumerate(zip(LAMP, times, strict=True)):
        shoot(tmp_path / f"{number}.png", 0.4 * image + ROOM * time / 0.2, time)
    shoot(tmp_path / "ambient.png", ROOM, 0.2)
    read = photos.load(tmp_path, gamma="linear")
    np.testing.assert_allclose(read[0:4], 0.4 * LAMP, atol=2 / 255)
    said = "ambient.png was subtracted, as an ambient picture (times 0.25 to 1, the ratio of the exposures in the EXIF"
    assert any(note.startswith(said) for note in read.notes)
    shoot(tmp_path / "3.png", 0.4 * LAMP[3], None)
    assert "not all pictures say their exposure, so it is taken for the same" in " ".join(photos.load(tmp_path).notes)


def test_exposures_of_raw_files(tmp_path: Path) -> None:
    folders.write(tmp_path / "mask.png", ALL)
    for number, image in enumerate(LAMP):
        flat = np.broadcast_to(image.mean((0, 1)) + 0.05, image.shape)
        (tmp_path / f"{number}.dng").write_bytes(dng(mosaic((30000 * flat).astype(np.uint16)), seconds=0.5))
    room = np.full(LAMP[0].shape, 3000, np.uint16)
    (tmp_path / "ambient.dng").write_bytes(dng(mosaic(room), seconds=1.0))
    read = photos.load(tmp_path)
    without = photos.load(tmp_path, ambient="none")
    gains = (without[0:1] - read[0:1])[0, 12, 16] * 65535 / 1500
    assert gains.min() == pytest.approx(1.0, abs=0.01) and gains.max() < 1.3  # the daylight white balance
    assert any("times 0.5" in note for note in read.notes)
    (tmp_path / "3.dng").write_bytes(dng(mosaic(room), seconds=0.25))
    texts = [finding.text for finding in photos.check(photos.load(tmp_path))]
    assert any(text.startswith("The camera changed its exposure time between the pictures (0.25") for text in texts)
