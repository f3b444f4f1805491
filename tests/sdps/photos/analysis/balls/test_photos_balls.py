"""Lights from chrome and white balls: traced pictures whose lamps are known, and the real sphere."""

import zipfile
from pathlib import Path

import numpy as np
import pytest
from ball_scenes import FOCAL, GAINS, LIGHTS, OBJECT, SHAPE, flag, hit, paint, write

from render.shared.errors import InputError
from sdps.core.geometry import Camera, Capture
from sdps.photos import load
from sdps.photos.analysis.balls.ball_flags import measure_balls, read_balls
from sdps.photos.analysis.balls.ball_spheres import Circle, Sphere
from sdps.photos.picture_file import decode

DATA = "shared/data/uw_psm_photos.zip"
REAL = next((place / DATA for place in Path(__file__).resolve().parents if (place / DATA).is_file()), Path(DATA))


def angles(found, true):
    true = true / np.linalg.norm(true, axis=1, keepdims=True)
    return np.degrees(np.arccos(np.clip((found * true).sum(1), -1.0, 1.0)))


@pytest.mark.parametrize("focal", [np.inf, FOCAL])
@pytest.mark.parametrize("found", [False, True])
def test_a_chrome_ball_gives_directions(tmp_path, focal, found):
    ball = (85.0, 40.0, 30.0)
    write(tmp_path / "in", [paint(lamp, gain, focal, chrome=[ball]) for lamp, gain in zip(LIGHTS, GAINS, strict=True)])
    camera = "orthographic" if focal == np.inf else f"{focal}px"
    photos = load(tmp_path / "in", balls="auto" if found else flag(ball, focal), focal=camera)
    assert [one.kind for one in photos.balls] == ["chrome"] and photos.balls[0].found == found
    assert angles(photos.light_directions, LIGHTS).max() < 1.0
    assert photos.intensities is None and photos.light_nearness is None
    assert not photos.mask[30:70, 190:230].any() and photos.mask[90, 85]
    sphere = Sphere.of(photos.balls[0].circle, photos.camera, photos.shape)
    np.testing.assert_allclose([sphere.x, sphere.y, sphere.radius], ball, atol=0.5)


@pytest.mark.parametrize("said", ["auto", "flag"])
def test_a_white_ball_gives_directions_and_intensities(tmp_path, said):
    ball = (85.0, 40.0, 30.0)
    images = [paint(lamp, gain, white=[ball]) for lamp, gain in zip(LIGHTS, GAINS, strict=True)]
    mask = hit(OBJECT, np.inf)[3]
    photos = load(write(tmp_path / "in", images, mask), balls=flag(ball) if said == "flag" else said)
    assert [one.kind for one in photos.balls] == ["white"]
    assert angles(photos.light_directions, LIGHTS).max() < 1.0
    np.testing.assert_allclose(photos.intensities / photos.intensities.mean(), GAINS / GAINS.mean(), rtol=0.01)


@pytest.mark.parametrize("focal", [np.inf, FOCAL])
def test_two_balls_give_positions(tmp_path, focal):
    balls = [(85.0, 45.0, 28.0), (85.0, -45.0, 30.0)]
    lamps = 300.0 * LIGHTS + [OBJECT[0], 0.0, 0.0]
    images = [paint(lamp, 1.0, focal, chrome=balls) for lamp in lamps]
    camera = "orthographic" if focal == np.inf else f"{focal}px"
    photos = load(write(tmp_path / "in", images), balls=[flag(ball, focal) for ball in balls], focal=camera)
    capture = Capture.of(photos.mask, photos.camera)
    off = lamps - capture.centre
    assert angles(photos.light_directions, off).max() < 1.0
    np.testing.assert_allclose(capture.radius / photos.light_nearness, np.linalg.norm(off, axis=1), rtol=0.05)
    near = load(tmp_path / "in", balls=flag(balls[0], focal), focal=camera, light_distance=f"{300.0}px")
    assert angles(near.light_directions, off).max() < 1.5  # one ball, and how far the lamps are


