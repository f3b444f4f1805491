"""The automatic mask and the findings, on analytic scenes with noise: silent on good ones, plain on bad ones."""

from pathlib import Path

import classical_scenes as scenes
import numpy as np
import photo_folders as folders
import pytest
from PIL import Image

from sdps import photos
from sdps.photos.analysis.motion import Tracker, second_look
from sdps.photos.checks import Finding
from sdps.photos.masks import Variation, automatic_mask
from sdps.photos.measures import measure_spread

RING = np.arange(12) * 2 * np.pi * 5 / 12
AROUND = np.stack([0.8 * np.cos(RING), 0.8 * np.sin(RING), np.full(12, 0.6)], axis=-1)
OPPOSITE = np.where(np.arange(12)[:, None] % 2, AROUND[np.arange(12) // 2 * 2] * [-1, -1, 1], AROUND)
OPPOSITE[:, :2] *= np.sin(np.radians(70)) / 0.8
OPPOSITE[:, 2] = np.cos(np.radians(70))


def cone(degrees: float, tilt: float = 0.0) -> np.ndarray:
    """Return 12 lights within a cone, its axis `tilt` degrees to the right of the camera."""
    rng = np.random.default_rng(4)
    z, angle = rng.uniform(np.cos(np.radians(degrees)), 1, 12), rng.uniform(0, 2 * np.pi, 12)
    lights = np.stack([np.sqrt(1 - z**2) * np.cos(angle), np.sqrt(1 - z**2) * np.sin(angle), z], axis=-1)
    sine, cosine = np.sin(np.radians(tilt)), np.cos(np.radians(tilt))
    return lights @ np.array([[cosine, 0, -sine], [0, 1, 0], [sine, 0, cosine]])


def findings(folder: Path, images: np.ndarray, mask: np.ndarray | None, **options: object) -> list[Finding]:
    """Write, load and check a folder."""
    kinds = {"suffix": options.pop("suffix", ".png"), "bits": options.pop("bits", 16)}
    return photos.check(photos.load(folders.write_folder(folder, images, mask, **kinds), **options))


def said(found: list[Finding], word: str) -> list[Finding]:
    return [finding for finding in found if word in finding.text]


def serious(found: list[Finding]) -> list[str]:
    return [finding.text for finding in found if finding.level != "note"]


@pytest.mark.parametrize("shape", ["sphere", "hills"])
@pytest.mark.parametrize("paint", [False, True])
def test_good_photographs_pass_and_their_mask_is_found(tmp_path: Path, shape: str, paint: bool) -> None:
    images, mask = folders.matte(AROUND, shape=shape, paint=paint, size=128)
    assert serious(findings(tmp_path, images, None)) == []
    found = photos.load(tmp_path)
    assert found.mask_origin == "automatic"
    assert (found.mask & mask).sum() / (found.mask | mask).sum() > 0.95


def test_the_mask_ignores_a_bright_background_that_does_not_change(tmp_path: Path) -> None:
    images, mask = folders.matte(AROUND)
    images[:, ~mask] += 0.5
    found = photos.load(folders.write_folder(tmp_path, images)).mask
    assert (found & mask).sum() / (found | mask).sum() > 0.93


def test_a_background_that_is_lit_as_well_is_admitted(tmp_path: Path) -> None:
    images, mask = folders.matte(AROUND)
    wall = np.linspace(0.05, 1.0, len(images))[:, None, None]
    images[:, ~mask] = wall
    read = photos.load(folders.write_folder(tmp_path, np.clip(images, 0, 1)))
    assert read.mask.all() and read.mask_origin == "automatic"
    assert "whole frame is taken for the object" in " ".join(read.notes)
    assert said(photos.check(read), "whole frame")[0].level == "warning"


def test_an_object_that_fills_the_frame_is_not_cut(tmp_path: Path) -> None:
    normals, _ = scenes.hills(160)
    part = (slice(40, 120), slice(40, 120))
    albedo = scenes.patches(np.ones((80, 80), bool), 12, np.random.default_rng(0))
    images = scenes.lambertian(normals[part], np.ones((80, 80), bool), AROUND, albedo=albedo).images
    assert photos.load(folders.write_folder(tmp_path, images)).mask.all()


def test_nothing_lit_has_no_mask() -> None:
    variation = Variation((20, 20))
    for _ in range(4):
        variation.add(np.full((20, 20), 0.3, np.float32))
    assert not variation.changes().any()
    mask, said = automatic_mask(variation)
    assert mask.all() and "nothing changes" in said


def test_variation_is_the_standard_deviation() -> None:
    images = np.random.default_rng(0).random((50, 6, 7)).astype(np.float32)
    variation = Variation((6, 7))
    for image in images:
        variation.add(image)
    np.testing.assert_allclose(variation.deviation(), images.std(0), rtol=1e-4)


def test_too_few_pictures(tmp_path: Path) -> None:
    images, mask = folders.matte(AROUND)
    assert said(findings(tmp_path / "2", images[:2], mask), "Only 2 pictures")[0].level == "error"
    assert said(findings(tmp_path / "7", images[:7], mask), "Only 7 pictures")[0].level == "warning"
    assert not said(findings(tmp_path / "8", images[:8], mask), "Only")


@pytest.mark.parametrize("bits", [8, 16])
def test_saturated_and_black_pictures_are_named(tmp_path: Path, bits: int) -> None:
    images, mask = folders.matte(AROUND)
    images[3] = np.clip(images[3] * 2.5, 0, 1)
    images[5] *= 0.0005
    found = findings(tmp_path, images, mask, bits=bits, gamma="linear")
    assert said(found, "Overexposed")[0].images == ("4.png",)
    assert said(found, "black")[0].images == ("6.png",)
    assert [finding.level for finding in found] == sorted(
        (finding.level for finding in found), key=("error", "warning", "note").index
    )


@pytest.mark.parametrize("suffix", [".exr", ".png"])
def test_values_cut_off_below_full_scale(tmp_path: Path, suffix: str) -> None:
    """EXR files made of 8-bit ones, and RAW developed with the white level too low, look in range."""
    images, mask = folders.matte(AROUND)
    assert not said(findings(tmp_path / "good", images * 0.9, mask, suffix=suffix), "Clipped")
    found = said(findings(tmp_path / "cut", np.minimum(1.5 * images, 0.8), mask, suffix=suffix), "Clipped")
    assert found[0].level == "warning" and len(found[0].images) >= 3


def test_a_computed_flat_object_is_not_clipped(tmp_path: Path) -> None:
    flat = np.tile(0.7 * AROUND[:, 2, None, None, None], (1, 40, 40, 3)).astype(np.float32)
    flat[:, :, :20] *= 0.4
    assert not said(findings(tmp_path, flat, np.ones((40, 40), bool), suffix=".exr"), "Clipped")


def test_dark_and_black_folders(tmp_path: Path) -> None:
    images, mask = folders.matte(AROUND)
    assert said(findings(tmp_path / "dim", images * 0.04, mask), "very dark")
    assert said(findings(tmp_path / "darker", images * 0.004, mask), "black in most")[0].level == "warning"
    (only,) = said(findings(tmp_path / "black", images * 0.0005, mask), "black")
    assert only.level == "error" and "every picture" in only.text
    assert said(findings(tmp_path / "nothing", images * 0, mask, suffix=".exr"), "black in every")[0].level == "error"
    assert not serious(findings(tmp_path / "exr", images * 0.004, mask, suffix=".exr"))  # has no full scale


def test_a_mirror_is_no_error_and_a_lamp_that_was_off_is_still_named(tmp_path: Path) -> None:
    images, mask = folders.matte(AROUND, shape="sphere", size=128)
    normals, inside = scenes.sphere(128)
    half = AROUND + np.array([0, 0, 1])
    half /= np.linalg.norm(half, axis=1, keepdims=True)
    images[:] = 0
    for image, direction in zip(images, half, strict=True):
        image[mask] = (normals[inside] @ direction > np.cos(np.radians(4)))[:, None]  # nothing but the lamp's picture
    images[5] = 0
    found = findings(tmp_path, images, mask)
    assert not [finding.text for finding in found if finding.level == "error"]
    assert said(found, "black in most pictures")[0].level == "warning"
    assert said(found, "Was the lamp off")[0].images == ("6.png",)


def test_a_flat_object_is_no_error_but_one_light_is(tmp_path: Path) -> None:
    level = np.cos(np.radians(np.linspace(5, 60, 12)))[:, None, None, None]
    noise = np.random.default_rng(0).normal(0, folders.NOISE, (12, 60, 60, 3))
    flat = np.clip(0.8 * level + noise, 0, 1).astype(np.float32)
    mask = np.ones((60, 60), bool)
    (only,) = said(findings(tmp_path / "flat", flat, mask), "hardly changes")
    assert only.level == "warning" and "flat object" in only.text
    (only,) = said(findings(tmp_path / "lamp", np.clip(0.6 + noise, 0, 1), mask), "hardly changes")
    assert only.level == "error"


@pytest.mark.parametrize("lights", [AROUND, OPPOSITE], ids=["around", "opposite"])
@pytest.mark.parametrize("shape", ["sphere", "hills"])
@pytest.mark.parametrize("paint", [False, True])
def test_movement_is_told_from_moving_light(lights: np.ndarray, shape: str, paint: bool) -> None:
    images, mask = folders.matte(lights, shape=shape, paint=paint, size=160)
    grey = images.mean(-1)

    def shifts(series: np.ndarray) -> list[float]:
        tracker = Tracker(mask)
        first = [tracker.add(image) for image in series]
        return [shift.length for shift in second_look(tracker, first, lambda number: series[number])]

    assert shifts(grey) == [0.0] * len(grey)
    for start in (1, 8, 11):
        bumped = grey.copy()
        bumped[start:] = np.roll(bumped[start:], (4, -3), (1, 2))
        moved = np.array(shifts(bumped))
        alone = moved[:start] if start == 1 else moved[start:]
        np.testing.assert_allclose(alone, 5.0, atol=1.5)
        assert np.count_nonzero(moved) == len(alone)


def on_the_ground(paint: bool) -> tuple[np.ndarray, np.ndarray]:
    """Return images of a sphere with a sharp shadow on grey ground, away from the light, and the mask."""
    images, mask = folders.matte(AROUND, shape="sphere", size=128, paint=paint)
    rows, columns = np.indices(mask.shape) - mask.shape[0] / 2
    for image, light in zip(images, AROUND, strict=True):
        shadow = (columns + 40 * light[0]) ** 2 + (rows - 40 * light[1]) ** 2 < 50**2
        image[~mask] = np.where(shadow, 0.02, 0.25)[~mask][:, None]
    return images, mask


def test_cast_shadows_on_the_ground_are_no_movement(tmp_path: Path) -> None:
    images, mask = on_the_ground(paint=True)
    assert not said(findings(tmp_path / "still", images, mask), "moved")
    images[7:] = np.roll(images[7:], (5, 4), (1, 2))
    found = said(findings(tmp_path / "bumped", images, mask), "moved")
    assert found[0].images == tuple(f"{number}.png" for number in range(8, 13))


def test_shadows_on_the_ground_alone_are_no_movement(tmp_path: Path) -> None:
    found = findings(tmp_path, *on_the_ground(paint=False))  # no edge of the plain sphere stays in its place
    assert not said(found, "moved") and not said(found, "edges")


def test_a_camera_held_in_the_hand(tmp_path: Path) -> None:
    images, mask = folders.matte(np.tile(AROUND, (2, 1)), paint=True)
    steps = np.random.default_rng(2).integers(-7, 8, (len(images), 2))
    images = np.stack([np.roll(image, step, (0, 1)) for image, step in zip(images, steps, strict=True)])
    assert said(findings(tmp_path, images, mask), "held in the hand")


@pytest.mark.parametrize("tilt", [0, 40])
def test_similar_and_frontal_lights(tmp_path: Path, tilt: float) -> None:
    def found(degrees: float, given: bool = False) -> list[Finding]:
        lights = cone(degrees, tilt)
        images, mask = folders.matte(lights)
        folder = tmp_path / f"{degrees}{given}"
        folder.mkdir()
        np.savetxt(folder / "lights.txt", lights)
        return findings(folder, images, mask, lights=folder / "lights.txt" if given else None)

    assert said(found(0.5), "hardly changes")[0].level == "error"
    assert said(found(8), "differ little")[0].level == "warning"
    assert not said(found(25), "differ little") and not said(found(25, True), "within 15 degrees")
    assert said(found(10, True), "within 15 degrees")


def test_the_spread_of_singular_values() -> None:
    for degrees in (10, 20, 40):
        images, mask = folders.matte(cone(degrees))
        values = measure_spread(images.mean(-1)[:, mask])
        assert 0.05 < values[1] / (degrees / 10) < 0.11
        assert values[2] > 0.4 * values[1]


def test_lights_along_a_line(tmp_path: Path) -> None:
    angle = np.radians(np.linspace(-45, 45, 12))
    lights = np.stack([np.sin(angle), 0 * angle, np.cos(angle)], axis=-1)
    images, mask = folders.matte(lights)
    tmp_path.joinpath("lights.txt").write_text("\n".join(" ".join(map(str, row)) for row in lights))
    found = findings(tmp_path, images, mask, lights=tmp_path / "lights.txt")
    assert said(found, "along a line")
    assert said(found, "lie in one plane")


def test_lights_of_one_side(tmp_path: Path) -> None:
    lights = AROUND[AROUND[:, 1] > 0.1]
    images, mask = folders.matte(lights)
    photos.write_lights(tmp_path / "l.json", [f"{number}.png" for number in range(1, len(lights) + 1)], lights)
    assert said(findings(tmp_path, images, mask, lights=tmp_path / "l.json"), "one side")[0].level == "note"


def test_duplicates(tmp_path: Path) -> None:
    images, mask = folders.matte(AROUND)
    images[9] = images[2]
    assert said(findings(tmp_path, images, mask), "twice")[0].images == ("3.png", "10.png")


def test_colour_casts(tmp_path: Path) -> None:
    images, mask = folders.matte(AROUND)
    images[4] *= [1.0, 0.9, 0.7]
    assert said(findings(tmp_path, images, mask), "colour changes")[0].images == ("5.png",)
    strengths = np.ones((12, 3))
    strengths[4] = [1.0, 0.9, 0.7]
    photos.write_lights(tmp_path / "l.json", [f"{number}.png" for number in range(1, 13)], AROUND, strengths)
    assert not said(photos.check(photos.load(tmp_path, lights=tmp_path / "l.json")), "colour changes")


def test_what_the_camera_changed(tmp_path: Path) -> None:
    images, mask = folders.matte(AROUND)
    coded = np.rint(folders.to_srgb(images) * 255).astype(np.uint8)
    for number, image in enumerate(coded):
        exif = Image.Exif()
        exif.get_ifd(0x8769).update({33434: 0.01 if number < 8 else 0.02, 34855: 100, 37386: 50.0 if number else 35.0})
        Image.fromarray(image).save(tmp_path / f"{number}.jpg", exif=exif, quality=95)
    folders.write(tmp_path / "mask.png", mask.astype(float))
    found = photos.check(photos.load(tmp_path))
    assert said(found, "exposure time")[0].level == "note"
    assert said(found, "focal length")[0].level == "warning"
    assert not said(found, "ISO")
    Image.fromarray(coded[5]).save(tmp_path / "5.jpg", quality=95)  # without a header: the others tell all the same
    found = photos.check(photos.load(tmp_path))
    assert said(found, "exposure time") and said(found, "focal length") and not said(found, "ISO")


def test_suspicious_gamma(tmp_path: Path) -> None:
    images, mask = folders.matte(AROUND)
    assert said(findings(tmp_path / "jpeg", images, mask, suffix=".jpg", bits=8, gamma="linear"), "JPEG")
    assert said(findings(tmp_path / "exr", images, mask, suffix=".exr", gamma="srgb"), "mostly linear")
    assert said(findings(tmp_path / "deep", images, mask, gamma="srgb"), "mostly linear")[0].level == "note"
    assert not said(findings(tmp_path / "good", images, mask, suffix=".jpg", bits=8), "linear")


def test_masks_that_look_wrong(tmp_path: Path) -> None:
    images, mask = folders.matte(AROUND)
    assert said(findings(tmp_path / "inverted", images, ~mask), "inverted")
    small = np.zeros_like(mask)
    small[60:80, 60:90] = True
    assert said(findings(tmp_path / "small", images, small), "600 pixels only")
    assert not serious(findings(tmp_path / "whole", images, np.ones_like(mask)))
