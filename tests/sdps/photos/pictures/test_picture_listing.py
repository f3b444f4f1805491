"""Which files of a folder are its photographs: names, lists, folders in the folder."""

from pathlib import Path

import pytest

from render.shared.errors import InputError
from sdps.photos.pictures.listing import Listing, list_pictures

SHOTS = tuple(f"p{number}.png" for number in range(1, 5))


def fill(folder: Path, *names: str, listed: list[str] | None = None, at: str = "filenames.txt") -> Path:
    for name in names:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).touch()
    if listed is not None:
        (folder / at).write_text("\n".join(listed))
    return folder


def told(listing: Listing) -> str:
    return " | ".join(listing.notes)


def test_masks_results_and_ambient_pictures_are_named_and_left_out(tmp_path: Path) -> None:
    found = list_pictures(fill(tmp_path, *SHOTS, "x_mask.png", "x_normal_result.png", "x_ambient.png", "IMG.CR2"))
    assert (found.files, found.masks) == (SHOTS, ("x_mask.png",))
    assert "x_normal_result.png (a result by name)" in told(found)
    assert found.ambient == ("x_ambient.png",) and "ambient" not in told(found)
    assert not list_pictures(tmp_path, ["!*ambient*"]).ambient
    assert "left out: 1 .cr2" in told(found)


def test_the_plain_mask_comes_first_and_a_dark_frame_is_looked_at(tmp_path: Path) -> None:
    found = list_pictures(fill(tmp_path, *SHOTS, "a_mask.png", "mask.png", "dark.png"))
    assert found.masks[0] == "mask.png"
    assert found.dark == ("dark.png",) and "dark.png" in found.files


def test_what_is_named_in_full_is_used_and_said(tmp_path: Path) -> None:
    fill(tmp_path, *SHOTS, "x_mask.png", "mask_a.png")
    found = list_pictures(tmp_path, ["p1.png", "x_mask.png"])
    assert found.files == ("p1.png", "x_mask.png") and found.certain == {"p1.png", "x_mask.png"}
    assert "x_mask.png is a mask by its name; it is used as a photograph because it was named" in told(found)
    assert list_pictures(tmp_path, ["*.png"]).files == SHOTS
    assert list_pictures(tmp_path, ["*mask*"]).files == ("mask_a.png", "x_mask.png")  # nothing else is meant
    assert "because it was named" in told(list_pictures(tmp_path, ["*mask*"]))


def test_a_list_decides_and_what_it_names_is_said(tmp_path: Path) -> None:
    found = list_pictures(fill(tmp_path, *SHOTS, "x_mask.png", listed=["p3.png", "x_mask.png", "p1.png"]))
    assert found.files == ("p3.png", "x_mask.png", "p1.png") and not found.masks
    assert "x_mask.png is a mask by its name" in told(found) and "not in it: p2.png, p4.png" in told(found)


@pytest.mark.parametrize(
    "name", ["{}", "images/{}", "images\\{}", "C:\\data\\cat\\{}", "/home/me/cat/images/{}", "../{}"]
)
def test_a_list_beside_the_folder_of_pictures(tmp_path: Path, name: str) -> None:
    fill(
        tmp_path, *(f"images/{shot}" for shot in SHOTS), "mask.png", listed=[name.format(shot) for shot in SHOTS[::-1]]
    )
    found = list_pictures(tmp_path)
    assert found.files == tuple(f"images/{shot}" for shot in SHOTS[::-1])
    assert found.places == (tmp_path, tmp_path / "images") and found.masks == ("mask.png",)
    assert "its folder images" in told(found)


def test_a_list_with_other_letters_or_without_suffixes(tmp_path: Path) -> None:
    assert list_pictures(fill(tmp_path, *SHOTS, listed=["P2.PNG", "p1"])).files == ("p2.png", "p1.png")
    (tmp_path / "filenames.txt").write_text("p1.png\nP1.PNG\n")
    with pytest.raises(InputError, match=r"names p1.png twice"):
        list_pictures(tmp_path)


def test_a_list_names_nothing_outside_its_folder(tmp_path: Path) -> None:
    fill(tmp_path, "secret.png", *(f"photos/{shot}" for shot in SHOTS))
    for name in ("../secret.png", str(tmp_path / "secret.png")):
        (tmp_path / "photos" / "names.txt").write_text(f"p1.png\n{name}\n")
        with pytest.raises(InputError, match=r"names .*secret.png, which is not there"):
            list_pictures(tmp_path / "photos")


def test_pictures_in_the_only_folder(tmp_path: Path) -> None:
    fill(tmp_path, *(f"images/{shot}" for shot in SHOTS), "mask.png", "found/normal.png", "found/mask.png", "a/one.png")
    found = list_pictures(tmp_path)
    assert found.files == tuple(f"images/{shot}" for shot in SHOTS)
    assert found.masks == ("mask.png",) and "the pictures are those of its folder images" in told(found)
    assert list_pictures(tmp_path, ["p[12].png"]).files == ("images/p1.png", "images/p2.png")
    (tmp_path / "images" / "filenames.txt").write_text("p2.png\np1.png\n")
    assert list_pictures(tmp_path).files == ("images/p2.png", "images/p1.png")
    fill(tmp_path, *(f"more/{shot}" for shot in SHOTS))
    with pytest.raises(InputError, match=r"but in its folders images, more; give one of these"):
        list_pictures(tmp_path)


def test_photographs_of_the_folder_itself_come_first(tmp_path: Path) -> None:
    assert list_pictures(fill(tmp_path, *SHOTS, "more/1.png", "more/2.png")).files == SHOTS


def test_what_is_left_out_is_in_the_refusal(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"only one picture, p1.png; .*left out: a_normal.png \(normals by name\)"):
        list_pictures(fill(tmp_path, "p1.png", "a_normal.png"))
