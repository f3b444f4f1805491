"""Every page of `sdps app` in Chromium, at two widths: it works, without console errors, and axe is content."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import photo_folders as folders
import pytest
from app_data import write_run
from app_server import eventually, serving
from ball_scenes import LIGHTS as BALL_LIGHTS
from ball_scenes import paint
from ball_scenes import write as write_balls
from browser_pages import WIDTHS, launched, needs_browser, watched
from sdps_scenes import hemisphere_lights

pytestmark = [pytest.mark.slow, needs_browser]
PATIENCE = 120_000  # milliseconds; the first job loads torch and Mitsuba


@pytest.fixture(scope="module")
def address(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    folder = tmp_path_factory.mktemp("root")
    write_run(folder / "run")
    with serving(folder) as place:
        yield place


@pytest.fixture(scope="module")
def browser() -> Iterator[object]:
    with launched() as opened:
        yield opened


@pytest.fixture(params=WIDTHS)
def page(request: pytest.FixtureRequest, browser, address: str) -> Iterator[object]:
    """A page whose console must stay clean, and which may ask nobody but our server."""
    with watched(browser, request.param, address, PATIENCE) as opened:
        yield opened


def test_photographs(page, address: str, tmp_path: Path) -> None:
    images, mask = folders.matte(hemisphere_lights(12, np.random.default_rng(0)), size=40)
    folder = folders.write_folder(tmp_path, images, mask, bits=8)
    page.goto(f"{address}/photographs")
    page.set_input_files("#files", sorted(folder.iterdir()))
    page.wait_for_selector("#findings li")
    assert page.locator("#thumbs img").count() == 12
    page.locator("#mask").scroll_into_view_if_needed()
    box = page.locator("#mask").bounding_box()
    page.click("#brush-take")
    page.mouse.click(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
    page.click("#mask-use")
    page.locator("#facts span", has_text="mask: painted").wait_for()
    for number, method in enumerate(("factorisation", "am07"), start=1):
        page.select_option("#method", method)
        page.click("#start")
        page.locator("#runs button").nth(number - 1).wait_for()
    page.locator("#compare-card").wait_for()
    page.locator("#mesh canvas").wait_for()
    page.locator("#sphere circle.light").nth(11).wait_for(state="attached")
    page.locator(".hover").focus()
    page.keyboard.press("ArrowDown")
    page.locator("#chart polyline").wait_for(state="attached")  # flat where the mask was taken away
    before = page.locator("#relit").screenshot()
    page.locator("#relit-light input").first.fill("150")
    assert eventually(lambda: page.locator("#relit").screenshot() != before)
    with page.expect_download() as download:
        page.click("#download")
    assert download.value.suggested_filename == "sdps-infer.zip"
    with page.expect_download() as download:
        page.get_by_role("button", name="Get normals as 16-bit PNG and EXR for Unreal").click()
    assert download.value.suggested_filename == "normals-directx.zip"
    page.get_by_role("button", name="Get normalMaps.sfm").click()
    page.locator("#exports .finding", has_text='again with "Focal length"').wait_for()


def test_questions_and_poses(page, address: str, tmp_path: Path) -> None:
    images, mask = folders.matte(hemisphere_lights(4, np.random.default_rng(0)), size=40)
    for pose in ("left", "right"):
        folders.write_folder(tmp_path / f"ps_{pose}", images, mask, bits=8)
    page.goto(f"{address}/photographs")
    page.set_input_files("#folder", tmp_path)
    page.locator("#pose option").nth(1).wait_for(state="attached")
    page.select_option("#pose", "right")
    page.locator("#work").get_by_text("1.png to 4.png").wait_for()
    page.click("#more summary")
    page.select_option("#method", "factorisation")
    page.select_option("#light-distance", label="this far:")
    page.fill("#distance", "400mm")
    page.click("#foresee")
    page.locator("#run-status.error", has_text='"Size of a pixel"').wait_for()
    page.fill("#pixel-size", "0.2")
    page.click("#foresee")
    page.locator("#work").get_by_text("0.2 mm a pixel").wait_for()
    page.click("#all-poses")
    page.get_by_role("button", name="2. right, factorisation").wait_for()
    assert page.get_by_role("button", name="1. left, factorisation").count() == 1


def test_balls(page, address: str, tmp_path: Path) -> None:
    pictures = [paint(lamp, 1.0, chrome=[(85.0, 40.0, 30.0)]) for lamp in BALL_LIGHTS]
    page.goto(f"{address}/photographs")
    page.set_input_files("#files", sorted(write_balls(tmp_path / "in", pictures).iterdir()))
    page.wait_for_selector("#findings li")
    page.click("#ball-find")
    radius = page.get_by_label("Ball 1: radius")
    radius.wait_for()
    assert abs(float(radius.input_value()) - 30.0) < 0.5 and page.locator(".ball-spot").count() == len(pictures)
    page.locator(".ball").scroll_into_view_if_needed()
    box = page.locator(".ball").bounding_box()
    x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    page.mouse.move(x, y)
    page.mouse.down()
    page.mouse.move(x + 20, y)
    page.mouse.up()
    column = page.get_by_label("Ball 1: column")
    assert float(column.input_value()) > 216.0  # from 214.5
    column.fill("214")
    page.keyboard.press("Tab")
    page.get_by_label("Ball 1: kind").select_option("chrome")
    page.click("#ball-use")
    assert eventually(lambda: page.locator(".ball-spot").count() == len(pictures))
    page.click("#ball-add")
    page.get_by_label("Ball 2: column").wait_for()
    page.get_by_role("button", name="Remove ball 2").click()
    assert page.locator(".ball").count() == 1


def test_a_bad_upload_gets_one_line(page, address: str, tmp_path: Path) -> None:
    (tmp_path / "<img src=x onerror=alert(1)>.txt").write_text("no")
    page.goto(f"{address}/photographs")
    page.set_input_files("#files", sorted(tmp_path.iterdir()))
    page.locator("#load-status.error", has_text="no pictures in it").wait_for()


def test_studio(page, address: str) -> None:
    page.goto(f"{address}/studio")
    page.locator("#rate", has_text="rendered in").wait_for()
    box = page.locator("#view").bounding_box()
    before = page.locator("#view").screenshot()
    page.mouse.move(box["x"] + 20, box["y"] + 20)
    page.mouse.down()
    for step in range(20):
        page.mouse.move(box["x"] + 20 + 8 * step, box["y"] + 60)
    page.mouse.up()
    assert page.locator("#view").screenshot() != before
    page.select_option("#shape", "blobby")
    page.locator("#rate", has_text="blobby:4").wait_for()
    page.locator("#gallery button").first.wait_for()
    page.select_option("#overlay", "interreflections")
    page.locator("#status").wait_for(state="hidden")
    page.click("#preset")
    page.locator("#preset-text", has_text="families").wait_for()


def test_data_and_runs(page, address: str) -> None:
    page.goto(f"{address}/data")
    page.get_by_role("button", name="data: run/data").click()
    page.locator("#tiles .note", has_text="mean radiance").first.wait_for()
    assert page.locator("#tiles button").count() == 3
    page.fill("#find", "failed")
    page.locator("#tiles .note", has_text="out of memory").wait_for()
    assert page.locator("#tiles button").count() == 1
    page.fill("#find", "")
    page.locator("#tiles button").first.click()
    page.locator("#lamp-card").wait_for()
    before = page.locator("#view").screenshot()
    page.locator("#scrub").fill("2")
    assert eventually(lambda: page.locator("#view").screenshot() != before)
    page.get_by_role("button", name="run: run").click()
    page.locator("#charts article", has_text="loss").wait_for()
    page.get_by_role("button", name="degrees").click()
    assert page.locator("tbody tr td").first.text_content() == "cat"
