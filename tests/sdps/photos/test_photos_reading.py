"""Folders of photographs: what is read, how it is made linear, and one clear line for every bad folder."""

import re
import shutil
import tracemalloc
from pathlib import Path

import cv2
import numpy as np
import OpenEXR
import photo_folders as folders
import pytest
import tifffile
from PIL import Image, ImageCms, ImageOps

from render.shared.errors import InputError
from sdps import photos
from sdps.photos.pictures.profiles import SRGB_EXPONENT, read_profile

RAMP = np.stack(np.broadcast_arrays(np.linspace(0, 1, 20)[None], np.linspace(0.1, 0.9, 14)[:, None], 0.5), axis=-1)
PAIR = np.stack([RAMP, RAMP * 0.5])  # (2, 14, 20, 3)
WHOLE = np.ones(RAMP.shape[:2])


def profile(name: str = "sRGB") -> bytes:
    return ImageCms.ImageCmsProfile(ImageCms.createProfile(name)).tobytes()


def linear_profile() -> bytes:
    """Return an sRGB profile whose curves are replaced by linear ones."""
    data = bytearray(profile())
    count = int.from_bytes(data[128:132], "big")
    for entry in range(count):
        start = 132 + 12 * entry
        if data[start : start + 4] in (b"rTRC", b"gTRC", b"bTRC"):
            offset = int.from_bytes(data[start + 4 : start + 8], "big")
            data[offset : offset + 12] = b"curv" + bytes(8)
    return bytes(data)


@pytest.mark.parametrize(
    ("suffix", "bits", "gamma"),
    [(".png", 8, "srgb"), (".png", 16, "linear"), (".tif", 8, "srgb"), (".tif", 16, "linear"), (".tif", 32, "linear"),
     (".exr", 32, "linear"), (".jpg", 8, "srgb")],
)  # fmt: skip
def test_every_kind_of_file_becomes_linear_radiance(tmp_path: Path, suffix: str, bits: int, gamma: str) -> None:
    coded = folders.to_srgb(PAIR) if gamma == "srgb" else PAIR
    folders.write_folder(tmp_path, coded.astype(np.float32), WHOLE, suffix=suffix, bits=bits)
    read = photos.load(tmp_path)
    assert (len(read), read.shape, read.bits, read.gamma) == (2, (14, 20), bits, gamma)
    images = read[0:2]
    assert images.dtype == np.float32
    if suffix == ".jpg":  # its colours are coarser than its brightness
        assert np.abs(images - PAIR).mean() < 0.03
    else:
        np.testing.assert_allclose(images, PAIR, atol=1.2 / 255 if bits == 8 else 1e-4)
    assert any("linear" in note or "sRGB" in note for note in read.notes)


def test_an_image_source_reads_what_is_asked_for(tmp_path: Path) -> None:
    images = np.linspace(0.1, 1, 12)[:, None, None, None] * RAMP
    read = photos.load(folders.write_folder(tmp_path, images, WHOLE))
    assert read.files[8:] == ("9.png", "10.png", "11.png", "12.png")  # natural order
    np.testing.assert_allclose(read[9:12], images[9:], atol=1e-4)
    np.testing.assert_allclose(read[10:100], images[10:], atol=1e-4)
    assert read[3:3].shape == (0, 14, 20, 3)


