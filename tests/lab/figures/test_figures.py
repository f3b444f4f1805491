"""`python -m lab eval-figures`: light classes, choice of sets, published numbers, and whole small runs."""

import argparse
import json
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
import torch
from PIL import Image
from sdps_scenes import hemisphere_lights, shade, sphere_normals

from lab.figures import (
    eval_figures,
    number_of_classes,
    number_of_images,
    per_material,
    pf14,
    sweep,
)
from pipelines.evaluate import evaluation, published
from pipelines.evaluate.report.sections import read_sections
from pipelines.evaluate.workbench import Workbench
from pipelines.shared import presets, scenes
from render.planning import light_sets
from render.records.shards import Shard, to_half, write_shard
from render.shared.errors import InputError
from render.shared.files import write_text
from sdps.core.lighting import azimuth_elevation
from sdps.core.metrics import angle_degrees
from sdps.inference.inference_config import InferenceConfig
from sdps.methods import pretrained
from sdps.methods.method import Method
from sdps.methods.pretrained import finder
from sdps.methods.runner import Runner

SMALL = ["test.shapes=[sphere, bunny]", "test.materials=[red-phenolic, pink-plastic]",
         "test.lights=near-uniform:12", "test.size=32", "test.spp=1", "test.bounces=0"]  # fmt: skip


def write_scenes(config, folder):
    """Write analytic spheres in the place of rendered scenes, so that nothing needs to be rendered."""
    for number, scene in enumerate(scenes.test_scenes(config)):
        normals, mask = sphere_normals(scene.size, 0.8)
        directions = scene.light_directions()
        glossy = shade(normals, directions, 0.3 + 0.1 * (number % 5)) ** (1.0 + 0.2 * (number % 3))
        shard = Shard(
            scene_id=scene.id, images=to_half(glossy), normals=normals, depth=np.zeros(mask.shape, np.float32),
            mask=mask, coverage=mask.astype(np.float32), light_directions=directions,
            provenance={"spec": scene.digest()},
        )  # fmt: skip
        write_shard(folder / scene.file, shard)


@pytest.fixture
def run(tmp_path, monkeypatch):
    """Return a function that runs the command on analytic scenes and returns its exit code."""
    monkeypatch.setattr(scenes, "load_shape", lambda name: None)  # the mesh is not needed
    preset = presets.load("smoke", SMALL)
    write_scenes(preset.test, tmp_path / "merltest")
    for name in pf14.LIGHT_SETS:
        kinds = pf14.group_materials(preset.test.materials)
        chosen = tuple(item for names in kinds.values() for item in names)
        config = replace(preset.test, shapes=("bunny",), materials=chosen, lights=name)
        write_scenes(config, tmp_path / "figures" / scenes.slug(name))
    monkeypatch.setattr(pretrained, "list_shipped", list)  # as if none travelled with the package
    torch.set_num_threads(1)

    def call(*arguments):
        parser = argparse.ArgumentParser()
        eval_figures.add_arguments(parser)
        overrides = [part for item in SMALL for part in ("--set", item)]
        return eval_figures.main(
            parser.parse_args(["--preset", "smoke", "--out", str(tmp_path), *overrides, *arguments])
        )

    call.out = tmp_path
    return call


# ---- light classes


@pytest.mark.parametrize(("count", "floor"), [(18, 3.74), (36, 1.86), (60, 1.20), (90, 0.76)])
def test_class_centres_lie_as_far_off_the_diligent_lights_as_computed(count, floor):
    assert number_of_classes.centre_floor(light_sets.load("diligent"), count) == pytest.approx(floor, abs=0.006)


@pytest.mark.parametrize(("count", "floor"), [(18, 3.45), (36, 1.73), (60, 1.04), (90, 0.69)])
def test_class_centres_lie_as_far_off_a_uniform_hemisphere_as_computed(count, floor):
    many = hemisphere_lights(40_000, np.random.default_rng(0), lowest=0.0)
    assert number_of_classes.centre_floor(many, count) == pytest.approx(floor, abs=0.02)


