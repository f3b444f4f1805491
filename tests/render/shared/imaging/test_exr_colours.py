"""OpenEXR files of many programs: layers, parts, windows and greys; each read as the picture that it shows."""

import sys
from pathlib import Path

import numpy as np
import OpenEXR
import pytest

from render.shared.errors import InputError
from render.shared.imaging import environments
from render.shared.imaging.exr_colours import read_exr_colours

RNG = np.random.default_rng(0)
PICTURE = RNG.random((6, 8, 4)).astype(np.float32)
OTHER = RNG.random((6, 8, 4)).astype(np.float32)


def layer(name: str, pixels: np.ndarray = PICTURE, letters: str = "RGBA") -> dict[str, np.ndarray]:
    """Return single channels, as a renderer names them."""
    before = f"{name}." if name else ""
    return {f"{before}{letter}": np.ascontiguousarray(pixels[..., k]) for k, letter in enumerate(letters)}


def write(path: Path, channels: dict[str, np.ndarray], **header: object) -> Path:
    OpenEXR.File(header, channels).write(str(path))
    return path


def window(left: int, top: int, width: int, height: int) -> tuple[np.ndarray, np.ndarray]:
    return np.array([left, top], np.int32), np.array([left + width - 1, top + height - 1], np.int32)


@pytest.mark.parametrize(
    ("channels", "chosen"),
    [
        (layer("ViewLayer.Combined") | {"ViewLayer.Depth.Z": OTHER[..., 0]}, "ViewLayer.Combined"),
        (layer("image", letters="RGB"), "image"),
        (layer("A.DiffCol", OTHER) | layer("ViewLayer.Combined"), "ViewLayer.Combined"),
        (layer("albedo", OTHER) | layer("beauty"), "beauty"),
        (layer("") | layer("Combined", OTHER), ""),
        (layer("CryptoObject00", OTHER) | layer("Pass"), "Pass"),
        (layer("normals", OTHER, "RGB") | layer("out", letters="RGB"), "out"),
        (layer("", letters="rgb"), ""),
        ({"red": PICTURE[..., 0], "green": PICTURE[..., 1], "blue": PICTURE[..., 2]}, ""),
        (layer("", letters="RGB") | {"Z": OTHER[..., 0], "normal.X": OTHER[..., 1]}, ""),
        ({"Y": OTHER[..., 0]} | layer("light", letters="RGB"), "light"),
    ],
)
def test_the_right_layer_is_found(tmp_path: Path, channels: dict[str, np.ndarray], chosen: str) -> None:
    found = read_exr_colours(write(tmp_path / "a.exr", {name: np.ascontiguousarray(c) for name, c in channels.items()}))
    np.testing.assert_array_equal(found.pixels, PICTURE[..., :3])
    assert found.layer == chosen
    if len(channels) > 3 and f"{chosen}.A".lstrip(".") in channels:
        np.testing.assert_array_equal(found.alpha, PICTURE[..., 3])


@pytest.mark.parametrize("name", ["Y", "layer.Y", "V", "R"])
def test_one_channel_is_grey(tmp_path: Path, name: str) -> None:
    found = read_exr_colours(write(tmp_path / "a.exr", {name: np.ascontiguousarray(PICTURE[..., 0])}))
    np.testing.assert_array_equal(found.pixels[..., 0], PICTURE[..., 0])
    assert found.pixels.shape[2] == 1


def test_types_may_differ_between_channels(tmp_path: Path) -> None:
    channels = layer("", letters="RGB")
    channels["G"] = channels["G"].astype(np.float16)
    found = read_exr_colours(write(tmp_path / "a.exr", channels))
    np.testing.assert_allclose(found.pixels, PICTURE[..., :3], atol=1e-3)


