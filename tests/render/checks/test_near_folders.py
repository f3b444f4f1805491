"""A data folder of near lights and perspective: rendered, validated, exported, and what no layout holds is said."""

import json
from dataclasses import replace

import numpy as np
import pytest

from pipelines.cli import main
from render import plan, read_manifest, read_shard, render_plan, validate
from render.checks.known_checks import check_shard
from render.checks.shard_checks import Limits, depth_slopes
from render.planning.data_config import DataConfig

CONFIG = DataConfig(
    families={"blobby": 1}, views=1, materials_per_view=2, materials=("lambertian:0.7", "red-plastic"), validation=0,
    lights="near-uniform", light_count=12, size=48, spp=8, bounces=1, scale=(0.8, 0.9), near_lights=1.0,
    near_light_distance=(1.1, 2.0), camera="perspective", camera_distance=(1.6, 2.0),
)  # fmt: skip


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    path = tmp_path_factory.mktemp("near")
    render_plan(plan(CONFIG), path)
    return path


def shards(folder) -> list:
    return [read_shard(folder / scene.file, scene) for scene in read_manifest(folder)]


def test_is_sound(folder):
    found = validate(folder)
    assert found.sound and not found.findings, found.findings


def test_depth_slopes_are_those_of_perspective(folder):
    shard = shards(folder)[0]
    measured, predicted = depth_slopes(shard)
    assert np.median(measured / predicted) == pytest.approx(1, abs=0.03)
    off = np.median(abs(measured / predicted - 1))
    plain = {key: value for key, value in shard.provenance.items() if key != "camera_distance"}
    measured, predicted = depth_slopes(replace(shard, provenance=plain))
    assert np.median(abs(measured / predicted - 1)) > 3 * off  # as an orthographic depth they do not fit the normals


def test_positions_off_their_directions_are_found(folder):
    shard = shards(folder)[0]
    moved = replace(shard, light_positions=shard.light_positions[::-1].copy())
    assert "lights" in {finding.check for finding in check_shard(moved, Limits())}


def test_headers_tell_camera_and_lights(folder):
    scene = read_manifest(folder)[0]
    about = shards(folder)[0].provenance
    assert about["camera"] == "perspective" and about["camera_distance"] == pytest.approx(scene.view.camera_distance)
    focal = float(about["camera_matrix"].split()[0])
    assert about["field_of_view"] == pytest.approx(2 * np.degrees(np.arctan(24 / focal)), rel=1e-5)
    assert about["irradiance"] == "pi at the object's centre"


@pytest.mark.parametrize("layout", ["psfcn", "custom", "diligent", "unips"])
def test_an_export_says_what_it_has_no_place_for(folder, tmp_path, capsys, layout):
    assert main(["data", "export", str(folder), "--layout", layout, "--out", str(tmp_path / "tree")]) == 0
    said = capsys.readouterr().out
    assert f"2 scenes have near lights, which {layout} has no place for" in said
    assert f"2 scenes have a perspective camera, which {layout} has no place for" in said
    record = json.loads(next((tmp_path / "tree").rglob("scene.json")).read_text())
    np.testing.assert_allclose(record["light_positions"], read_manifest(folder)[0].light_positions(), atol=1e-5)
    assert record["camera_distance"] == read_manifest(folder)[0].view.camera_distance