@pytest.mark.parametrize("count", number_of_classes.BINS)
def test_deviated_lights_are_half_a_class_away_and_in_front(count):
    directions, delta = light_sets.load("merltest"), number_of_classes.half_bin(count)
    azimuth, elevation = azimuth_elevation(directions)
    inner = (np.abs(azimuth) <= 90 - 2 * delta) & (np.abs(elevation) <= 90 - 2 * delta)
    for corner in number_of_classes.CORNERS:
        moved = number_of_classes.deviate(directions, count, corner)
        found = azimuth_elevation(moved.astype(np.float64))
        assert (moved[:, 2] > 0).all()
        np.testing.assert_allclose(np.linalg.norm(moved, axis=1), 1.0, atol=1e-6)
        steps = np.stack(found) - np.stack([azimuth, elevation])  # (2, L)
        assert np.abs(steps).max() <= delta + 1e-3
        np.testing.assert_allclose(steps[:, inner].T, np.broadcast_to(np.multiply(corner, delta), (inner.sum(), 2)),
                                   atol=2e-3)  # fmt: skip
        assert np.abs(np.stack(found)).max() <= 90 - delta + 1e-3


def test_four_deviations_at_36_bins_are_two_and_a_half_degrees_in_each_angle():
    front = np.array([[0.0, 0.0, 1.0]])
    angles = [
        angle_degrees(number_of_classes.deviate(front, 36, corner), front)[0] for corner in number_of_classes.CORNERS
    ]
    np.testing.assert_allclose(angles, 3.535, atol=0.005)  # the largest quantisation error there is


# ---- choices


def test_subsets_are_nested_and_all_images_come_once():
    chosen = number_of_images.draw_subsets(100, draws=3, seed=0)
    assert [count for count, _, _ in chosen] == [*number_of_images.COUNTS] * 3 + [100]
    first = [set(places) for _, draw, places in chosen[:-1] if draw == 0]
    assert all(small < large for small, large in pairwise(first))
    assert set(chosen[0][2]) != set(chosen[len(number_of_images.COUNTS)][2])
    assert [count for count, _, _ in number_of_images.draw_subsets(12, 1, 0)] == [2, 4, 8, 12]


def test_a_part_of_an_object_has_its_own_digest_and_truth():
    stack = np.arange(5 * 2 * 2 * 3, dtype=np.float32).reshape(5, 2, 2, 3)
    directions = hemisphere_lights(5, np.random.default_rng(1))
    item = evaluation.TestObject("cube", "abc", lambda: stack, np.ones((2, 2), bool), None, directions, np.arange(5.0))
    part = number_of_images.select_images(item, 2, 0, np.array([1, 4]))
    np.testing.assert_array_equal(part.load(), stack[[1, 4]])
    np.testing.assert_array_equal(part.intensities, [1.0, 4.0])
    assert part.digest != item.digest and number_of_images.select_images(item, 5, 0, np.arange(5)) is item


def test_the_groups_of_the_pf14_figure_have_the_published_sizes():
    sizes = {group: len(names) for group, names in pf14.group_materials(("all",)).items()}
    assert sizes == {"lambertian": 15, "fabric": 12, "plastic": 9, "phenolic": 12}
    assert len(set(pf14.list_albedos())) == 15
    few = pf14.group_materials(("red-phenolic", "blue-fabric", "pink-plastic", "chrome"))
    assert [len(names) for names in few.values()] == [1, 1, 1, 1]
    assert pf14.group_materials(("red-phenolic", "lambertian:0.5"))["lambertian"] == ["lambertian:0.5"]
    with pytest.raises(sweep.LeftOut, match=r"test\.materials"):
        pf14.group_materials(("chrome",))


def test_published_curves_average_to_the_published_rows():
    curves = per_material.read_published()
    for row, name in per_material.COLUMNS.items():
        assert len(curves[name]) == 100
        assert np.mean(list(curves[name].values())) == pytest.approx(published.NORMALS[row][2], abs=0.006)


def test_rank_correlation_is_that_of_the_shared_materials():
    curves = per_material.read_published()
    same = per_material.Curve("x", dict(curves["SDPS_Net"]) | {"unobtainium": 1.0}, "SDPS_Net")
    assert same.rank_correlation(curves)[::2] == (pytest.approx(1.0), 100)
    opposite = per_material.Curve("x", {name: -value for name, value in curves["PS_FCN"].items()}, "PS_FCN")
    assert opposite.rank_correlation(curves)[0] == pytest.approx(-1.0)
    assert np.isnan(per_material.Curve("x", {"chrome": 1.0, "brass": 2.0}, "PS_FCN").rank_correlation(curves)[0])


