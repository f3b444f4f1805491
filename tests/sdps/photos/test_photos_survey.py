"""Folders of real people: masks, results and dark frames among the photographs, and pictures that do not fit."""

from pathlib import Path

import cv2
import numpy as np
import OpenEXR
import photo_folders as folders
import pytest
from PIL import Image

from render.shared.errors import InputError
from render.shared.images import encode_normals, write_png
from sdps import photos
from sdps.photos.picture_file import orient_pixels

LIGHTS = np.array([[0.5, 0, 0.8], [-0.5, 0, 0.8], [0, 0.5, 0.8], [0, -0.5, 0.8], [0.2, 0.2, 0.9]])
IMAGES, MASK = folders.matte(LIGHTS, size=48)
SHOTS = tuple(f"{number}.png" for number in range(1, 6))


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Return a folder of five 8-bit photographs without a mask."""
    return folders.write_folder(tmp_path / "cat", IMAGES, bits=8)


def told(read: photos.Photographs) -> str:
    return " | ".join(read.notes)


def normals() -> np.ndarray:  # (H, W, 3) uint8
    y, x = np.mgrid[-1 : 1 : MASK.shape[0] * 1j, -1 : 1 : MASK.shape[1] * 1j]
    z = np.sqrt(np.maximum(1 - x**2 - y**2, 0))
    return encode_normals(np.where(z[..., None] > 0, np.stack([x, y, z], axis=-1), 0))


@pytest.mark.parametrize("name", ["x.mask.png", "sample_mask.png", "Mask-001.png", "mask.png", "a/../silhouette.tif"])
def test_a_mask_by_any_name_is_the_mask(folder: Path, name: str) -> None:
    folders.write(folder / Path(name).name, MASK.astype(float))
    read = photos.load(folder)
    assert (read.files, read.mask_origin) == (SHOTS, "file")
    np.testing.assert_array_equal(read.mask, MASK)
    assert f"the mask is {Path(name).name}" in told(read)


@pytest.mark.parametrize("bits", [8, 16])
@pytest.mark.parametrize("name", ["0.png", "3b.png", "bw.tif"])
def test_two_values_are_no_photograph(folder: Path, name: str, bits: int) -> None:
    folders.write(folder / name, MASK.astype(float), bits)
    read = photos.load(folder)
    assert read.files == SHOTS
    assert f"left out: {name} (has two values only, as a mask; --mask takes it as the mask)" in told(read)
    np.testing.assert_array_equal(photos.load(folder, mask=folder / name).mask, MASK)


@pytest.mark.parametrize("name", ["0.png", "out.png"])
def test_colours_of_normals_are_no_photograph(folder: Path, name: str) -> None:
    write_png(folder / name, normals())
    read = photos.load(folder)
    assert read.files == SHOTS
    assert f"left out: {name} (has the colours of normals)" in told(read)


def test_what_is_named_is_used_and_what_it_looks_like_is_said(folder: Path) -> None:
    folders.write(folder / "0.png", MASK.astype(float))
    write_png(folder / "6.png", normals())
    read = photos.load(folder, names=["0.png", "1.png", "6.png"])
    assert read.files == ("0.png", "1.png", "6.png")
    assert "0.png has two values only, as a mask; it is used as a photograph because it was named" in told(read)
    assert "6.png has the colours of normals; it is used" in told(read)
    assert photos.load(folder, names=["*.png"]).files == SHOTS
    (folder / "names.txt").write_text("0.png\n1.png\n2.png\n")
    assert "0.png has two values only" in told(photos.load(folder))


def test_where_most_pictures_have_two_values_they_are_photographs(tmp_path: Path) -> None:
    lit = np.zeros((5, 40, 40))
    for number in range(5):
        lit[number, 8:32, 6 + number : 30] = 0.4 + 0.1 * number  # a plate, without noise
    assert len(photos.load(folders.write_folder(tmp_path, lit[..., None].repeat(3, axis=3), bits=8))) == 5


def test_ambient_and_dark_frames(folder: Path) -> None:
    folders.write(folder / "ambient.png", IMAGES[0] * 0.2)
    folders.write(folder / "dark.png", IMAGES[0] * 0.02)
    read = photos.load(folder)
    assert read.files == SHOTS
    assert "ambient.png was subtracted, as an ambient picture | dark.png was subtracted, as a dark frame" in told(read)
    folders.write(folder / "dark.png", IMAGES[0])  # the dark cat
    assert photos.load(folder).files == (*SHOTS, "dark.png")


def test_several_masks(folder: Path) -> None:
    for number in range(1, 6):
        folders.write(folder / f"{number}_mask.png", MASK.astype(float))
    read = photos.load(folder)
    assert read.files == SHOTS and (read.mask == MASK).all()
    assert "(the same mask as 1_mask.png)" in told(read)
    folders.write(folder / "3_mask.png", np.roll(MASK, 2, 0).astype(float))
    with pytest.raises(InputError, match=r"several masks that differ \(1_mask.png, .*with --mask FILE"):
        photos.load(folder)
    assert (photos.load(folder, mask=folder / "2_mask.png").mask == MASK).all()
    folders.write(folder / "mask.png", np.roll(MASK, 1, 0).astype(float))
    read = photos.load(folder)
    assert (read.mask == np.roll(MASK, 1, 0)).all() and "(another mask than mask.png)" in told(read)


def test_what_is_a_mask_by_name_only_is_neither(folder: Path) -> None:
    folders.write(folder / "mask_view.png", IMAGES[0] * 0.7 + 0.2 * np.random.default_rng(0).random(IMAGES[0].shape))
    read = photos.load(folder)
    assert (read.files, read.mask_origin) == (SHOTS, "automatic")
    assert "mask_view.png (a mask by name, but of many grey values)" in told(read)


def test_a_mask_of_zeros_and_ones(folder: Path) -> None:
    write_png(folder / "mask.png", MASK.astype(np.uint8))
    np.testing.assert_array_equal(photos.load(folder).mask, MASK)


@pytest.mark.parametrize("odd", [1, 2, 5])
def test_the_odd_picture_is_named(folder: Path, odd: int) -> None:
    path = folder / f"{odd}.png"
    folders.write(path, IMAGES[0][:-4])
    usual = f"{IMAGES.shape[2]}x{IMAGES.shape[1]}"
    with pytest.raises(InputError, match=rf"{odd}.png: is .*, the other 4 \(as .\.png\) are {usual}; .*'!{odd}.png'"):
        photos.load(folder)
    folders.write(path, IMAGES[0], 16)
    with pytest.raises(InputError, match=rf"{odd}.png: is 16-bit PNG, the other 4 \(as .\.png\) are 8-bit PNG; "):
        photos.load(folder)
    assert len(photos.load(folder, names=[f"!{odd}.png"])) == 4


def test_several_odd_pictures_and_turned_ones(folder: Path) -> None:
    for number in (1, 2):
        folders.write(folder / f"{number}.png", np.swapaxes(IMAGES[0][:-4], 0, 1))
        folders.write(folder / f"{number + 2}.png", IMAGES[0][:-4])
    folders.write(folder / "5.png", IMAGES[0][:-4])
    with pytest.raises(InputError, match=r"1.png: is .*3 others .*2 differ: 1.png, 2.png; .*turned by 90 degrees"):
        photos.load(folder)


def test_jpeg_under_the_name_of_png(folder: Path) -> None:
    for name in SHOTS:
        Image.fromarray(cv2.imread(str(folder / name))[..., ::-1]).save(folder / name, "JPEG", quality=95)
    read = photos.load(folder)
    assert read.coding.kind == "JPEG" and read.files == SHOTS
    assert "1.png, 2.png, 3.png, 4.png, 5.png are JPEG files in spite of the name, and read as such" in told(read)


def test_layers_and_windows_of_a_renderer(tmp_path: Path) -> None:
    whole = np.zeros_like(IMAGES)
    for number, image in enumerate(IMAGES):
        top, left = 3 + number, 5  # each stored as small as its light lets it
        cut = np.ascontiguousarray(image[top:-2, left:])
        whole[number, top:-2, left:] = cut
        channels = {f"ViewLayer.Combined.{letter}": np.ascontiguousarray(cut[..., k]) for k, letter in enumerate("RGB")}
        channels["ViewLayer.Depth.Z"] = np.ascontiguousarray(cut[..., 0])
        height, width = image.shape[:2]
        corners = np.array([[left, top], [width - 1, height - 3], [0, 0], [width - 1, height - 1]], np.int32)
        header = {"dataWindow": tuple(corners[:2]), "displayWindow": tuple(corners[2:])}
        OpenEXR.File(header, channels).write(str(tmp_path / f"{number}.exr"))
    folders.write(tmp_path / "mask.png", MASK.astype(float))
    read = photos.load(tmp_path)
    np.testing.assert_array_equal(read[0:5], whole)
    assert "layers read from the EXR files: ViewLayer.Combined" in told(read)


def test_lights_and_gamma_of_a_benchmark_with_a_folder_of_images(folder: Path) -> None:
    top = folder.parent / "top"
    folder.rename(top / "images") if top.mkdir() is None else None
    (top / "filenames.txt").write_text("\n".join(SHOTS[::-1]))
    np.savetxt(top / "light_directions.txt", LIGHTS[::-1])
    folders.write(top / "mask.png", MASK.astype(float))
    read = photos.load(top, lights="folder")
    assert read.files == tuple(f"images/{name}" for name in SHOTS[::-1]) and read.gamma == "linear"
    np.testing.assert_allclose(read[4:5][0], np.clip(IMAGES[0], 0, 1), atol=0.01)
    np.testing.assert_allclose(read.light_directions[4], LIGHTS[0] / np.linalg.norm(LIGHTS[0]), atol=1e-6)
    photos.check(read)


def test_lights_that_do_not_fit_name_what_was_left_out(folder: Path) -> None:
    folders.write(folder / "0.png", MASK.astype(float))
    np.savetxt(folder / "lights.txt", np.vstack([LIGHTS, LIGHTS[:1]]))
    with pytest.raises(InputError, match=r"6 rows for 5 pictures .*left out: 0.png \(has two values only"):
        photos.load(folder, lights=folder / "lights.txt")


@pytest.mark.parametrize("odd", [1, 4, 9])
def test_one_of_another_size_or_kind_among_many_is_left_out(tmp_path: Path, odd: int) -> None:
    lights = np.vstack([LIGHTS, LIGHTS[:4] * [1, 1, 0.7]])
    images, _ = folders.matte(lights, size=48)
    folder = folders.write_folder(tmp_path / "cat", images, bits=8)
    usual = tuple(f"{number}.png" for number in range(1, 10) if number != odd)
    whole = photos.load(folder, names=[f"!{odd}.png"])
    for image, bits, words in ((images[0][:-4], 8, "80x76 pixels"), (images[0], 16, "16-bit PNG")):
        folders.write(folder / f"{odd}.png", image, bits)
        read = photos.load(folder)
        assert f"left out: {odd}.png ({words}); the others are 80x80 pixels, 8-bit PNG" in told(read)
        assert read.files == usual
        np.testing.assert_array_equal(read.mask, whole.mask)
        np.testing.assert_array_equal(read[0:8], whole[0:8])
        with pytest.raises(InputError, match=rf"{odd}.png: is .*, the other 8"):
            photos.load(folder, names=[f"{odd}.png", "*.png"])
    folders.write(folder / f"{odd % 9 + 1}.png", images[0][:-4])
    with pytest.raises(InputError, match=r"all pictures must have one size|keep one kind"):
        photos.load(folder)


@pytest.mark.parametrize("order", ["123", "132"])
@pytest.mark.parametrize("tag", [5, 6, 7, 8])
def test_one_that_was_saved_turned_is_turned_to_agree(tmp_path: Path, tag: int, order: str) -> None:
    sensor = np.rint(IMAGES[:3, :-8] * 255).astype(np.uint8)  # not square
    for name, image in zip(order, sensor, strict=True):
        upright = orient_pixels(image, tag)
        picture = Image.fromarray(upright if name == "2" else image)
        exif = picture.getexif()
        exif[274] = 1 if name == "2" else tag
        picture.save(tmp_path / f"{name}.png", exif=exif)
    read = photos.load(tmp_path, gamma="linear")
    assert read.shape == (80, 72)
    expected = np.stack([orient_pixels(image, tag) for image in sensor]) / np.float32(255)
    np.testing.assert_allclose(read[0:3], expected[[order.index(name) for name in "123"]], atol=1e-6)
    assert "2.png was saved turned" in told(read)


def test_the_pictures_whose_orientation_tags_differ_are_named(tmp_path: Path) -> None:
    for number, tag in ((1, 1), (2, 1), (3, 6)):
        picture = Image.fromarray(np.rint(IMAGES[number] * 255).astype(np.uint8))
        exif = picture.getexif()
        exif[274] = tag
        picture.save(tmp_path / f"{number}.jpg", quality=98, exif=exif)
    assert "the orientation tags of 3.jpg differ from the first picture's" in told(photos.load(tmp_path))
