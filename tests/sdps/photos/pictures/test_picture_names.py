"""What the names of pictures say: words by themselves, and not those that most of a folder's names share."""

import pytest

from sdps.photos.pictures.picture_names import AMBIENT, DARK, MASK, NORMALS, name_roles, split_words

SHOTS = [f"p{number:02}.png" for number in range(1, 9)]


@pytest.mark.parametrize(
    ("name", "role"),
    [
        ("x.mask.png", MASK), ("sample_mask.png", MASK), ("Mask-001.png", MASK), ("MASK.PNG", MASK),
        ("catMask.tga", MASK),
        ("mask2.png", MASK), ("IMGMask.png", MASK), ("masks.png", MASK), ("cat silhouette.png", MASK),
        ("normal_mask.png", MASK), ("normal_map.png", NORMALS), ("NormalMap.png", NORMALS),
        ("Normal_gt.png", "a result"),
        ("x_normal_result.png", "a result"), ("cat.normals.exr", NORMALS), ("cat_normal.png", NORMALS),
        ("cat_depth.png", "depth"), ("heightMap.tif", "depth"), ("catAlbedo01.png", "albedo"),
        ("baseColor.png", "albedo"),
        ("base_color.png", "albedo"), ("roughness.png", "a map of the material"), ("ambient.png", AMBIENT),
        ("sample_ambient.png", AMBIENT), ("lights_off.png", AMBIENT), ("no-flash.jpg", AMBIENT), ("dark.png", DARK),
    ],
)  # fmt: skip
def test_words_say_what_a_picture_is(name: str, role: str) -> None:
    assert name_roles([*SHOTS, name]) == {name: role}


@pytest.mark.parametrize(
    "name",
    ["normandy.png", "unmasked01.png", "masked_001.png", "maskito.png", "damask.png", "no_mask.png", "unmask.png",
     "without-mask_1.png", "abnormal.png", "depths_of_field"[:4] + "n.png", "darkness.png", "DSC_0001.JPG", "01.png"],
)  # fmt: skip
def test_parts_of_words_say_nothing(name: str) -> None:
    assert name_roles([*SHOTS, name]) == {}


def test_a_word_that_most_names_share_is_the_objects() -> None:
    african = [f"african_mask_{number}.jpg" for number in range(12)]
    assert name_roles(african) == {}
    assert name_roles([*african, "mask.png", "african_mask_normal.png"]) == {
        "mask.png": MASK, "african_mask_normal.png": NORMALS,
    }  # fmt: skip
    assert name_roles([f"normal_{number}.png" for number in range(5)]) == {}


def test_one_mask_for_each_photograph_is_not_most() -> None:
    masks = [f"{number}_mask.png" for number in range(5)]
    assert name_roles([*(f"{number}.png" for number in range(5)), *masks, "mask.png"]) == dict.fromkeys(
        [*masks, "mask.png"], MASK
    )


def test_words() -> None:
    assert split_words("x.normalMap-01_B.png") == ["x", "normal", "map", "b"]
    assert split_words("IMGMask_Größe2.tif") == ["img", "mask", "größe"]
