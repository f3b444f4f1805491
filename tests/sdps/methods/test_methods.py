"""Methods by expression, weights by name, and results that are kept until something they depend on changes."""

from dataclasses import replace
from pathlib import Path

import classical_scenes as scenes
import numpy as np
import pytest
from sdps_scenes import hemisphere_lights

import sdps
from pipelines.evaluate import evaluation, merltest
from pipelines.evaluate.evaluation import Evaluation, TestObject
from pipelines.shared import presets
from render.shared.config import to_plain
from render.shared.errors import InputError
from render.shared.files import source_digest
from sdps.core.estimate import Estimate, constant_estimate
from sdps.core.precision import arithmetic
from sdps.data.augment import Augmentation
from sdps.inference.estimator import Estimator
from sdps.inference.inference_config import InferenceConfig, inference_config
from sdps.methods import pretrained, rows
from sdps.methods.method import Method
from sdps.methods.parse import combine, parse
from sdps.methods.pretrained import finder
from sdps.methods.runner import Runner
from sdps.models.checkpoint import TrainedModel, save_weights
from sdps.models.registry import create

LIGHTS = hemisphere_lights(12, np.random.default_rng(0))


def write_weights(path: Path, name: str) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    metadata = {"config": {"augmentation": to_plain(Augmentation())}}
    save_weights(path, TrainedModel(name, create(name).eval(), {}, metadata), half=True)
    return path


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("runs")
    for name in ("lcnet", "nenet", "psfcn"):
        write_weights(pretrained.trained_file(folder, name), name)
    return folder