def test_the_right_part_of_several_is_found(tmp_path: Path) -> None:
    depth = OpenEXR.Part({}, {"Z": np.ascontiguousarray(OTHER[..., 0])}, "depth")
    normal = OpenEXR.Part({}, layer("", OTHER, "RGB"), "normal")
    colour = OpenEXR.Part({}, layer("", letters="RGB"), "beauty")
    first = OpenEXR.Part({}, layer("", OTHER, "RGB"), "specular")
    for parts in ([depth, colour], [normal, colour], [first, colour], [depth, normal, first, colour]):
        OpenEXR.File(parts).write(str(tmp_path / "a.exr"))
        found = read_exr_colours(tmp_path / "a.exr")
        np.testing.assert_array_equal(found.pixels, PICTURE[..., :3])
        assert found.layer == "beauty"


@pytest.mark.parametrize(("left", "top"), [(2, 3), (0, 0), (-3, -2), (7, 5), (-3, 5)])
def test_the_data_window_is_placed_in_the_display_window(tmp_path: Path, left: int, top: int) -> None:
    path = write(tmp_path / "a.exr", layer(""), dataWindow=window(left, top, 8, 6), displayWindow=window(0, 0, 12, 10))
    found = read_exr_colours(path)
    whole = np.zeros((30, 30, 4), np.float32)
    whole[10 + top : 16 + top, 10 + left : 18 + left] = PICTURE
    np.testing.assert_array_equal(found.pixels, whole[10:20, 10:22, :3])
    np.testing.assert_array_equal(found.alpha, whole[10:20, 10:22, 3])


def test_a_display_window_may_begin_anywhere_and_be_smaller(tmp_path: Path) -> None:
    path = write(tmp_path / "a.exr", layer(""), dataWindow=window(100, 50, 8, 6), displayWindow=window(102, 51, 4, 3))
    np.testing.assert_array_equal(read_exr_colours(path).pixels, PICTURE[1:4, 2:6, :3])


def test_what_holds_no_light_is_refused(tmp_path: Path) -> None:
    normals = layer("N", letters="XYZ") | {"ViewLayer.Depth.Z": np.ascontiguousarray(OTHER[..., 0])}
    with pytest.raises(InputError, match=r"wants channels R, G, B, has N.X, N.Y, N.Z, ViewLayer.Depth.Z"):
        read_exr_colours(write(tmp_path / "a.exr", normals))
    with pytest.raises(InputError, match=r"wants channels R, G, B, has depth.Y"):
        read_exr_colours(write(tmp_path / "a.exr", {"depth.Y": np.ascontiguousarray(OTHER[..., 0])}))
    path = write(tmp_path / "b.exr", layer(""), displayWindow=window(0, 0, 60_000, 60_000))
    with pytest.raises(InputError, match="header announces"):
        read_exr_colours(path)


def test_a_damaged_part_is_not_passed_over_and_nothing_is_printed(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    noise = np.round(8 * RNG.random((64, 64, 3))).astype(np.float32)  # compressible, so that damage shows
    parts = [OpenEXR.Part({}, layer("", noise, "RGB"), "beauty"), OpenEXR.Part({}, layer("", noise, "RGB"), "other")]
    OpenEXR.File(parts).write(str(tmp_path / "a.exr"))
    data = bytearray((tmp_path / "a.exr").read_bytes())
    data[2000:2400] = bytes(400)
    (tmp_path / "a.exr").write_bytes(data)
    with pytest.raises(InputError, match=r"only 1 of its 2 parts can be read"):
        read_exr_colours(tmp_path / "a.exr")
    sys.stdout.write("after\n")  # the streams are back
    assert capfd.readouterr() == ("after\n", "")


def test_environment_maps_are_found_in_layers_and_windows(tmp_path: Path) -> None:
    light = RNG.random((8, 16, 3)).astype(np.float32)
    path = write(tmp_path / "map.exr", layer("ViewLayer.Combined", light, "RGB"))
    np.testing.assert_array_equal(environments.load(str(path)), light)
    path = write(
        tmp_path / "crop.exr", layer("", light[2:6], "RGB"),
        dataWindow=window(0, 2, 16, 4), displayWindow=window(0, 0, 16, 8),
    )  # fmt: skip
    np.testing.assert_array_equal(environments.load(str(path))[2:6], light[2:6])