def test_balls_at_different_depths_give_positions(tmp_path):
    """Two balls of one size, one in front of the object's middle and one behind it."""
    balls = [(85.0, 45.0, 29.0, 60.0), (85.0, -45.0, 29.0, -60.0)]
    lamps = 300.0 * LIGHTS + [OBJECT[0], 0.0, 0.0]
    images = [paint(lamp, 1.0, FOCAL, chrome=balls) for lamp in lamps]
    said = [flag(ball, FOCAL) for ball in balls]
    photos = load(write(tmp_path / "in", images, hit(OBJECT, FOCAL)[3]), balls=said, focal=f"{FOCAL}px")
    capture = Capture.of(photos.mask, photos.camera)
    off = lamps - capture.centre
    assert angles(photos.light_directions, off).max() < 1.0
    np.testing.assert_allclose(capture.radius / photos.light_nearness, np.linalg.norm(off, axis=1), rtol=0.05)
    assert any("of one size, 0.88" in note for note in photos.notes)


@pytest.mark.parametrize("depth", [0.0, 60.0])
def test_white_balls_are_corrected_for_near_lamps(tmp_path, depth):
    """Lambert's law for distant lamps turns directions by 4 degrees here."""
    balls = [(85.0, 45.0, 29.0, depth), (85.0, -45.0, 29.0, -depth)]
    lamps = 300.0 * LIGHTS + [OBJECT[0], 0.0, 0.0]
    images = [paint(lamp, 0.8 * gain, FOCAL, white=balls) for lamp, gain in zip(lamps, GAINS, strict=True)]
    folder = write(tmp_path / "in", images, hit(OBJECT, FOCAL)[3])
    photos = load(folder, balls=[f"white:{flag(ball, FOCAL)}" for ball in balls], focal=f"{FOCAL}px")
    off = lamps - Capture.of(photos.mask, photos.camera).centre
    assert angles(photos.light_directions, off).mean() < 0.6
    np.testing.assert_allclose(photos.intensities / photos.intensities.mean(), GAINS / GAINS.mean(), rtol=0.04)
    if not depth:
        said = f"white:{flag(balls[0], FOCAL)}"
        one = load(folder, balls=said, focal=f"{FOCAL}px", light_distance="300px")
        assert angles(one.light_directions, off).mean() < 1.0


@pytest.mark.parametrize("size", [24.0, 36.0])
def test_balls_of_different_sizes_at_one_depth_stay_there(tmp_path, size):
    balls = [(85.0, 45.0, 29.0), (85.0, -45.0, size)]
    lamps = 300.0 * LIGHTS + [OBJECT[0], 0.0, 0.0]
    images = [paint(lamp, 1.0, FOCAL, chrome=balls) for lamp in lamps]
    photos = load(write(tmp_path / "in", images), balls=[flag(ball, FOCAL) for ball in balls], focal=f"{FOCAL}px")
    capture = Capture.of(photos.mask, photos.camera)
    off = lamps - capture.centre
    assert angles(photos.light_directions, off).mean() < 1.0
    np.testing.assert_allclose(capture.radius / photos.light_nearness, np.linalg.norm(off, axis=1), rtol=0.08)


@pytest.mark.parametrize("sizes", [(29.0, 29.0), (22.0, 34.0)])
def test_known_radii_tell_depths_and_millimetres(tmp_path, sizes):
    """Balls of any sizes, one in front of the object's middle and one behind it; a pixel is 0.4 mm."""
    balls = [(85.0, 45.0, sizes[0], 60.0), (85.0, -45.0, sizes[1], -60.0)]
    lamps = 300.0 * LIGHTS + [OBJECT[0], 0.0, 0.0]
    images = [paint(lamp, 1.0, FOCAL, chrome=balls) for lamp in lamps]
    said = [flag(ball, FOCAL) for ball in balls]
    radius = ",".join(str(0.4 * size) for size in sizes)
    photos = load(
        write(tmp_path / "in", images, hit(OBJECT, FOCAL)[3]), balls=said, focal=f"{FOCAL}px", ball_radius=radius
    )
    capture = Capture.of(photos.mask, photos.camera)
    off = lamps - capture.centre
    assert angles(photos.light_directions, off).max() < 1.0
    np.testing.assert_allclose(capture.radius / photos.light_nearness, np.linalg.norm(off, axis=1), rtol=0.05)
    assert photos.pixel_size == pytest.approx(0.4, rel=0.02)
    assert any(
        "by their radii the balls stand 0.88" in note and " mm) from its middle" in note for note in photos.notes
    )
    assert [ball.tell(photos.files)["radius_mm"] for ball in photos.balls] == [0.4 * size for size in sizes]


