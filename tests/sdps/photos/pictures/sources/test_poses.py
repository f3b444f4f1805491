"""Folders as tools lay them out, archives and films: which poses they hold, and that each reads as a folder would."""

import gc
import zipfile
from pathlib import Path

import cv2
import numpy as np
import photo_folders as folders
import pytest

from render.shared.errors import InputError
from sdps import photos
from sdps.photos.pictures.sources import archive_files, film_frames
from sdps.photos.pictures.sources.archive_files import clean_place
from sdps.photos.pictures.sources.poses import find_poses

LIGHTS = np.array([[0.6, 0.0, 0.8], [0.0, 0.6, 0.8], [-0.6, 0.0, 0.8], [0.0, -0.6, 0.8], [0.0, 0.0, 1.0]])
IMAGES, MASK = folders.matte(LIGHTS, size=32)
H, W = MASK.shape


def write_pose(folder: Path, names: str = "IMG_{}.png") -> Path:
    for number, image in enumerate(IMAGES):
        folders.write(folder / names.format(number), image)
    return folder


def pack(archive: Path, folder: Path, root: str = "") -> Path:
    with zipfile.ZipFile(archive, "w", zipfile.ZIP_DEFLATED) as opened:
        for path in sorted(folder.rglob("*")):
            if path.is_file():
                opened.write(path, f"{root}{path.relative_to(folder)}")
    return archive


