"""The frame of environment maps, their solid angles, and what is refused."""

import cv2
import numpy as np
import pytest

from render.records.shards import write_exr
from render.shared.errors import InputError
from render.shared.imaging import environments


def test_a_single_bright_pixel_lies_where_the_page_says():
    """Middle column +z, a quarter from the left +x, edges -z, top row +y (OpenEXR's ImfEnvmap.h)."""
    vectors = environments.directions(180)
    half = 0.5 * np.pi / 180  # pixel centres are half a pixel off the axes
    for row, column, axis in ((90, 180, (0, 0, 1)), (90, 90, (1, 0, 0)), (90, 270, (-1, 0, 0)), (90, 0, (0, 0, -1)),
                              (0, 10, (0, 1, 0)), (179, 200, (0, -1, 0))):  # fmt: skip
        assert np.arccos(vectors[row, column] @ axis) < 2 * half, (row, column)
    np.testing.assert_allclose(np.linalg.norm(vectors, axis=-1), 1, atol=1e-12)
    assert vectors[80, 200, 1] > 0 > vectors[80, 200, 0]  # above the middle and right of it: up, and -x


def test_pixels_divide_the_sphere():
    areas = environments.solid_angles(64) * np.ones((64, 128))
    assert areas.sum() == pytest.approx(4 * np.pi, rel=1e-12)
    vectors = environments.directions(64)
    assert np.abs((vectors * areas[..., None]).sum((0, 1))).max() < 1e-9
    facing = np.maximum(vectors[..., 2], 0) * areas
    assert facing.sum() == pytest.approx(np.pi, rel=1e-3)


def test_turning_moves_the_camera_side_to_the_right_hand():
    radiance = np.zeros((36, 72, 3), np.float32)
    radiance[10, 36] = 1.0  # near +z
    vectors = environments.directions(36)
    there = vectors[environments.turn(radiance, 90.0)[..., 0] > 0][0]
    before = vectors[10, 36]
    np.testing.assert_allclose(there, [before[2], before[1], -before[0]], atol=1e-9)


@pytest.mark.parametrize("kind", environments.BUILT_IN)
def test_built_in_maps_give_white_facing_the_camera_one(kind):
    facing = np.maximum(environments.directions(64)[..., 2:], 0) * environments.solid_angles(64)[..., None]
    for seed in range(5):
        radiance = environments.load(f"{kind}:{seed}")
        assert radiance.shape == (64, 128, 3) and radiance.dtype == np.float32 and radiance.min() >= 0
        assert (radiance * facing).sum((0, 1)).mean() == pytest.approx(np.pi, rel=1e-3)
        np.testing.assert_array_equal(radiance, environments.load(f"{kind}:{seed}"))
    if kind != "constant":
        assert not np.array_equal(environments.load(f"{kind}:0"), environments.load(f"{kind}:1"))


def test_files_are_read_as_they_are(tmp_path):
    radiance = np.random.default_rng(0).uniform(0.1, 4.0, (8, 16, 3)).astype(np.float32)
    write_exr(tmp_path / "a.exr", [("map", {}, {"RGB": radiance})])
    np.testing.assert_array_equal(environments.load(str(tmp_path / "a.exr")), radiance)
    cv2.imwrite(str(tmp_path / "a.hdr"), np.ascontiguousarray(radiance[..., ::-1]))
    np.testing.assert_allclose(environments.load(str(tmp_path / "a.hdr")), radiance, rtol=0.02, atol=0.02)
    large = np.ones((600, 1200, 3), np.float32)
    write_exr(tmp_path / "b.exr", [("map", {}, {"RGB": large})])
    assert environments.load(str(tmp_path / "b.exr")).shape == (256, 512, 3)


def test_what_is_no_map_is_refused_in_one_line(tmp_path):
    good = np.ones((8, 16, 3), np.float32)

    def refused(name: str, words: str) -> None:
        with pytest.raises(InputError, match=words) as caught:
            environments.load(str(tmp_path / name))
        assert "\n" not in str(caught.value)

    write_exr(tmp_path / "square.exr", [("map", {}, {"RGB": np.ones((8, 8, 3), np.float32)})])
    refused("square.exr", "twice as wide as high")
    for value, name in ((np.nan, "nan.hdr"), (-1.0, "negative.exr")):
        bad = good.copy()
        bad[2, 3, 1] = value
        if name.endswith("exr"):
            write_exr(tmp_path / name, [("map", {}, {"RGB": bad})])
            refused(name, "column 3, row 2")
    write_exr(tmp_path / "black.exr", [("map", {}, {"RGB": 0 * good})])
    refused("black.exr", "is black")
    write_exr(tmp_path / "grey.exr", [("map", {}, {"Y": good[..., 0]})])
    refused("grey.exr", "needs R, G and B")
    (tmp_path / "text.hdr").write_text("no picture")
    refused("text.hdr", "not a Radiance picture")
    (tmp_path / "text.exr").write_text("no picture")
    refused("text.exr", "not an EXR picture")
    refused("missing.hdr", "no such environment map")
    with pytest.raises(InputError, match="did you mean 'studio'"):
        environments.load("studi")
    with pytest.raises(InputError, match="unknown environment"):
        environments.load("studio:x")
    bad = good.copy()
    bad[2, 3, 1] = np.nan
    with pytest.raises(InputError, match="NaN, infinite or negative at column 3, row 2"):
        environments._check(bad, "map.hdr")