def test_a_known_radius_tells_the_depth_of_one_ball_and_the_scale(tmp_path):
    """A ball well in front of the object, lamps whose distance is known: it is taken for the object's depth, but for
    its radius.
    """
    ball = (60.0, 40.0, 24.0, 110.0)
    lamps = 300.0 * LIGHTS + [OBJECT[0], 0.0, 0.0]
    images = [paint(lamp, 1.0, FOCAL, chrome=[ball]) for lamp in lamps]
    folder = write(tmp_path / "in", images, hit(OBJECT, FOCAL)[3])
    known = {"balls": flag(ball, FOCAL), "focal": f"{FOCAL}px"}
    level = load(folder, **known, light_distance="120mm", ball_radius=0.4 * 24.0 * FOCAL / (FOCAL - 110.0))
    photos = load(folder, **known, light_distance="120mm", ball_radius=0.4 * 24.0, pixel_size=0.4)
    off = lamps - Capture.of(photos.mask, photos.camera).centre
    assert level.pixel_size == pytest.approx(0.4, rel=0.02)  # a ball of that size at the object's depth looks alike
    assert angles(photos.light_directions, off).mean() < 0.5 * angles(level.light_directions, off).mean()
    assert angles(photos.light_directions, off).max() < 1.5
    assert any("by their radii the ball stands 0.79 times as far" in note for note in photos.notes)


def test_an_orthographic_camera_has_the_scale_of_a_ball(tmp_path):
    balls = [(85.0, 45.0, 28.0), (85.0, -45.0, 20.0)]
    folder = write(tmp_path / "in", [paint(lamp, 1.0, chrome=balls) for lamp in 300.0 * LIGHTS])
    said = {"balls": [flag(ball) for ball in balls], "focal": "orthographic"}
    photos = load(folder, **said, ball_radius="14,10")
    assert photos.pixel_size == pytest.approx(0.5, rel=0.02)
    doubtful = load(folder, **said, ball_radius=14.0)
    assert any("by the balls' radii a pixel is 0." in note for note in doubtful.notes)


@pytest.mark.parametrize(
    ("said", "radius", "means"),
    [
        (["99,99,9"], "ten", r"--ball-radius ten: must be millimetres above 0"),
        (["99,99,9"], 0.0, r"--ball-radius 0\.0: must be"),
        (["99,99,9"], "nan", r"--ball-radius nan: must be"),
        (["99,99,9"], "1,2", r"2 radii for 1 of --ball; give one, or one for each"),
        (None, 10.0, r"no ball is given; add --ball auto"),
    ],
)
def test_radii_that_cannot_be(said, radius, means):
    with pytest.raises(InputError, match=means):
        measure_balls(read_balls(said), radius)


def test_a_radius_that_puts_a_ball_far_away_is_refused(tmp_path):
    ball = (85.0, 45.0, 24.0)
    folder = write(tmp_path / "in", [paint(lamp, 1.0, FOCAL, chrome=[ball]) for lamp in LIGHTS])
    with pytest.raises(InputError, match=r"ball 1 would stand 10 times as far from the camera as the object; correct"):
        load(folder, balls=flag(ball, FOCAL), focal=f"{FOCAL}px", ball_radius=96.0, pixel_size=0.4)


def test_pictures_without_a_good_highlight_are_left_out(tmp_path):
    ball = (85.0, 0.0, 30.0)
    images = [paint(lamp, 1.0, chrome=[ball]) for lamp in LIGHTS]
    images[2] = paint(LIGHTS[2], 0.8)  # no ball at all: nothing shines
    images[4] = np.maximum(images[4], paint(LIGHTS[9], 1.0, chrome=[ball]))
    images[6] = paint(np.array([0.98, 0.0, -0.199]), 1.0, chrome=[ball])
    photos = load(write(tmp_path / "in", images), balls=f"chrome:{flag(ball)}")
    left = next(note for note in photos.notes if note.startswith("left out"))
    assert photos.files == tuple(f"p{number:02d}.png" for number in (0, 1, 3, 5, 7, 8, 9))
    assert "p02.png (no highlight" in left and "p04.png (several" in left and "p06.png (the highlight lies at" in left
    assert angles(photos.light_directions, LIGHTS[[0, 1, 3, 5, 7, 8, 9]]).max() < 1.0