def test_methods_are_read_and_distinguished(tmp_path):
    found = {m.name: m for m in eval_figures.choose_methods(["least-squares", "pf14", "pf14"], tmp_path)}
    assert set(found) == {"least-squares, true lights", "pf14"}
    least, maxima = found["least-squares, true lights"], found["pf14"]
    assert least.lighting == "true" and not sweep.finds(least, "direction_mae")
    assert sweep.finds(maxima, "intensity_error") and sweep.paper_row(maxima) == "PF14"
    pair = Method(name="x", lighting="shipped:lcnet", normals="shipped:nenet")
    assert sweep.paper_row(pair) == "B1" and sweep.finds(pair, "direction_mae")
    assert sweep.paper_row(replace(pair, intensities="true")) == ""
    assert not sweep.finds(replace(pair, intensities="true"), "intensity_error")
    blind = Method(name="x", normals="upsfcn")
    assert sweep.paper_row(blind) == "B9" and not sweep.finds(blind, "direction_mae")
    assert pf14.find_published(pair, "normal_mae", "phenolic", "biased:100", "bunny") == 6.9
    assert pf14.find_published(pair, "normal_mae", "phenolic", "biased:100", "sphere") is None
    with pytest.raises(InputError, match="want METHOD or LIGHTS"):
        eval_figures.choose_methods(["a+b+c+d"], tmp_path)
    with pytest.raises(InputError, match="unknown"):
        eval_figures.choose_methods(["pf-14"], tmp_path)


def test_default_methods_are_those_with_weights(tmp_path, monkeypatch, caplog):
    monkeypatch.setattr(pretrained, "list_shipped", list)
    names = [method.name for method in eval_figures.choose_methods([], tmp_path)]
    assert names == ["pf14", "least-squares, true lights"] and "classical methods only" in caplog.text
    for name in ("lcnet", "nenet"):
        write_text(tmp_path / "models" / name / f"{name}.safetensors", "not read here")
    assert next(m.name for m in eval_figures.choose_methods([], tmp_path)) == "lcnet + nenet"


# ---- whole runs


def test_every_figure_is_written_and_taken_up_again(run, capsys):
    chosen = ["--methods", "constant,least-squares", "--draws", "2"]
    assert run(*chosen) == 0
    text = capsys.readouterr().out
    assert "Normals by number of light classes" in text and "Error per material: bunny" in text
    figures = run.out / "figures"
    results = json.loads((figures / "results.json").read_text())
    assert list(results) == list(eval_figures.FIGURES)
    for found in results.values():
        assert found["definition"] and found["values"] and found["tables"]
        for name in found["charts"]:
            with Image.open(figures / name) as picture:
                assert picture.width > 400
    sections = [section for _, section in read_sections(run.out)]
    assert [section.name for section in sections] == [f"figure-{name}" for name in eval_figures.FIGURES]
    ledger = (run.out / "eval" / "scores.jsonl").read_text()
    (figures / "results.json").write_text("{torn")
    assert run(*chosen, "--figures", "bins") == 0  # nothing is evaluated again
    assert (run.out / "eval" / "scores.jsonl").read_text() == ledger
    assert list(json.loads((figures / "results.json").read_text())) == ["bins"]


def test_coarser_classes_cost_a_calibrated_method_more(run):
    assert run("--methods", "least-squares", "--figures", "bins") == 0
    values = json.loads((run.out / "figures" / "results.json").read_text())["bins"]["values"]["normal_mae"]
    for errors in values.values():
        assert errors["2"] > errors["10"] > errors["36"] > errors["180"] > errors["exact"] - 0.05
        assert errors["180"] - errors["exact"] < 1.0


def test_what_cannot_be_drawn_is_left_out(run, caplog):
    assert run("--methods", "least-squares", "--figures", "lights,materials") == 1
    assert "needs a method that finds the lights" in caplog.text
    assert (run.out / "figures" / "materials.png").is_file()
    with pytest.raises(InputError, match="no figure"):
        run("--methods", "factorisation", "--figures", "bins")
    with pytest.raises(InputError, match="did you mean 'bins'"):
        run("--figures", "bin")
    with pytest.raises(InputError, match="--draws"):
        run("--draws", "0")


def test_materials_need_the_bunny(tmp_path):
    preset = presets.load("smoke", ["test.shapes=[sphere]"])
    runner = Runner(Method(name="constant", normals="constant"), finder(None), InferenceConfig())
    bench = Workbench(preset, tmp_path, (runner,))
    with pytest.raises(sweep.LeftOut, match="bunny"):
        per_material.make(bench)
    with pytest.raises(sweep.LeftOut, match="given the lights"):
        number_of_classes.make(bench)