@pytest.fixture
def kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder that stands in for the shipped weights, with an LCNet in it."""
    monkeypatch.setattr(pretrained, "shipped_folder", lambda: tmp_path / "shipped")
    return write_weights(tmp_path / "shipped" / "lcnet.safetensors", "lcnet")


def hills() -> TestObject:
    """Return matte hills in a frame they do not fill."""
    normals, mask = scenes.hills(28)
    images = scenes.lambertian(normals, mask, LIGHTS, albedo=0.7).images
    images, normals, mask = (np.pad(part, [(0, 0)] * lead + [(6, 6), (6, 6)] + [(0, 0)] * last)
                             for part, lead, last in ((images, 1, 1), (normals, 0, 1), (mask, 0, 0)))  # fmt: skip
    return TestObject("hills", "1", lambda: images, mask, normals, LIGHTS, np.ones(12))


def test_trained_weights_come_before_shipped_ones(runs: Path, kept: Path, tmp_path: Path) -> None:
    assert pretrained.require("lcnet", runs) == pretrained.trained_file(runs, "lcnet")
    assert pretrained.require("shipped:lcnet", runs) == kept
    assert pretrained.require("lcnet", tmp_path) == kept
    assert pretrained.require("lcnet") == kept and pretrained.list_shipped() == ["lcnet"]
    with pytest.raises(
        InputError, match=r"nenet.safetensors: no such weights; train them with `sdps train --models nenet`"
    ):
        pretrained.require("shipped:nenet", runs)
    with pytest.raises(InputError, match="unknown model or method 'lcnot'; did you mean 'lcnet'"):
        pretrained.require("lcnot", runs)


@pytest.mark.parametrize(
    ("text", "lights", "normals", "name"),
    [
        ("sdps", "lcnet", "nenet", "lcnet + nenet"),
        ("lcnet+psfcn", "lcnet", "psfcn", "lcnet + psfcn"),
        ("psfcn", "true", "psfcn", "psfcn, true lights"),
        ("lcnet", "lcnet", "", "lcnet"),
        ("least-squares", "true", "least-squares", "least-squares, true lights"),
        ("lcnet + least-squares", "lcnet", "least-squares", "lcnet + least-squares"),
        ("pf14", "", "pf14", "pf14"),
        ("constant", "", "constant", "constant predictor"),
    ],
)
def test_expressions(runs: Path, text: str, lights: str, normals: str, name: str) -> None:
    method = parse(text, finder(runs))
    assert (method.lighting, method.normals, method.name) == (lights, normals, name)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("true", "say which normals"),
        ("lcnet+lcnet-second+nenet", r"want METHOD or LIGHTS\+NORMALS"),
        ("lcnet++psfcn", r"want METHOD"),
        ("lcnet+pf14", "pf14 finds the lights itself; leave out the lighting model"),
        ("lcnet-second", "unknown model or method 'lcnet-second'"),
    ],
)
def test_expressions_that_do_not_fit(runs: Path, text: str, message: str) -> None:
    with pytest.raises(InputError, match=message):
        parse(text, finder(runs))


def test_flags_that_a_classical_method_would_not_look_at(runs: Path) -> None:
    find = finder(runs)
    with pytest.raises(InputError, match="least-squares needs lights"):
        combine(None, "least-squares", None, find)
    for lights, intensities in (("lcnet", None), (None, "true")):
        with pytest.raises(InputError, match="leave out the lighting model and the intensities"):
            combine(lights, "pf14", intensities, find)
    for name, counts in (
        ("sdps-frames", (8, 8)),
        ("sdps-plus", (8, 4)),
        ("shipped:sdps-plus", (8, 4)),
        ("sdps", (None, None)),
    ):
        method = combine(None, name, None, lambda name: Path(name))
        assert (method.light_views, method.normal_views) == counts
    assert combine("lcnet-soft", "nenet-plus", None, lambda name: Path(name)).light_views is None


def test_a_combination_has_one_label_however_it_is_asked_for() -> None:
    asked = combine(None, "shipped:sdps-plus", None, lambda name: Path(name))
    of_views = [rows.as_shipped(row) for row in rows._every_row() if row.light_views]
    assert asked in of_views and asked.name == "sdps-plus (lcnet-soft + nenet-plus) (shipped)"
    assert len(of_views) == len({row.name for row in of_views}) == 2  # sdps-frames, too


def test_a_lazy_source_gives_a_classical_method_what_an_array_does() -> None:
    item = hills()

    class Lazy:
        def __len__(self) -> int:
            return 12

        def __getitem__(self, part: slice) -> np.ndarray:
            return item.load()[part]

    runner = Runner(parse("robust-least-squares", pretrained.require), pretrained.require, InferenceConfig())
    whole = runner.estimate(item.load(), item.mask, LIGHTS, np.ones(12))
    lazy = runner.estimate(Lazy(), item.mask, LIGHTS, np.ones(12))
    np.testing.assert_allclose(lazy.normals, whole.normals, atol=1e-5)


def test_lights_that_methods_share_are_estimated_once(
    tmp_path: Path, runs: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    item, find = hills(), finder(runs)
    named = [parse(text, find) for text in ("lcnet", "lcnet+nenet", "lcnet+psfcn", "lcnet+least-squares", "true+nenet")]
    named += [replace(named[1], name="two views", light_views=2), combine("lcnet", "nenet", "true", find)]
    runners = [Runner(method, find, InferenceConfig()) for method in named]
    alone = [Evaluation(tmp_path / "alone").results(item, [runner])[0] for runner in runners]
    asked = []
    whole = Estimator.estimate_lights
    monkeypatch.setattr(Estimator, "estimate_lights", lambda *given, **_: asked.append(given) or whole(*given))
    together = Evaluation(tmp_path / "together").results(item, runners)
    assert len(asked) == 3  # LCNet, over two views, and with the intensities given
    for one, other in zip(together, alone, strict=True):
        assert one.scores == other.scores
        np.testing.assert_array_equal(one.light_directions, other.light_directions)


def test_results_are_kept_until_something_changes(tmp_path: Path, runs: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    item = hills()
    runner = Runner(parse("least-squares", pretrained.require), pretrained.require, InferenceConfig())
    first = Evaluation(tmp_path).results(item, [runner], ["least-squares, true lights"])[0]
    assert first.scores["normal_mae"] < 10 and first.normals().shape == (40, 40, 3)

    def refuse(*_: object, **__: object) -> None:
        raise AssertionError("ran again")

    with monkeypatch.context() as patched:
        patched.setattr(Runner, "estimate", refuse)
        again = Evaluation(tmp_path).results(item, [runner])[0]
        assert again.scores == first.scores
        np.testing.assert_array_equal(again.normals(), first.normals())
        changed = TestObject("hills", "2", item.load, item.mask, item.normals, LIGHTS, np.ones(12))
        with pytest.raises(AssertionError, match="ran again"):
            Evaluation(tmp_path).results(changed, [runner])
    find = finder(runs)
    options = ({}, {"read_out": "centre"}, {"light_views": 8}, {"normal_views": 2}, {"margin": None},
               {"precision": "float32" if arithmetic().precision == "bfloat16" else "bfloat16"})  # fmt: skip
    networks = [Runner(parse("sdps", find), find, InferenceConfig(**some)) for some in options]
    networks += [Runner(parse(text, find), find) for text in ("true+nenet", "lcnet+psfcn")]
    assert len({item.identity() for item in networks}) == 8
    resolved = Runner(parse("sdps", find), find, InferenceConfig(precision=arithmetic().precision))
    assert resolved.identity() == networks[0].identity()


def test_rendered_scenes_are_seen_whole_and_photographs_cut(
    tmp_path: Path, runs: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen = []
    whole = Estimator.estimate_lights

    def look(self: Estimator, images: np.ndarray, mask: np.ndarray, *given: object) -> Estimate:
        seen.append(self.margin_of(mask.shape))
        return whole(self, images, mask, *given)

    monkeypatch.setattr(Estimator, "estimate_lights", look)
    preset, find, item = presets.load("small"), finder(runs), hills()
    assert inference_config(preset.test) == InferenceConfig()
    framed = np.pad(item.load(), ((0, 0), (44, 44), (44, 44), (0, 0)))
    rendered = replace(item, mask=np.pad(item.mask, 44), normals=None, load=lambda: framed)
    for one in (rendered, item):
        for config in (InferenceConfig(), InferenceConfig(margin=4), InferenceConfig(margin=None)):
            Evaluation(tmp_path / str(one.mask.shape)).results(one, [Runner(parse("lcnet", find), find, config)])
    assert seen == [None, 4, None, 15, 4, None]
    with pytest.raises(InputError, match="margin must be at least 0 pixels, auto, or null"):
        replace(preset.test, margin=-1)
    assert "whole frame" in merltest.describe(preset.test)
    assert "box with 15 pixels" in merltest.describe(replace(preset.test, margin=15))


def test_a_refusal_is_kept_with_its_reason(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    item = hills()
    dark = TestObject("dark", "1", lambda: np.zeros((12, 40, 40, 3), np.float32), item.mask, item.normals, LIGHTS)
    runner = Runner(Method(name="pf14", normals="pf14"), pretrained.require, InferenceConfig())
    result = Evaluation(tmp_path).results(dark, [runner])[0]
    assert result.scores == {} and "black inside the mask" in result.reason
    assert Evaluation(tmp_path).results(dark, [runner])[0].reason == result.reason
    assert evaluation._FORMAT in (tmp_path / "scores.jsonl").read_text()


def lighting_rows(out: Path, preset: presets.Preset) -> list[Method]:
    ways = rows.normal_methods(out, preset.test.shipped)
    return rows.lighting_methods(out, merltest._own_lighting(preset), preset.test, ways, preset.test.shipped)


def test_a_preset_says_which_shipped_ways_stand_beside_what_is_trained(kept: Path, tmp_path: Path) -> None:
    for name in ("psfcn", "nenet"):
        write_weights(kept.with_name(f"{name}.safetensors"), name)
    preset = presets.load("demo", ["test.shipped=[true+psfcn, sdps]"])
    shipped = [m for m in rows.normal_methods(tmp_path, preset.test.shipped) if m.models()]
    assert [(m.name, m.paper) for m in shipped] == [
        ("psfcn, true lights (shipped)", "B0"),
        ("lcnet + nenet (shipped)", "B1"),
    ]
    assert [m.name for m in lighting_rows(tmp_path, preset)] == ["lcnet (shipped)"]
    only = presets.load("demo", ["test.shipped=[true+psfcn]"])
    assert lighting_rows(tmp_path, only) == []
    assert rows.normal_methods(tmp_path, ("lcnet+least-squares",))[-1].name == "lcnet + least-squares (shipped)"
    with pytest.raises(InputError, match="did you mean 'sdps'"):
        rows.normal_methods(tmp_path, ("sdpss",))
    for name in ("lcnet-soft", "nenet-plus"):
        write_weights(kept.with_name(f"{name}.safetensors"), name)
    plus = presets.load("small", ["test.shipped=[sdps-plus]"])
    averaged = [(m.name, m.light_views) for m in lighting_rows(tmp_path, plus)]
    assert averaged == [("lcnet-soft (shipped)", None), ("lcnet-soft (shipped), 8 views", 8)]


def test_the_page_shows_the_pair_trained_here_and_the_best_shipped_way(runs: Path, kept: Path, tmp_path: Path) -> None:
    least_squares = "least-squares, true lights"
    assert merltest.pick_pictured(rows.normal_methods(runs)) == ["lcnet + nenet", least_squares]
    for name in ("psfcn", "nenet"):
        write_weights(kept.with_name(f"{name}.safetensors"), name)
    # Rows further down the table build on better networks; least squares on LCNet's lights comes last.
    assert merltest.pick_pictured(rows.normal_methods(tmp_path)) == ["lcnet + psfcn (shipped)", least_squares]
    both = merltest.pick_pictured(rows.normal_methods(runs))
    assert both == ["lcnet + nenet", "lcnet + psfcn (shipped)", least_squares]
    write_weights(kept.with_name("lcnet-soft.safetensors"), "lcnet-soft")
    assert merltest.pick_pictured(rows.normal_methods(runs))[1] == "lcnet-soft + psfcn (shipped)"
    given = [Method(name="psfcn, true lights", lighting="true", normals="psfcn")]
    assert merltest.pick_pictured(given) == ["psfcn, true lights", least_squares]


def test_python_uses_networks_as_every_command_does(runs: Path) -> None:
    item, find = hills(), finder(runs)
    one = sdps.estimate(item.load(), item.mask, "lcnet+nenet", models=runs)
    other = Runner(parse("sdps", find), find).estimate(item.load(), item.mask, None, None)
    np.testing.assert_array_equal(one.normals, other.normals)
    np.testing.assert_array_equal(one.light_directions, other.light_directions)


def test_what_is_asked_for_comes_before_what_a_combination_says(runs: Path) -> None:
    for name in ("lcnet-soft", "nenet-plus"):
        write_weights(pretrained.trained_file(runs, name), name)
    find = finder(runs)
    counts = [
        (runner.estimator.light_views, runner.estimator.normal_views)
        for runner in (
            Runner(parse("sdps-plus", find), find),
            Runner(parse("sdps-plus", find), find, InferenceConfig(normal_views=1)),
            Runner(parse("sdps", find), find),
        )
    ]
    assert counts == [(8, 4), (8, 1), (1, 1)]


def test_results_of_other_code_are_found_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    item, runner = hills(), Runner(parse("least-squares", pretrained.require), pretrained.require)
    Evaluation(tmp_path).results(item, [runner])
    asked = []
    monkeypatch.setattr(Runner, "estimate", lambda *given, **_: asked.append(given) or constant_estimate(12, item.mask))
    Evaluation(tmp_path).results(item, [runner])
    assert not asked
    monkeypatch.setattr(evaluation, "code_identity", lambda: "other code")
    Evaluation(tmp_path).results(item, [runner])
    assert len(asked) == 1


def test_any_change_of_a_file_is_other_code(tmp_path: Path) -> None:
    (tmp_path / "package").mkdir()
    digests = set()
    for name, text in (("a.py", "1"), ("a.py", "2"), ("b.py", "2"), ("metrics.py", "3")):
        (tmp_path / "package" / name).write_text(text)
        digests.add(source_digest(tmp_path / "package"))
    (tmp_path / "package" / "b.py").rename(tmp_path / "package" / "moved.py")
    digests.add(source_digest(tmp_path / "package"))
    assert len(digests) == 5