@pytest.fixture
def meshroom(tmp_path: Path) -> Path:
    """Three poses of Meshroom; of one the mask lies beside, grey in a part."""
    for name in ("ps_b10", "ps_b9", "ps_front"):
        write_pose(tmp_path / "rig" / name)
        folders.write(tmp_path / "rig" / name / "ambient.png", 0.02 * np.ones_like(IMAGES[0]))
    grey = MASK.astype(np.float32)
    grey[: H // 2] *= 0.6
    folders.write(tmp_path / "rig" / "front.png", grey)
    return tmp_path / "rig"


def test_the_poses_of_meshroom(meshroom: Path) -> None:
    found = find_poses(meshroom)
    assert [pose.name for pose in found] == ["b9", "b10", "front"]
    assert [pose.mask for pose in found] == [None, None, meshroom / "front.png"]
    read = photos.load(found[2])
    assert len(read) == 5 and read.mask_origin == "file"
    np.testing.assert_array_equal(read.mask, MASK & (np.arange(H) >= H // 2)[:, None])  # 0.6 is not white there
    assert any("front.png beside ps_front" in note for note in read.notes)
    alone = photos.load(meshroom / "ps_front")
    np.testing.assert_array_equal(alone.mask, read.mask)
    with pytest.raises(InputError, match=r"rig: holds 3 poses \(ps_b9, ps_b10, ps_front\); give one of these"):
        photos.load(meshroom)


def test_lights_are_shared_by_the_poses_that_they_name(meshroom: Path) -> None:
    """One file above the poses, with rows of each pose: their pictures have the same names."""
    rows = [(name, number, LIGHTS[(number + turn) % 5])
            for turn, name in enumerate(("ps_b9", "ps_b10", "ps_front")) for number in range(5)]  # fmt: skip
    text = "".join(f"D:\\rig\\{name}\\IMG_{number}.png {x} {y} {z}\n" for name, number, (x, y, z) in rows)
    (meshroom / "lights.lp").write_text(f"15\n{text}")
    for turn, pose in enumerate(find_poses(meshroom)):
        read = photos.load(pose, lights="folder")
        np.testing.assert_allclose(read.light_directions, np.roll(LIGHTS, -turn, axis=0), atol=1e-6)
    (meshroom / "lights.lp").write_text("".join(f"IMG_{k}.png {x} {y} {z}\n" for k, (x, y, z) in enumerate(LIGHTS)))
    for pose in find_poses(meshroom):
        np.testing.assert_allclose(photos.load(pose, lights="folder").light_directions, LIGHTS, atol=1e-6)


def test_folders_of_the_unips_family(tmp_path: Path) -> None:
    write_pose(tmp_path / "all" / "cat.data", "L_{}.png")
    folders.write(tmp_path / "all" / "cat.data" / "mask.png", MASK.astype(np.float32))
    folders.write(tmp_path / "all" / "cat.data" / "N.png", IMAGES[0])
    folders.write(tmp_path / "all" / "cat.data" / "normal.png", IMAGES[0])
    for place in ("all", "all/cat.data"):
        (pose,) = find_poses(tmp_path / place)
        read = photos.load(tmp_path / place)
        assert pose.name == "cat" and read.files == tuple(f"L_{k}.png" for k in range(5))
        np.testing.assert_array_equal(read.mask, MASK)
    write_pose(tmp_path / "all" / "dog.data", "L{}.png")
    assert [pose.name for pose in find_poses(tmp_path / "all")] == ["cat", "dog"]
    assert len(photos.load(find_poses(tmp_path / "all")[1])) == 5


def test_a_folder_with_photographs_of_its_own_is_no_parent(tmp_path: Path) -> None:
    write_pose(tmp_path)
    write_pose(tmp_path / "ps_old", "old_{}.png")
    assert photos.load(tmp_path).files == tuple(f"IMG_{k}.png" for k in range(5))


def test_the_mask_of_a_pose_from_transparency(tmp_path: Path) -> None:
    """A picture with transparency, named as the pose: what is opaque is the object."""
    write_pose(tmp_path / "ps_cup")
    cut = np.dstack([np.full((H, W, 3), 90, np.uint8), 255 * MASK.astype(np.uint8)])
    cv2.imwrite(str(tmp_path / "cup.png"), cut)
    np.testing.assert_array_equal(photos.load(tmp_path).mask, MASK)


# ---- Archives ----


def test_a_zip_reads_as_its_folder(tmp_path: Path) -> None:
    folder = write_pose(tmp_path / "cup", "sub#1/Bild {}.png")
    folders.write(folder / "sub#1" / "mask.png", MASK.astype(np.float32))
    (folder / "lights.txt").write_text("".join(f"Bild {k}.png {x} {y} {z}\n" for k, (x, y, z) in enumerate(LIGHTS)))
    (folder / "notes.doc").write_bytes(b"of no use")
    for root in ("", "cup/"):
        read = photos.load(pack(tmp_path / "cup.zip", folder, root), lights="folder")
        plain = photos.load(folder, lights="folder")
        np.testing.assert_array_equal(read[:], plain[:])
        np.testing.assert_array_equal(read.light_directions, plain.light_directions)
        assert read.notes == plain.notes and read.files == plain.files and read.mask_origin == "file"
        room = read.room.path
        assert room.is_dir() and not list(room.rglob("notes.doc"))
        del read
        gc.collect()
        assert not room.exists()


def test_a_zip_of_several_poses(meshroom: Path, tmp_path: Path) -> None:
    found = find_poses(pack(tmp_path / "rig.zip", meshroom, "rig/"))
    assert [pose.name for pose in found] == ["b9", "b10", "front"]
    np.testing.assert_array_equal(photos.load(found[2]).mask, photos.load(meshroom / "ps_front").mask)


@pytest.mark.parametrize("name", ["../evil.png", "/etc/evil.png", "C:\\evil.png", "a/../../evil.png", "..\\evil.png"])
def test_nothing_of_a_zip_lies_outside(tmp_path: Path, name: str) -> None:
    place = clean_place(name)
    assert place is not None and not place.is_absolute() and not {"..", "."} & set(place.parts)
    assert place.name == "evil.png" and not any(letter in str(place) for letter in "\\:")
    assert clean_place("__MACOSX/._a.png") is None and clean_place("a/.b/c.png") is None


def test_zips_that_cannot_be_used_have_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    archive = tmp_path / "cup.zip"
    archive.write_bytes(b"PK\3\4nothing")
    with pytest.raises(InputError, match=r"cup.zip: cannot be unpacked .* make the ZIP again") as caught:
        photos.load(archive)
    assert str(caught.value).startswith(str(archive))
    write_pose(tmp_path / "cup")
    (tmp_path / "cup" / "IMG_4.png").write_bytes(b"nothing")
    pack(archive, tmp_path / "cup")
    with pytest.raises(InputError, match=f"^{archive}/IMG_4.png: damaged"):  # as if it were a folder
        photos.load(archive)
    monkeypatch.setattr(archive_files, "largest_unpacked", lambda path: 5000)
    with pytest.raises(InputError, match=f"^{archive}: is too large unpacked"):
        photos.load(archive)
    (tmp_path / "cup.doc").write_bytes(b"")
    with pytest.raises(InputError, match=r"cup.doc: is a file; give the folder"):
        photos.load(tmp_path / "cup.doc")


# ---- Films ----


def write_film(path: Path, frames: list[np.ndarray]) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"MJPG"), 25, (W, H))
    for frame in frames:
        writer.write(np.rint(255 * folders.to_srgb(np.clip(frame, 0, 1))).astype(np.uint8)[..., ::-1])
    writer.release()
    return path


def lamp_goes_round(count: int) -> tuple[np.ndarray, list[np.ndarray]]:
    """Return directions (count, 3) and frames of a painted object."""
    around = 2 * np.pi * np.arange(count) / count
    lights = np.stack([0.6 * np.cos(around), 0.6 * np.sin(around), np.full(count, 0.8)], axis=1)
    return lights, list(folders.matte(lights, paint=True, size=32)[0])


def test_a_film_is_its_frames(tmp_path: Path) -> None:
    _, frames = lamp_goes_round(24)
    film = write_film(tmp_path / "lamp.avi", frames)
    folders.write(tmp_path / "mask.png", MASK.astype(np.float32))
    for place in (film, tmp_path):  # a folder with nothing but a film
        read = photos.load(place, every=4)
        assert read.files == tuple(f"frame-{number:04d}.png" for number in range(0, 24, 4))
        assert (read.bits, read.gamma, read.mask_origin) == (8, "srgb", "file")
        assert "lamp.avi has 24 frames; one of every 4 frames was looked at, and 6 are the photographs" in read.notes
        grey, wanted = read[:].mean(-1)[:, MASK], np.stack(frames[::4]).mean(-1)[:, MASK]  # films blur colours
        assert np.corrcoef(grey.ravel(), wanted.ravel())[0, 1] > 0.99 and abs(grey.mean() / wanted.mean() - 1) < 0.05
    assert len(photos.load(film)) == 24  # fewer than 60
    read = photos.load(pack(tmp_path.parent / f"{tmp_path.name}.zip", tmp_path, "a/"), every=8)
    assert len(read) == 3 and read.mask_origin == "file"
    write_film(tmp_path / "other.avi", frames)
    with pytest.raises(InputError, match=r"holds 2 films \(lamp.avi, other.avi\); name one"):
        photos.load(tmp_path)


def test_frames_that_are_blurred_or_repeated_are_left_out(tmp_path: Path) -> None:
    _, frames = lamp_goes_round(20)
    frames[5] = cv2.GaussianBlur(frames[5], (0, 0), 2.5)
    frames[8:8] = [frames[7]] * 2  # the lamp rests
    read = photos.load(write_film(tmp_path / "lamp.avi", frames))
    assert "left out of the film's frames: 8, 9 (as the one before), 5 (blurred)" in read.notes
    assert len(read) == 19


def test_films_that_cannot_be_used_have_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    _, frames = lamp_goes_round(8)
    film = write_film(tmp_path / "lamp.avi", frames)
    still = write_film(tmp_path / "still.avi", frames[:1] * 8)
    broken = tmp_path / "broken.mp4"
    broken.write_bytes(b"\0\0\0\x20ftypisom" + bytes(200))
    for place, every, said in (
        (still, None, "still.avi: only 1 of its 8 frames is sharp and not as the one before; the lamp must move"),
        (broken, None, "broken.mp4: damaged or not a film that can be decoded; convert it to an MP4"),
        (film, 0, "--every 0: must be at least 1"), (write_pose(tmp_path / "cup"), 2, "--every 2: .*cup is no film"),
        (tmp_path / "no.mp4", None, "no.mp4: no such film"),
    ):  # fmt: skip
        with pytest.raises(InputError, match=said) as caught:
            photos.load(place, every=every)
        assert "\n" not in str(caught.value) and "/sdps-" not in str(caught.value)
    monkeypatch.setattr(film_frames, "MOST", 5)
    with pytest.raises(InputError, match="--every 1 takes 8 frames, more than 5; give a larger number"):
        photos.load(film, every=1)
