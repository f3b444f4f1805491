"""`sdps data preview`: contact sheets and a page that stands alone, on whole, partial and damaged folders."""

import json
import re
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
from data_folders import MATERIALS, good_folder, scene_of, sphere_shard, write_folder
from PIL import Image

from pipelines.cli import main
from pipelines.data.preview import ON_PAGE, PER_SHEET, preview
from pipelines.data.preview_page import BUDGET, gallery
from pipelines.shared import charts, pictures
from render.planning.plan_counts import category, components, count_plan, family, light_directions
from render.records.manifest import View

VOID = {"meta", "img", "br", "link", "path", "use", "rect", "input"}


class Page(HTMLParser):
    """Collects what a page refers to and whether its elements are closed."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.references, self.open, self.images, self.text = [], [], 0, ""
        self.feed(text)

    def handle_starttag(self, tag, attributes):
        if tag not in VOID:
            self.open.append(tag)
        self.images += tag == "img"
        self.references += [value for key, value in attributes if key in ("src", "href", "xlink:href")]

    def handle_endtag(self, tag):
        if tag not in VOID:
            assert self.open.pop() == tag

    def handle_data(self, data):
        if self.open[-1:] != ["script"]:
            self.text += data


def page_of(folder: Path) -> Page:
    return Page((folder / "preview.html").read_text())


def many(folder: Path, count: int) -> None:
    """Write a folder of `count` scenes."""
    shards = [sphere_shard(MATERIALS[k % 4], name=f"s{k:03d}", seed=k) for k in range(count)]
    write_folder(folder, shards, [scene_of(shard, shape=f"blobby:{k}") for k, shard in enumerate(shards)])


def test_the_page_stands_alone(tmp_path, capsys):
    good_folder(tmp_path)
    assert main(["data", "preview", str(tmp_path)]) == 0
    assert capsys.readouterr().out.split() == [str(tmp_path / "preview.png"), str(tmp_path / "preview.html")]
    page = page_of(tmp_path)
    assert page.open == [] and page.images == 4
    assert all(reference.startswith(("data:image/", "#")) for reference in page.references)
    text = (tmp_path / "preview.html").read_text()
    assert not re.search(r"url\((?!#|data:)", text) and "@import" not in text and text.count("<script") == 2
    assert "prefers-color-scheme: dark" in text and "@media print" in text and 'name="viewport"' in text
    assert text.count("<svg") == 9 and "$" not in page.text
    for word in ("4 of 4", "chrome", "elevation", "mask area", "exposure", "slant", "Not validated", "None recorded"):
        assert word in page.text, word


def test_the_sheet_shows_every_scene(tmp_path):
    good_folder(tmp_path)
    with Image.open(preview(tmp_path)[0]) as sheet:
        assert sheet.size[0] > 2 * 4 * 128 and sheet.size[1] > 2 * 128


def test_many_scenes_fill_several_sheets_and_stale_ones_go(tmp_path):
    many(tmp_path, 2 * PER_SHEET + 3)
    names = [path.name for path in preview(tmp_path, count=1000)]
    assert names == ["preview-000.png", "preview-001.png", "preview-002.png", "preview.html"]
    assert page_of(tmp_path).images <= ON_PAGE
    assert [path.name for path in preview(tmp_path, count=5)] == ["preview.png", "preview.html"]
    assert sorted(path.name for path in tmp_path.glob("preview*")) == ["preview.html", "preview.png"]
    assert page_of(tmp_path).images == 5


def test_the_page_stays_small():
    """Noise is the worst case for the encoder."""
    noise = np.random.default_rng(0).integers(0, 256, (128, 512, 3), dtype=np.uint8)
    scene = scene_of(sphere_shard())
    sizes = [sum(len(uri) for _, uri, _, _ in gallery([(scene, noise)] * count)) for count in (2, ON_PAGE)]
    assert sizes[0] > 0.02 * BUDGET and sizes[1] <= BUDGET


def test_partly_rendered_and_damaged_folders(tmp_path):
    scenes = good_folder(tmp_path)
    (tmp_path / scenes[1].file).unlink()
    damaged = tmp_path / scenes[2].file
    damaged.write_bytes(damaged.read_bytes()[:-5])
    preview(tmp_path)
    page = page_of(tmp_path)
    assert page.images == 2 and "3 of 4" in page.text and f"1 shards could not be read ({scenes[2].id})" in page.text


def test_names_break_no_page(tmp_path):
    name = "<b>&|$x$"
    shard = sphere_shard()
    write_folder(tmp_path, [shard], [scene_of(shard, shape=f"meshes/{name}.ply", material=name, split='val"')])
    (tmp_path / "config.yaml").write_text(f"name: '{name}'\ndescription: a & b\n")
    preview(tmp_path)
    page = page_of(tmp_path)
    assert page.open == [] and page.images == 1 and page.text.count(name) >= 6
    assert "<b>&" not in (tmp_path / "preview.html").read_text() and "&amp;amp;" not in page.text


def test_failures_and_validation_are_told(tmp_path):
    good_folder(tmp_path)
    row = {"seed": 0, "shape": "blobby:1", "material": "<b>", "reason": "out of time"}
    rows = [row | {"id": f"fail-{k}"} for k in range(20)]
    (tmp_path / "failed.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    assert main(["data", "validate", str(tmp_path)]) == 0
    preview(tmp_path)
    page = page_of(tmp_path)
    assert "20 failures" in page.text and "fail-19" in page.text
    assert "fail-3" not in page.text and "out of time" in page.text
    assert "sound; 4 shards" in page.text and "<b>" in page.text  # as text, not as an element
    (tmp_path / "failed.jsonl").write_text("{")
    (tmp_path / "validation.json").write_text("[]")
    preview(tmp_path)
    assert "line 1 is not JSON" in page_of(tmp_path).text and "Not validated" in page_of(tmp_path).text


def test_bad_input_is_one_line(tmp_path, capsys):
    scenes = good_folder(tmp_path / "good")
    write_folder(tmp_path / "empty", [], scenes)
    (tmp_path / "bad" / "shards").mkdir(parents=True)
    write_folder(tmp_path / "bad", [], scenes[:1])
    (tmp_path / "bad" / scenes[0].file).write_bytes(b"no shard")
    for arguments, message in (
        ([str(tmp_path)], "no manifest.jsonl"),
        ([str(tmp_path / "good"), "--count", "0"], "--count"),
        ([str(tmp_path / "empty")], "no shard is there yet"),
        ([str(tmp_path / "bad")], "sdps data validate"),
    ):
        assert main(["data", "preview", *arguments]) == 2
        error = capsys.readouterr().err.splitlines()
        assert message in error[-1] and error[-1].startswith("sdps: ")


def test_strips_show_weights_in_the_place_of_an_image():
    shard = sphere_shard()
    plain = pictures.preview_strip(shard, lights=3)
    weights = np.stack([shard.mask, 0 * shard.mask]).astype(np.float32)
    mixed = pictures.preview_strip(replace(shard, weights=weights, materials=("chrome", "brass")), lights=3)
    assert plain.shape == mixed.shape == (32, 128, 3)
    tile = mixed[:, 32:64]
    assert (tile[~shard.mask] == 255).all() and len(np.unique(tile[shard.mask], axis=0)) == 1


def test_pictures_are_fitted_without_blur():
    picture = np.random.default_rng(0).integers(0, 256, (16, 64, 3), dtype=np.uint8)
    np.testing.assert_array_equal(pictures.scale_to_height(picture, 32), picture.repeat(2, 0).repeat(2, 1))
    assert pictures.scale_to_height(picture, 8).shape == (8, 32, 3)
    assert pictures.scale_to_height(picture, 16) is picture


def test_plots_take_the_ink_of_the_page():
    rng = np.random.default_rng(0)
    directions = rng.normal(size=(4000, 3))
    directions = np.abs(directions / np.linalg.norm(directions, axis=1, keepdims=True))
    for plot in (
        charts.light_disc_svg(directions[:50]),
        charts.light_disc_svg(directions),
        charts.histogram([0.5], "one value"),
        charts.histogram([0.0, 0.0], "nothing positive", log=True),
        charts.bars({f"name {k}": 40 - k for k in range(40)}, "many"),
    ):
        assert plot.startswith("<svg") and "currentColor" in plot and "#010203" not in plot and "#040506" not in plot
    assert "<image" in charts.light_disc_svg(directions)
    assert "<image" not in charts.light_disc_svg(directions[:50])
    angles = charts.elevations(np.array([[0, 0, 1], [1, 0, 0], [0, 0.5**0.5, 0.5**0.5]]))
    np.testing.assert_allclose(angles, [90, 0, 45])


def test_composition():
    shard = sphere_shard()
    one = scene_of(shard, shape="blobby:1", material="chrome")
    scenes = [
        one,
        replace(one, id="b", material="stripes:7:chrome+blue-fabric", split="val"),
        replace(one, id="c", view=View(scale=0.5), material="missing/file.yaml"),
        replace(one, id="d", shape="meshes/cat.ply", material="lambertian:0.5"),
    ]
    counts = count_plan(scenes)
    assert (counts.scenes, counts.images, counts.shapes, counts.views, counts.varying) == (4, 48, 2, 3, 1)
    assert counts.families == {"blobby": 3, "cat.ply": 1} and counts.splits == {"train": 3, "val": 1}
    assert counts.materials["chrome"] == 2 and counts.materials["blue-fabric"] == 1
    assert counts.categories["metal"] == 2 and counts.categories["other"] == 1
    assert counts.per_family["blobby"] == (3, 1, 2) and counts.sizes == {"32x32": 4}
    assert light_directions(scenes).shape == (3 * 12, 3)
    assert components("lambertian:0.5") == ("lambertian:0.5",) and components("parts:3:a+b+c") == ("a", "b", "c")
    assert family("sphere") == "sphere" and category("imported:clay") == "imported"