def test_a_ball_in_a_folder_of_its_own(tmp_path):
    ball, alone = (10.0, 5.0, 40.0), []
    for lamp in LIGHTS:
        image = np.full(SHAPE, 0.004)
        shown = hit(ball, np.inf)[3]
        image[shown] = paint(lamp, 1.0, chrome=[ball])[shown]
        alone.append(image)
    write(tmp_path / "ball", alone)
    write(tmp_path / "object", [paint(lamp, 1.0) for lamp in LIGHTS])
    for said in (f"{tmp_path / 'ball'}:{flag(ball)}", tmp_path / "ball"):
        photos = load(tmp_path / "object", balls=said, names=["p0[1-9].png"])  # matched by their numbers
        assert angles(photos.light_directions, LIGHTS[1:]).max() < 1.0 and photos.balls[0].folder == tmp_path / "ball"
    (tmp_path / "ball" / "p03.png").unlink()
    with pytest.raises(InputError, match="9 pictures of the ball for 10"):
        load(tmp_path / "object", balls=said)


@pytest.mark.parametrize(
    ("said", "means"),
    [
        ("atuo", "did you mean .auto"), ("1,2", "did you mean|write x,y"), ("./none", "no such folder"),
        ("1,2,1", "at least 3"), ("none:1,2,9", "no such folder: none"), ("250,20,30", "leaves the picture"),
        ("auto", "nothing but the ball"), ("90,90,20", "shows no light in|chrome"), ((1.0, 2.0), "write x,y,radius"),
    ],
)  # fmt: skip
def test_what_is_no_ball_is_refused(tmp_path, said, means):
    write(tmp_path / "in", [0.5 * paint(lamp, 1.0) for lamp in LIGHTS[:6]])
    with pytest.raises(InputError, match=means):
        load(tmp_path / "in", balls=said)


def test_balls_and_lights_are_not_both_taken(tmp_path):
    write(tmp_path / "in", [paint(lamp, 1.0) for lamp in LIGHTS[:4]])
    with pytest.raises(InputError, match="keep one of the two"):
        load(tmp_path / "in", balls="auto", lights="folder")
    assert read_balls(None) == () == read_balls([])


def test_a_circle_and_its_ball_in_perspective():
    ball = Sphere(Camera(FOCAL), SHAPE, 85.0, 40.0, 30.0)
    rows, columns = ball.outline()
    np.testing.assert_allclose(ball.offsets(rows, columns), 1.0, atol=1e-9)
    again = Sphere.of(ball.circle, ball.camera, SHAPE)
    np.testing.assert_allclose([again.x, again.y, again.radius], [85.0, 40.0, 30.0], atol=0.1)
    assert abs(ball.covers().sum() - hit((85.0, 40.0, 30.0), FOCAL)[3].sum()) <= 2
    flat = Sphere.of(Circle(100.0, 60.0, 20.0), Camera(), SHAPE)
    np.testing.assert_allclose(flat.circle, (100.0, 60.0, 20.0), atol=1e-9)


@pytest.mark.skipif(not REAL.is_file(), reason="the photographs of the University of Washington are not there")
@pytest.mark.parametrize("said", ["chrome:253.5,148,119", "auto", "mask"])
def test_the_real_sphere(tmp_path, said):
    with zipfile.ZipFile(REAL) as opened:
        opened.extractall(tmp_path)
    true = np.loadtxt(tmp_path / "lights.txt", skiprows=1)
    folder = tmp_path / "chrome"
    if said != "mask":
        (folder / "chrome.mask.tga").unlink()
    said = f"{folder}:253.5,148,119" if said.startswith("chrome") else folder
    photos = load(tmp_path / "buddha", balls=said, gamma="linear")
    off = angles(photos.light_directions, true)
    assert off.mean() < 3.2 and np.median(off) < 2.4  # the file's own lights miss highlights by up to 8 pixels
    ball = photos.balls[0]
    np.testing.assert_allclose(ball.circle, (253.5, 148.0, 119.0), atol=2.0)
    for place, number in zip(ball.highlights, range(12), strict=True):
        rows, columns = np.nonzero(decode(folder / f"chrome.{number}.tga").pixels.min(-1) >= 250)
        np.testing.assert_allclose(place, [columns.mean(), rows.mean()], atol=0.5)
