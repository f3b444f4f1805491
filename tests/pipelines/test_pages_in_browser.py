"""`preview.html` and `report.html` in Chromium: light that is dragged, images one by one, errors under the pointer."""

import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from browser_pages import WIDTHS, launched, needs_browser, watched
from data_folders import good_folder
from matplotlib.figure import Figure
from sdps_scenes import sphere_normals

from pipelines.data.preview import preview
from pipelines.evaluate.report.page import render
from pipelines.evaluate.report.sections import Section, SectionWriter, Tile
from pipelines.shared.pictures import error_map, normal_map

pytestmark = [pytest.mark.slow, needs_browser]


@pytest.fixture(scope="module")
def browser() -> Iterator[object]:
    with launched() as opened:
        yield opened


@pytest.fixture(params=WIDTHS)
def page(request: pytest.FixtureRequest, browser) -> Iterator[object]:
    with watched(browser, request.param, "file://") as opened:
        yield opened


def pixel(page, selector: str, x: float, y: float) -> list[int]:
    """Return the colour of a canvas at a place from (0, 0) to (1, 1)."""
    script = "(c, [x, y]) => [...c.getContext('2d').getImageData(x * c.width, y * c.height, 1, 1).data]"
    return page.locator(selector).first.evaluate(script, [x, y])


def drag(page, selector: str, x: float, y: float) -> None:
    """Drag from the middle of an element to a place from (0, 0) to (1, 1)."""
    target = page.locator(selector).first
    target.scroll_into_view_if_needed()
    box = target.bounding_box()
    page.mouse.move(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
    page.mouse.down()
    page.mouse.move(box["x"] + x * box["width"], box["y"] + y * box["height"], steps=4)
    page.mouse.up()
    page.wait_for_timeout(100)


def test_a_scene_under_each_light_and_any(page, tmp_path: Path) -> None:
    good_folder(tmp_path)
    preview(tmp_path)
    page.goto((tmp_path / "preview.html").as_uri())
    told = page.locator("#viewer output")
    told.filter(has_text="image ").wait_for()
    assert page.locator("#viewer option").count() == 4
    seen = set()
    for number in ("1", "2", "3"):
        page.locator("#viewer [name=image]").fill(number)
        told.filter(has_text=f"image {number} of 12").wait_for()
        seen.add(page.locator("#viewer canvas").evaluate("c => c.toDataURL()"))
    assert len(seen) == 3
    drag(page, "#viewer canvas", 0.95, 0.5)
    told.filter(has_text="mixed from the images around").wait_for()
    right = [sum(pixel(page, "#viewer canvas", x, 0.5)[:3]) for x in (0.3, 0.7)]
    drag(page, "#viewer svg", 0.1, 0.5)
    left = [sum(pixel(page, "#viewer canvas", x, 0.5)[:3]) for x in (0.3, 0.7)]
    assert right[1] > right[0] and left[0] > left[1]  # x is right: the side towards the light is bright
    page.locator("#viewer [name=normals]").check()
    page.wait_for_timeout(100)
    facing = pixel(page, "#viewer canvas", 0.5, 0.5)
    assert facing[2] > 230 and abs(facing[0] - 128) < 25 and abs(facing[1] - 128) < 25
    page.locator("#viewer select").select_option(index=2)
    told.filter(has_text="image ").wait_for()


@pytest.fixture
def report(tmp_path: Path) -> Path:
    """A report of a sphere whose normals are 10 degrees off."""
    normals, mask = sphere_normals(64)
    angle = np.radians(10.0)
    turn = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])
    found = np.where(mask[..., None], normals @ turn.T, 0.0)
    errors = np.where(mask, 10.0, np.nan)
    writer = SectionWriter(Section(name="x", title="Objects", text=""))
    figure = Figure(figsize=(2, 2))
    writer.strip("sphere", [
        Tile("true normals", normal_map(normals, mask), "truth"),
        Tile("normals, lcnet+nenet", normal_map(found, mask), "normals"),
        Tile("lcnet+nenet: error 10.0 degrees", error_map(errors), "beside"),
        Tile("lights", figure),
    ])  # fmt: skip
    writer.write(tmp_path)
    render(tmp_path / "report.html", [tmp_path], "Report", "")
    return tmp_path / "report.html"


def test_maps_of_normals_are_lit(page, report: Path) -> None:
    page.goto(report.as_uri())
    assert page.locator("canvas").count() == 0
    drag(page, "[data-kind=truth] img", 0.85, 0.5)
    assert page.locator("canvas:visible").count() == 2  # one light on both maps
    assert (
        pixel(page, "[data-kind=truth] canvas", 0.75, 0.5)[0]
        > pixel(page, "[data-kind=truth] canvas", 0.25, 0.5)[0] + 60
    )
    assert pixel(page, "[data-kind=truth] canvas", 0.02, 0.02)[:3] == [255, 255, 255]
    around = page.get_by_label("Around")
    around.fill("180")
    page.wait_for_timeout(100)
    assert (
        pixel(page, "[data-kind=truth] canvas", 0.25, 0.5)[0]
        > pixel(page, "[data-kind=truth] canvas", 0.75, 0.5)[0] + 60
    )
    page.get_by_label("Light the maps").uncheck()
    page.wait_for_timeout(100)
    assert page.locator("canvas:visible").count() == 0 and page.locator("[data-kind] img:visible").count() == 3


def test_the_error_under_the_pointer_is_told(page, report: Path) -> None:
    page.goto(report.as_uri())
    tile = page.locator("[data-kind=beside] img")
    tile.scroll_into_view_if_needed()
    box = tile.bounding_box()
    page.mouse.move(box["x"] + 0.4 * box["width"], box["y"] + 0.6 * box["height"])
    told = page.locator(".readout").text_content()
    assert abs(float(re.search(r"lcnet\+nenet: ([\d.]+)", told)[1]) - 10.0) < 0.7
    assert page.locator(".mark:visible").count() == 3
    page.mouse.move(box["x"] + 1, box["y"] + 1)
    assert "outside the mask" in page.locator(".readout").text_content()


def test_both_are_whole_without_javascript(browser, report: Path, tmp_path: Path) -> None:
    good_folder(tmp_path / "data")
    preview(tmp_path / "data")
    context = browser.new_context(java_script_enabled=False)
    page = context.new_page()
    for path, pictures in ((report, 4), (tmp_path / "data" / "preview.html", 4)):
        page.goto(path.as_uri())
        assert page.locator("img:visible").count() == pictures
        assert page.locator("#viewer:visible, #light:visible").count() == 0
    context.close()