def test_memory_does_not_grow_with_the_number_of_images(tmp_path: Path) -> None:
    def peak(count: int) -> int:
        folder = folders.write_folder(tmp_path / str(count), np.tile(images, (count // 4, 1, 1, 1)), None)
        tracemalloc.start()
        photos.check(photos.load(folder))
        size = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        return size

    images, _ = folders.matte(np.array([[0.5, 0, 0.8], [-0.5, 0, 0.8], [0, 0.5, 0.8], [0, -0.5, 0.8]]))
    photos.check(photos.load(folders.write_folder(tmp_path / "first", images)))  # caches
    few, many = peak(4), peak(24)
    assert many - few < 20 * (12 * 2048 + 16384)  # samples of the pixels, not the pixels, 130 kB each


def test_gamma_follows_the_profile_the_folder_and_the_user(tmp_path: Path) -> None:
    folders.write_folder(tmp_path, PAIR, WHOLE, bits=8)
    assert photos.load(tmp_path).gamma == "srgb"
    assert photos.load(tmp_path, gamma="linear").gamma == "linear"
    assert photos.load(tmp_path, gamma="2.2").gamma == 2.2
    np.testing.assert_allclose(photos.load(tmp_path, gamma=2.2)[0:1][0], RAMP**2.2, atol=0.01)
    (tmp_path / "filenames.txt").write_text("1.png\n2.png\n")
    read = photos.load(tmp_path)
    assert read.gamma == "linear"
    assert "filenames.txt" in " ".join(read.notes)
    for number in (1, 2):
        Image.open(tmp_path / f"{number}.png").save(tmp_path / f"{number}.png", icc_profile=profile())
    assert photos.load(tmp_path).gamma == "srgb"
    with pytest.raises(InputError, match="'bright' is none of auto, linear, srgb"):
        photos.load(tmp_path, gamma="bright")
    with pytest.raises(InputError, match="22 is not a display curve"):
        photos.load(tmp_path, gamma=22)


def test_profiles_tell_their_curve() -> None:
    assert read_profile(profile()).exponent == pytest.approx(SRGB_EXPONENT, abs=0.005)
    assert read_profile(linear_profile()).exponent == 1.0
    assert read_profile(b"rubbish").exponent is None
    assert read_profile(profile()[:150]).exponent is None
    assert read_profile(None).exponent is None


def test_a_linear_profile_makes_jpeg_linear(tmp_path: Path) -> None:
    for number in (1, 2):
        Image.fromarray((RAMP * 255).astype(np.uint8)).save(tmp_path / f"{number}.jpg", icc_profile=linear_profile())
    folders.write(tmp_path / "mask.png", WHOLE)
    assert photos.load(tmp_path).gamma == "linear"


def test_grey_and_transparent_pictures_are_rgb(tmp_path: Path) -> None:
    folders.write(tmp_path / "1.png", RAMP[..., 1], 16)
    rgba = np.dstack([RAMP, WHOLE * 0.5])
    cv2.imwrite(str(tmp_path / "2.png"), np.rint(rgba[..., [2, 1, 0, 3]] * 65535).astype(np.uint16))
    folders.write(tmp_path / "mask.png", WHOLE)
    read = photos.load(tmp_path)[0:2]
    np.testing.assert_allclose(read[0], np.repeat(RAMP[..., 1:2], 3, axis=2), atol=1e-4)
    np.testing.assert_allclose(read[1], RAMP, atol=1e-4)


@pytest.mark.parametrize("orientation", range(1, 9))
@pytest.mark.parametrize("suffix", [".jpg", ".tif"])
def test_orientation_tags_turn_all_pictures_alike(tmp_path: Path, suffix: str, orientation: int) -> None:
    smooth = np.rint(RAMP * 255).astype(np.uint8)
    exif = Image.Exif()
    for number, tag in ((1, orientation), (2, 3)):
        exif[274] = tag
        Image.fromarray(smooth).save(
            tmp_path / f"{number}{suffix}", exif=exif, **({"quality": 98} if suffix == ".jpg" else {})
        )
    with Image.open(tmp_path / f"1{suffix}") as picture:  # as a viewer shows it
        upright = np.asarray(ImageOps.exif_transpose(picture)) / 255
    folders.write(tmp_path / "mask.png", np.ones(upright.shape[:2]))
    read = photos.load(tmp_path, gamma="linear")
    assert read.shape == upright.shape[:2]
    np.testing.assert_allclose(read[0:1][0], upright, atol=0.01)
    np.testing.assert_allclose(read[1:2][0], upright, atol=0.01)
    assert any("orientation" in note for note in read.notes)


def test_what_is_no_photograph_is_left_out(tmp_path: Path) -> None:
    folders.write_folder(tmp_path, PAIR, WHOLE)
    for name in ("Normal_gt.png", "normal.png", "depth.tif", "mask_old.png", ".hidden.png"):
        folders.write(tmp_path / name, RAMP[:5], 16)
    (tmp_path / "notes.txt").write_text("hello")
    read = photos.load(tmp_path)
    assert read.files == ("1.png", "2.png")
    assert "Normal_gt.png" in " ".join(read.notes)


def test_lists_and_names_decide(tmp_path: Path) -> None:
    folders.write_folder(tmp_path, np.stack([RAMP] * 5), WHOLE)
    (tmp_path / "names.txt").write_text("3.png\n1.png\n")
    assert photos.load(tmp_path).files == ("3.png", "1.png")
    assert photos.load(tmp_path, names=["5.png", "[12].png"]).files == ("5.png", "1.png", "2.png")
    assert photos.load(tmp_path, names=["!4.png"]).files == ("1.png", "2.png", "3.png", "5.png")
    with pytest.raises(InputError, match=r"no picture '9\*' in it"):
        photos.load(tmp_path, names=["9*"])
    (tmp_path / "names.txt").write_text("3.png\n7.png\n")
    with pytest.raises(InputError, match=r"names 7.png, which is not there"):
        photos.load(tmp_path)


def test_the_mask_of_pictures_that_are_cut_out(tmp_path: Path) -> None:
    """What is opaque in all of them; not where one has no transparency, or they disagree."""
    mask = np.zeros(WHOLE.shape, bool)
    mask[3:9, 4:15] = True

    def cut(number: int, opaque: np.ndarray) -> None:
        rgba = np.dstack([PAIR[number % 2], opaque])
        cv2.imwrite(str(tmp_path / f"{number}.png"), np.rint(rgba * 255).astype(np.uint8))

    for number in range(3):
        cut(number, mask)
    read = photos.load(tmp_path)
    assert read.mask_origin == "file"
    np.testing.assert_array_equal(read.mask, mask)
    assert "the mask is what is opaque in the pictures; a mask.png replaces it" in read.notes
    folders.write(tmp_path / "mask.png", WHOLE)
    assert photos.load(tmp_path).mask.all()
    (tmp_path / "mask.png").unlink()
    for other in (WHOLE, np.roll(mask, 3, axis=1)):
        cut(1, other)
        assert photos.load(tmp_path).mask_origin == "automatic"


def test_masks_of_all_sorts(tmp_path: Path) -> None:
    mask = np.zeros(WHOLE.shape)
    mask[3:9, 4:15] = 1
    folders.write_folder(tmp_path, PAIR, mask)
    read = photos.load(tmp_path)
    assert read.mask_origin == "file"
    np.testing.assert_array_equal(read.mask, mask > 0)
    cutout = np.dstack([RAMP, mask])
    cv2.imwrite(str(tmp_path / "mask.png"), np.rint(cutout * 255).astype(np.uint8))
    np.testing.assert_array_equal(photos.load(tmp_path).mask, mask > 0)  # transparency counts, not colour
    other = tmp_path / "other" / "object.tif"
    folders.write(other, 1 - mask, 16)
    np.testing.assert_array_equal(photos.load(tmp_path, mask=other).mask, mask == 0)


def test_exr_values_are_kept_and_the_broken_outside_the_mask_are_dark(tmp_path: Path) -> None:
    bright = PAIR * 5 - 0.01
    bright[1, 0, 0] = np.nan
    mask = WHOLE.copy()
    mask[:2] = 0
    folders.write_folder(tmp_path, bright, mask, suffix=".exr")
    read = photos.load(tmp_path)
    images = read[0:2]
    assert np.isfinite(images).all()
    assert images.min() == 0
    np.testing.assert_allclose(images[0], np.maximum(bright[0], 0), rtol=1e-5)
    assert "not finite" in " ".join(read.notes)


def test_exr_of_half_floats_and_layers(tmp_path: Path) -> None:
    half = np.ascontiguousarray(RAMP.astype(np.float16))
    OpenEXR.File({}, {"RGBA": np.ascontiguousarray(np.dstack([half, half[..., 0]]))}).write(str(tmp_path / "1.exr"))
    OpenEXR.File({}, {"RGBA": np.ascontiguousarray(np.dstack([half, half[..., 0]]))}).write(str(tmp_path / "2.exr"))
    folders.write(tmp_path / "mask.png", WHOLE)
    read = photos.load(tmp_path)
    assert read.bits == 16
    np.testing.assert_allclose(read[0:1][0], RAMP, atol=1e-3)
    for number in (1, 2):
        OpenEXR.File({}, {"Z": np.ascontiguousarray(half[..., 0])}).write(str(tmp_path / f"{number}.exr"))
    with pytest.raises(InputError, match=r"wants channels R, G, B, has Z"):
        photos.load(tmp_path)


def refusal(folder: Path, **options: object) -> str:
    """Return the one line a folder is refused with."""
    with pytest.raises(InputError) as error:
        photos.load(folder, **options)
    assert "\n" not in str(error.value)
    return str(error.value)


@pytest.fixture
def good(tmp_path: Path) -> Path:
    """Return a folder of five good pictures and a mask."""
    return folders.write_folder(tmp_path / "good", np.stack([RAMP * (1 - 0.1 * k) for k in range(5)]), WHOLE)


def test_folders_without_enough_pictures(tmp_path: Path) -> None:
    assert "no such folder" in refusal(tmp_path / "nowhere")
    assert "no pictures in it; put PNG" in refusal(tmp_path)
    (tmp_path / "a.x3f").touch()
    assert "1 .x3f, which are not read" in refusal(tmp_path)
    folders.write(tmp_path / "1.png", RAMP)
    assert "only one picture, 1.png" in refusal(tmp_path)


@pytest.mark.parametrize("suffix", [".png", ".jpg", ".tif", ".exr"])
@pytest.mark.parametrize("part", [0.0, 0.6, 0.97])
def test_damaged_and_truncated_files_are_named(tmp_path: Path, suffix: str, part: float) -> None:
    rng = np.random.default_rng(0)
    folders.write_folder(tmp_path, rng.random((4, 40, 50, 3)), np.ones((40, 50)), suffix=suffix, bits=8)
    path = tmp_path / f"3{suffix}"
    data = path.read_bytes()
    path.write_bytes(data[: int(part * len(data))] if part else b"this is no picture")
    assert re.search(rf"3{suffix}: damaged", refusal(tmp_path))


def test_truncated_tiff_with_its_directory_in_front(tmp_path: Path) -> None:
    for number in (1, 2):
        tifffile.imwrite(tmp_path / f"{number}.tif", (RAMP * 65535).astype(np.uint16), photometric="rgb")
    (tmp_path / "2.tif").write_bytes((tmp_path / "2.tif").read_bytes()[:-300])
    assert "2.tif: damaged" in refusal(tmp_path)


def test_pictures_that_do_not_fit_together(good: Path) -> None:
    folders.write(good / "4.png", RAMP[:-1], 16)
    message = refusal(good)
    assert "4.png: is 20x13 pixels, the other 4 (as 1.png) are 20x14" in message
    folders.write(good / "4.png", RAMP, 8)
    assert "4.png: is 8-bit PNG, the other 4 (as 1.png) are 16-bit PNG" in refusal(good)


def test_bad_masks(good: Path) -> None:
    folders.write(good / "mask.png", WHOLE[:, :-1])
    assert "the mask is 19x14 pixels, the pictures are 20x14" in refusal(good)
    folders.write(good / "mask.png", WHOLE * 0)
    assert "the mask is empty" in refusal(good)
    assert "no such picture" in refusal(good, mask=good / "none.png")
    folders.write(good / "mask.tif", WHOLE)
    assert "several masks (mask.png, mask.tif)" in refusal(good)


def test_values_that_are_not_finite_in_the_mask(tmp_path: Path) -> None:
    broken = PAIR.copy()
    broken[1, 5, 5, 1] = np.inf
    folders.write_folder(tmp_path, broken, WHOLE, suffix=".exr")
    assert "2.exr: NaN or infinite values inside the mask (1 pixels" in refusal(tmp_path)


def test_pictures_that_never_change_have_no_automatic_mask(good: Path) -> None:
    (good / "mask.png").unlink()
    for number in range(1, 6):
        folders.write(good / f"{number}.png", RAMP, 16)
    assert "nothing changes between the pictures" in refusal(good)
    read = photos.load(good, anyway=True)
    assert read.mask.all() and "nothing changes" in " ".join(read.overridden)


def test_what_stops_can_be_overridden_and_is_then_an_error_found(tmp_path: Path) -> None:
    broken = PAIR.copy()
    broken[1, 5, 5, 1] = np.inf
    folders.write_folder(tmp_path, broken, WHOLE, suffix=".exr")
    (tmp_path / "lights.txt").write_text("0 0 1\n0 1 -.1\n")
    asked = {"lights": tmp_path / "lights.txt"}
    assert refusal(tmp_path, **asked).endswith("(--anyway goes on all the same)")
    read = photos.load(tmp_path, **asked, anyway=True)
    assert ["NaN" in read.overridden[0], "behind the object" in read.overridden[1]] == [True, True]
    assert read[1:2][0, 5, 5, 1] == 0 and read.light_directions[1, 2] < 0
    assert [f.text for f in photos.check(read) if f.level == "error"][:2] == list(read.overridden)


def test_a_file_that_changes_while_in_use(good: Path) -> None:
    read = photos.load(good)
    folders.write(good / "2.png", RAMP[:5], 16)
    with pytest.raises(InputError, match="changed while it was in use"):
        read[0:3]
    shutil.rmtree(good)
    with pytest.raises(InputError, match="no such picture"):
        read[0:1]
