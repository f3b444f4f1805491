"""Flat things: their mean plane faces the camera, slow bends go on request, and refinement sees them."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import photo_folders as folders
import pytest

import sdps
from lab.studies.flat_study import KINDS, Flat, photograph
from pipelines.cli import main
from render.shared.errors import InputError
from render.shared.imaging.vectors import unit
from sdps.core.estimate import Estimate
from sdps.core.integration import integrate
from sdps.core.metrics import direction_mae, normal_mae
from sdps.inference.inference_config import InferenceConfig
from sdps.methods.flat_things import (
    Flatness,
    deepen,
    face_camera,
    find_depth,
    flatten,
    is_flat,
    turn_inside_out,
)
from sdps.refinement.trust import _find_blindness

SIDE = 96
WHOLE = np.ones((SIDE, SIDE), bool)


@pytest.fixture(scope="module")
def coin() -> Flat:
    return photograph("coin", SIDE, 8)


def bend(normals: np.ndarray, more: np.ndarray) -> np.ndarray:
    """Return normals whose slopes n_x / n_z and n_y / n_z are larger by (H, W, 2)."""
    slopes = normals[..., :2] / normals[..., 2:] + more
    return unit(np.concatenate([slopes, np.ones_like(slopes[..., :1])], axis=-1)).astype(np.float32)


@pytest.mark.parametrize("kind", KINDS)
def test_flat_things_are_told_from_others(kind: str) -> None:
    normals = photograph(kind, SIDE, 3).normals
    assert is_flat(WHOLE, bend(normals, np.array([0.2, -0.1])))
    disc = np.hypot(*np.mgrid[-1 : 1 : SIDE * 1j, -1 : 1 : SIDE * 1j]) < 0.9
    assert not is_flat(disc, normals)
    y, x = np.mgrid[-1 : 1 : SIDE * 1j, -1 : 1 : SIDE * 1j]
    dome = np.stack([0.6 * x, -0.6 * y, np.sqrt(1.0 - 0.36 * (x**2 + y**2))], axis=-1)
    assert not is_flat(WHOLE, dome.astype(np.float32))


def test_a_tilt_is_taken_off_and_every_picture_stays(coin: Flat) -> None:
    tilted = Estimate(bend(coin.normals, np.array([0.15, -0.1])), coin.lights, coin.gains)
    level = face_camera(tilted, WHOLE, lit=False)
    assert level.tilt == pytest.approx(np.degrees(np.arctan(np.hypot(0.15, 0.1))), abs=0.1)
    assert normal_mae(tilted.normals, coin.normals, WHOLE) > 8.0
    assert normal_mae(level.normals, coin.normals, WHOLE) < 0.01
    # Albedo times n_z is one unknown of each pixel; what it is multiplied with must be as before.
    before, after = (
        (found.normals / found.normals[..., 2:]) @ (found.light_directions * found.intensities[:, None]).T
        for found in (tilted, level)
    )
    np.testing.assert_allclose(after, before, atol=1e-5)
    given = face_camera(tilted, WHOLE, lit=True)
    np.testing.assert_array_equal(given.light_directions, coin.lights)
    np.testing.assert_array_equal(given.normals, level.normals)
    coloured = replace(tilted, intensities=np.repeat(coin.gains[:, None], 3, axis=1))
    np.testing.assert_allclose(face_camera(coloured, WHOLE, lit=False).intensities[:, 1], level.intensities)


def test_a_bowl_is_flattened_away(coin: Flat) -> None:
    y, x = np.mgrid[1 : -1 : SIDE * 1j, -1 : 1 : SIDE * 1j]
    bowl = bend(coin.normals, 0.3 * np.stack([x, y], axis=-1))
    assert normal_mae(bowl, coin.normals, WHOLE) > 10.0
    flat = flatten(bowl, WHOLE, 1.0)
    assert flat.dtype == np.float32 and normal_mae(flat, coin.normals, WHOLE) < 3.0
    rim = np.ones_like(WHOLE)
    rim[10:-10, 10:-10] = False
    heights = [integrate(normals, WHOLE).z for normals in (bowl, flat)]
    bent, left = (abs(height[rim].mean() - height[~rim].mean()) for height in heights)
    assert left < 0.2 * bent
    # A smaller share takes more of the thing itself.
    assert normal_mae(flatten(bowl, WHOLE, 0.1), coin.normals, WHOLE) > normal_mae(flat, coin.normals, WHOLE)
    hole = WHOLE.copy()
    hole[20:40, 20:40] = False
    assert not flatten(bowl * hole[..., None], hole)[~hole].any()


def test_known_intensities_tell_the_depth(coin: Flat) -> None:
    true = Estimate(coin.normals, coin.lights, coin.gains)
    deep = deepen(true, WHOLE, 1.4)
    assert normal_mae(deep.normals, coin.normals, WHOLE) > 2.0 and direction_mae(deep.light_directions, coin.lights) > 5
    assert find_depth(deep, coin.gains) == pytest.approx(1 / 1.4, rel=0.02)
    assert find_depth(true, coin.gains) == pytest.approx(1.0, rel=0.02)
    tilted = replace(deep, normals=bend(deep.normals, np.array([0.02, 0.0])), tilt=1.0)
    found = Flatness("yes").finish(tilted, WHOLE, np.repeat(coin.gains[:, None], 3, axis=1), lit=False)
    assert normal_mae(found.normals, coin.normals, WHOLE) < 0.5 and found.tilt == 1.0
    left = Flatness("yes").finish(tilted, WHOLE, coin.gains, lit=True)
    assert normal_mae(left.normals, deep.normals, WHOLE) < 0.01
    ring = unit(np.stack([np.cos(np.arange(8.0)), np.sin(np.arange(8.0)), np.ones(8)], axis=1)).astype(np.float32)
    assert find_depth(deepen(replace(true, light_directions=ring), WHOLE, 1.4), coin.gains) == pytest.approx(1.0)


def test_hollow_is_turned(coin: Flat) -> None:
    hollow = turn_inside_out(Estimate(coin.normals, coin.lights, coin.gains))
    found = Flatness("turned").begin(hollow, WHOLE, lit=False)
    assert normal_mae(found.normals, coin.normals, WHOLE) < 0.01
    assert direction_mae(found.light_directions, coin.lights) < 0.1
    with pytest.raises(InputError, match="--flat turned: lights that are given"):
        Flatness("turned").begin(hollow, WHOLE, lit=True)


def test_wishes_that_make_no_sense() -> None:
    with pytest.raises(InputError, match="unknown --flat 'yess'; did you mean 'yes'"):
        Flatness("yess")  # type: ignore[arg-type]
    for share in (-0.1, 1.1, float("nan")):
        with pytest.raises(InputError, match=r"--flatten .*above 0 and at most 1"):
            Flatness("yes", share)
    with pytest.raises(InputError, match="leave out --flat no"):
        Flatness("no", 0.25)
    assert Flatness("auto", 0.25).asked and not Flatness().asked
    facing = np.broadcast_to(np.array([0.0, 0.0, 1.0]), (SIDE, SIDE, 3))
    assert Flatness().applies(WHOLE, facing, lit=False) and not Flatness().applies(WHOLE, facing, lit=True)


def test_refinement_sees_flat_things_whose_plane_is_known(coin: Flat) -> None:
    shallow = unit(coin.normals * (0.1, 0.1, 1.0))
    assert "flat" in _find_blindness(WHOLE, shallow, coin.lights)
    assert not _find_blindness(WHOLE, shallow, coin.lights, tilted=False)


def test_photographs_of_flat_things(tmp_path: Path) -> None:
    made = photograph("weave", SIDE, 8)
    folder = folders.write_folder(tmp_path, 0.6 * made.images / made.images.max(), None)
    photos = sdps.load(folder, whole_frame=True)
    assert photos.mask.all() and photos.mask_origin == "whole frame"
    errors, tilts, once = {}, {}, InferenceConfig(light_views=1, normal_views=1)
    for wish in ("no", "auto"):
        result = sdps.infer(photos, "sdps-frames", config=once, refine=False, flat=wish)
        errors[wish], tilts[wish] = normal_mae(result.normals, made.normals, WHOLE), result.estimate.tilt
        said = [finding.text for finding in result.findings if "mean plane" in finding.text]
        assert bool(said) == (wish != "no")
    assert errors["auto"] < errors["no"] and tilts["no"] is None
    slopes = result.normals[..., :2] / result.normals[..., 2:]
    np.testing.assert_allclose(slopes.mean(axis=(0, 1)), 0.0, atol=1e-3)
    assert result.summary()["flat"] == {"tilt_degrees": round(tilts["auto"], 2)}


def test_the_folder_may_follow_the_flag(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    images = 0.6 * photograph("coin", 64, 6).images
    folder = str(folders.write_folder(tmp_path, images / images.max()))
    assert main(["infer", "--method", "factorisation", "--dry-run", "--flat", folder]) == 0
    said = capsys.readouterr().out
    assert "the whole frame is the object" in said and "draw a mask.png" not in said
    assert main(["infer", "--dry-run", "--flatten", folder]) == 2
    assert "name the folder before --flatten" in capsys.readouterr().err
    assert main(["infer", folder, "--dry-run", "--flat", "no", "--flatten", "0.3"]) == 2
    assert "leave out --flat no" in capsys.readouterr().err
