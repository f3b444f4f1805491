"""The trainer: exact resume, refusals, signals, metrics on disk, weights. What networks learn: test_sdps_overfit.py."""

import json
import os
import shutil
import signal
from dataclasses import replace
from itertools import count
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from safetensors.torch import load_file
from sdps_scenes import errors, write_data

from pipelines.cli import main
from render.records import mirror
from render.records.mirror import open_folder
from render.shared.config import build
from render.shared.errors import InputError
from sdps.data.dataset import SampleKey, SceneDataset, collate
from sdps.models.checkpoint import TrainedModel, load_state, load_weights, save_state, save_weights
from sdps.models.registry import MODELS, create
from sdps.publishing.learning_curves import read_metrics, write_curves
from sdps.training import recipes, training_run
from sdps.training.kept_weights import KeptWeights
from sdps.training.stage_factory import create_stage
from sdps.training.stages import LightingStage, NormalStage
from sdps.training.trainer import METRICS, TrainingResult, train
from sdps.training.training_config import LightingTraining, NormalTraining
from sdps.training.training_run import CHECKPOINT

TIMES = {"seconds", "images_per_second", "waiting_share"}
QUICK = NormalTraining(
    steps=8, batch_scenes=2, images=2, size=32, crop=16, lights="true", log_every=1, workers=0, validation_scenes=2,
    schedule="cosine",
)  # fmt: skip


class StopAt:
    """A logger that ends the run at a step: politely by a signal, or as a crash."""

    def __init__(self, step: int, crash: bool = False) -> None:
        self.step, self.crash = step, crash

    def log(self, step: int, values: dict[str, float]) -> None:
        if step != self.step:
            return
        if self.crash:
            raise RuntimeError("killed")
        os.kill(os.getpid(), signal.SIGINT)

    def close(self) -> None:
        pass


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("data")
    write_data(path, ("train",) * 5 + ("val", "val"), lights=4, size=32)
    return path


def rows(out: Path) -> list[dict]:
    """Return the metrics of a run without what measures time."""
    lines = [json.loads(line) for line in (out / METRICS).read_text().splitlines()]
    return [{key: value for key, value in line.items() if key not in TIMES} for line in lines]


def assert_same_run(first: Path, second: Path) -> None:
    assert rows(first) == rows(second)
    weights = [load_file(out / "nenet.safetensors") for out in (first, second)]
    assert all(torch.equal(weights[0][name], weights[1][name]) for name in weights[0])


@pytest.fixture(scope="module")
def uninterrupted(folder: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, TrainingResult]:
    out = tmp_path_factory.mktemp("whole")
    return out, train(NormalStage(QUICK), folder, out)


@pytest.mark.parametrize("workers", [0, 2])
def test_interrupted_and_resumed_run_is_the_uninterrupted_one(
    folder: Path, uninterrupted: tuple, tmp_path: Path, workers: int
) -> None:
    config = replace(QUICK, workers=workers)
    stopped = train(NormalStage(config), folder, tmp_path, loggers=[StopAt(3)])
    assert stopped.interrupted
    assert stopped.steps == 3
    assert stopped.weights is None
    resumed = train(NormalStage(config), folder, tmp_path)
    assert resumed.steps == 8
    assert not resumed.interrupted
    assert_same_run(uninterrupted[0], tmp_path)


@pytest.fixture
def tars(folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return a packed set of the folder in tars of two scenes or so."""
    pytest.importorskip("webdataset", reason="the tars' library, of sdps[storage], is missing")
    monkeypatch.setenv("SDPS_CACHE", str(tmp_path / "cache"))
    assert main(["data", "pack", str(folder), "--out", str(tmp_path / "tars"), "--tar-mb", "0.05"]) == 0
    return tmp_path / "tars"


def test_a_packed_set_gives_the_losses_of_the_folder(folder: Path, tars: Path, uninterrupted: tuple) -> None:
    with open_folder(tars) as data:
        train(NormalStage(replace(QUICK, workers=1)), data, tars / "run", loggers=[StopAt(3)])
        train(NormalStage(QUICK), data, tars / "run")
    assert_same_run(uninterrupted[0], tars / "run")


@pytest.mark.parametrize("workers", [0, 2])
def test_a_packed_set_larger_than_its_cache_goes_on_as_if_uninterrupted(
    tars: Path, tmp_path: Path, workers: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(mirror, "_IN_USE", -1.0 if workers == 0 else 0.5)
    config = replace(QUICK, workers=workers, shuffle_window=1, steps=12)  # five scenes, in pairs
    with open_folder(tars, cache_gb=75e-6) as data:
        train(NormalStage(config), data, tmp_path / "whole")
        assert not list(data.glob("cache/sphere_00[0-4]*"))  # decoded, they would leave it before they are used again
        assert train(NormalStage(config), data, tmp_path / "parts", loggers=[StopAt(5)]).interrupted
        shutil.rmtree(data / "shards")  # the next part is on another machine
        train(NormalStage(config), data, tmp_path / "parts")
        assert_same_run(tmp_path / "whole", tmp_path / "parts")
        with pytest.raises(InputError, match=r"of another run \(shuffle_window was 1, now 2\)"):
            train(NormalStage(replace(config, shuffle_window=2)), data, tmp_path / "parts")
    with open_folder(tars, cache_gb=20e-6) as data, pytest.raises(InputError, match="shuffling among 1 scenes keeps"):
        train(NormalStage(config), data, tmp_path / "none")


def test_lights_that_are_given_have_no_errors(folder: Path, uninterrupted: tuple) -> None:
    (validated,) = [row for row in rows(uninterrupted[0]) if "val_normal_mae" in row]
    assert set(validated) == {"step", "val_loss", "val_normal_mae"}
    lighting = TrainedModel("lcnet", create("lcnet").eval(), {}, {"config": {"augmentation": {}}})
    stage = NormalStage(replace(QUICK, lights="lcnet"), lighting)
    assert {"direction_mae", "intensity_error"} <= set(errors(stage, folder))


def test_killed_run_goes_on_from_its_last_checkpoint(folder: Path, uninterrupted: tuple, tmp_path: Path) -> None:
    config = replace(QUICK, checkpoint_minutes=1e-9)  # one every step
    with pytest.raises(RuntimeError, match="killed"):
        train(NormalStage(config), folder, tmp_path, loggers=[StopAt(5, crash=True)])
    assert load_state(tmp_path / CHECKPOINT)["step"] == 4
    assert rows(tmp_path)[-1]["step"] == 5  # written, but not saved: dropped and taken again
    (tmp_path / METRICS).open("a").write('{"step": 6, "lo')  # half a line, as a kill leaves it
    train(NormalStage(QUICK), folder, tmp_path)
    assert_same_run(uninterrupted[0], tmp_path)


def test_finished_run_is_left_alone_and_a_longer_budget_goes_on(folder: Path, tmp_path: Path) -> None:
    config = replace(QUICK, steps=2, schedule="constant")
    first = train(NormalStage(config), folder, tmp_path)
    time_of_change = first.weights["nenet"].stat().st_mtime_ns
    again = train(NormalStage(config), folder, tmp_path)
    assert (again.steps, again.metrics) == (2, first.metrics)
    assert again.weights["nenet"].stat().st_mtime_ns == time_of_change
    longer = train(NormalStage(replace(config, steps=4)), folder, tmp_path)
    whole = train(NormalStage(replace(config, steps=4)), folder, tmp_path / "whole")
    assert longer.metrics == whole.metrics


def test_checkpoint_of_another_run_is_refused(folder: Path, uninterrupted: tuple, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"learning_rate was 0\.0005, now 0\.1"):
        train(NormalStage(replace(QUICK, learning_rate=0.1)), folder, uninterrupted[0])
    (tmp_path / CHECKPOINT).write_bytes((uninterrupted[0] / CHECKPOINT).read_bytes()[:5000])
    with pytest.raises(InputError, match=r"damaged or not a checkpoint .*; delete it"):
        train(NormalStage(QUICK), folder, tmp_path)


def test_a_checkpoint_older_than_a_setting_had_its_default(folder: Path, tmp_path: Path) -> None:
    train(NormalStage(QUICK), folder, tmp_path, loggers=[StopAt(2)])
    state = load_state(tmp_path / CHECKPOINT)
    del state["identity"]["config.augmentation"]["frontal"], state["identity"]["config.accumulate"]
    save_state(tmp_path / CHECKPOINT, state)
    augmentation = replace(QUICK.augmentation, frontal=0.5)
    for change, named in (({"augmentation": augmentation}, "augmentation"), ({"accumulate": 2}, "accumulate was 1")):
        with pytest.raises(InputError, match=named):
            train(NormalStage(replace(QUICK, **change)), folder, tmp_path)
    assert train(NormalStage(QUICK), folder, tmp_path).steps == 8


def test_a_checkpoint_may_call_its_schedule_by_the_earlier_name(folder: Path, tmp_path: Path) -> None:
    config = replace(QUICK, schedule="warmup-stable-decay", cooldown=0.5)
    train(NormalStage(config), folder, tmp_path, loggers=[StopAt(2)])
    state = load_state(tmp_path / CHECKPOINT)
    state["identity"]["config.schedule"] = "trapezoid"
    save_state(tmp_path / CHECKPOINT, state)
    assert train(NormalStage(config), folder, tmp_path).steps == 8


def test_minutes_are_counted_across_resumed_runs(folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    looks = count()  # a clock that goes on by a tenth of a second whenever it is looked at
    monkeypatch.setattr(training_run, "time", SimpleNamespace(perf_counter=lambda: 0.1 * next(looks)))
    config = replace(QUICK, steps=None, minutes=0.05, schedule="cosine")
    stopped = train(NormalStage(config), folder, tmp_path, loggers=[StopAt(2)])
    finished = train(NormalStage(config), folder, tmp_path)
    assert finished.seconds >= 3.0
    assert finished.seconds > stopped.seconds
    lines = [json.loads(line) for line in (tmp_path / METRICS).read_text().splitlines()]
    rates = [line["learning_rate"] for line in lines if "learning_rate" in line]
    assert rates == sorted(rates, reverse=True)
    assert rates[-1] < 0.5 * rates[0]


def test_metrics_name_speed_waiting_and_validation(uninterrupted: tuple) -> None:
    out, result = uninterrupted
    lines = [json.loads(line) for line in (out / METRICS).read_text().splitlines()]
    assert [line["step"] for line in lines] == [*range(1, 9), 8]
    assert TIMES | {"loss", "masked_loss", "learning_rate"} <= lines[0].keys()
    assert 0.0 <= lines[0]["waiting_share"] <= 1.0
    assert lines[-1]["val_normal_mae"] == result.metrics["val_normal_mae"] > 0.0


def test_tensorboard_is_an_extra(folder: Path, tmp_path: Path) -> None:
    pytest.importorskip("tensorboard")
    train(NormalStage(replace(QUICK, steps=1)), folder, tmp_path, tensorboard=True)
    assert list((tmp_path / "tensorboard").glob("events.out.tfevents.*"))


def test_best_and_last_weights_are_kept(folder: Path, tmp_path: Path) -> None:
    result = train(NormalStage(replace(QUICK, validate_every=2)), folder, tmp_path)
    lines = [json.loads(line) for line in (tmp_path / METRICS).read_text().splitlines()]
    values = {line["step"]: line["val_normal_mae"] for line in lines if "val_normal_mae" in line}
    best = load_weights(tmp_path / "nenet-best.safetensors").metadata
    assert best["metrics"]["val_normal_mae"] == min(values.values()) == values[best["step"]]
    assert load_weights(result.weights["nenet"]).metadata["step"] == 8


def test_averaged_weights_are_validated_saved_and_resumed(folder: Path, tmp_path: Path) -> None:
    config = replace(QUICK, ema=0.5, steps=4)
    stage = NormalStage(config)
    result = train(stage, folder, tmp_path / "whole")
    saved = load_file(result.weights["nenet"])
    moving = stage.network.state_dict()
    assert not torch.equal(saved["normal.weight"], moving["normal.weight"])
    # The average of decay 0.5 over four steps is nearer to the last weights than the first weights are.
    first = NormalStage(config).network.state_dict()["normal.weight"]
    last = moving["normal.weight"]
    assert float((saved["normal.weight"] - last).norm()) < float((first - last).norm())
    train(NormalStage(config), folder, tmp_path / "parts", loggers=[StopAt(2)])
    train(NormalStage(config), folder, tmp_path / "parts")
    assert_same_run(tmp_path / "whole", tmp_path / "parts")


def test_the_last_steps_have_a_line_of_metrics_however_few_they_are(folder: Path, tmp_path: Path) -> None:
    for steps, lines in ((2, [2]), (4, [3, 4])):
        config = replace(QUICK, steps=steps, log_every=3, validation_scenes=0, validate_every=0)
        place = tmp_path / str(steps)
        train(NormalStage(config), folder, place)
        rows = read_metrics(next(place.rglob("metrics.jsonl")))
        assert [row["step"] for row in rows if "loss" in row] == lines
        write_curves(next(place.rglob("metrics.jsonl")), tmp_path / "curves.png")


def test_weights_that_are_kept_may_hold_a_share_of_the_start(folder: Path, tmp_path: Path) -> None:
    config = replace(QUICK, start="before", start_share=0.25, steps=2)
    stage = NormalStage(config)
    first = {name: weight.clone() for name, weight in stage.network.state_dict().items()}
    result = train(stage, folder, tmp_path / "whole")
    saved, last = load_file(result.weights["nenet"]), stage.network.state_dict()
    for name, weight in last.items():
        assert torch.allclose(saved[name], 0.25 * first[name] + 0.75 * weight, atol=1e-7), name
    assert not torch.equal(saved["normal.weight"], last["normal.weight"])
    train(NormalStage(config), folder, tmp_path / "parts", loggers=[StopAt(1)])
    train(NormalStage(config), folder, tmp_path / "parts")
    assert_same_run(tmp_path / "whole", tmp_path / "parts")


def test_weights_that_the_start_lacks_are_kept_as_they_are_trained() -> None:
    small = {"width": 8, "blocks": 1}
    start = TrainedModel("frames", create("frames", **small), small, {})
    config = NormalTraining(start="before", start_share=0.25, options=small | {"covariance": True}, lights="true")
    stage = create_stage("mine", "frames", config, {"start": start})
    assert stage.added == {"about.weight"}
    kept = KeptWeights(stage.network, 0.0, config.start_share, stage.added)
    with torch.no_grad():
        for weight in stage.network.parameters():
            weight += 1.0
    first, mixed = start.network.state_dict(), kept.network().state_dict()
    assert (mixed.pop("about.weight") == 1.0).all()
    assert all(torch.allclose(weight, first[name] + 0.75) for name, weight in mixed.items())


def test_a_step_whose_gradient_is_not_finite_is_left_out_and_many_end_training(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    config, clip, bad = replace(QUICK, clip_gradient=1.0), torch.nn.utils.clip_grad_norm_, {3}
    calls = count(1)

    def clip_some(parameters, limit):
        kept = list(parameters)
        if next(calls) in bad:
            for parameter in kept:
                parameter.grad.fill_(torch.nan)
        return clip(kept, limit)

    monkeypatch.setattr(torch.nn.utils, "clip_grad_norm_", clip_some)
    result = train(NormalStage(config), folder, tmp_path / "one")
    assert result.steps == 8 and all(torch.isfinite(each).all() for each in load_file(result.weights["nenet"]).values())
    assert rows(tmp_path / "one")[2]["gradient_norm"] == 0.0
    bad.update(range(1, 100))
    with pytest.raises(
        InputError, match="the gradient is not finite in 5 steps in a row, to 5; nothing was saved before"
    ):
        train(NormalStage(config), folder, tmp_path / "all")


@pytest.mark.slow
def test_compiled_networks_take_the_same_steps(folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    if shutil.which("g++") is None:
        pytest.skip("torch.compile needs a C++ compiler on a CPU")
    # Torch keeps what it compiled, and crashes where that was for a processor of another kind.
    monkeypatch.setenv("TORCHINDUCTOR_CACHE_DIR", str(tmp_path / "compiled"))
    losses = []
    for compiled in (False, True):
        out = tmp_path / str(compiled)
        config = LightingTraining(steps=3, batch_scenes=2, images=4, workers=0, log_every=1, validation_scenes=0,
                                  precision="bfloat16", compile=compiled)  # fmt: skip
        train(LightingStage(config), folder, out)
        losses.append([row["loss"] for row in rows(out)])
    assert losses[0] == pytest.approx(losses[1], rel=0.02)  # bfloat16 rounds elsewhere


def test_a_stage_is_made_for_every_model(folder: Path) -> None:
    for name, item in MODELS.items():
        needed = recipes.run(name, {}, {}).requires
        trained = {
            use: TrainedModel(run, create(run).eval(), {}, {"config": {"augmentation": {}}})
            for use, run in needed.items()
        }
        stage = create_stage(name, name, recipes.run(name, {}, {}).config, trained)
        assert stage.goal == ("direction_mae" if item.role == "lighting" else "normal_mae")


def test_loss_that_is_not_finite_ends_the_run(folder: Path, tmp_path: Path) -> None:
    stage = NormalStage(QUICK)
    torch.nn.init.constant_(stage.network.normal.weight, float("nan"))
    with pytest.raises(InputError, match="lower learning_rate"):
        train(stage, folder, tmp_path)
    assert not (tmp_path / CHECKPOINT).exists()


def test_accumulated_gradients_are_those_of_the_whole_batch(folder: Path, tmp_path: Path) -> None:
    outs = []
    for accumulate in (1, 2):
        config = LightingTraining(
            steps=1, batch_scenes=2, images=2, accumulate=accumulate, workers=0, log_every=1, validation_scenes=0
        )
        train(LightingStage(config), folder, tmp_path / str(accumulate))
        outs.append(rows(tmp_path / str(accumulate))[0]["loss"])
    assert outs[0] == pytest.approx(outs[1], rel=1e-5)


def untrained_lcnet() -> TrainedModel:
    return TrainedModel("lcnet", create("lcnet").eval(), {"direction_classes": 36, "intensity_classes": 20},
                        {"config": {"augmentation": {}}, "data": "d", "step": 1})  # fmt: skip


def test_stage_two_leaves_the_lighting_network_as_it_is(folder: Path, tmp_path: Path) -> None:
    lighting = untrained_lcnet()
    before = {name: tensor.clone() for name, tensor in lighting.network.state_dict().items()}
    stage = NormalStage(replace(QUICK, steps=2, lights="lcnet"), lighting)
    result = train(stage, folder, tmp_path)
    assert all(torch.equal(tensor, before[name]) for name, tensor in lighting.network.state_dict().items())
    assert load_weights(result.weights["nenet"]).metadata["lighting"]["data"] == "d"
    # NENet is given class centres, not the true lights.
    dataset = SceneDataset(folder, "train", stage.sample_options())
    lights = stage.lights(collate([dataset.sample(SampleKey(0, 0, 0))]))
    classes = lighting.network.classes
    labels = classes.encode(lights.directions, lights.intensities)
    torch.testing.assert_close(classes.decode(*labels)[0], lights.directions)


def test_lights_are_moved_some_of_the_way_to_the_true_ones(folder: Path) -> None:
    lighting = untrained_lcnet()
    stages = [NormalStage(replace(QUICK, lights="lcnet", light_blend=blend), lighting) for blend in (0.0, 1.0)]
    dataset = SceneDataset(folder, "train", stages[0].sample_options())
    batch = collate([dataset.sample(SampleKey(scene, 0, scene)) for scene in range(4)])
    found, blended = (stage.training_lights(batch) for stage in stages)
    torch.testing.assert_close(stages[1].lights(batch).directions, found.directions)  # in validation all as found
    torch.testing.assert_close(blended.directions.norm(dim=-1), torch.ones(4, 2))
    share = (blended.intensities - found.intensities) / (batch.intensities - found.intensities)  # one for a sample
    torch.testing.assert_close(share[:, 0], share[:, 1], rtol=1e-3, atol=1e-3)
    assert ((share > 0.0) & (share < 1.0)).all() and share[:, 0].std() > 0.05
    whole = (found.directions * batch.directions).sum(-1).arccos()
    np.testing.assert_array_less((blended.directions * batch.directions).sum(-1).arccos(), whole + 1e-4)
    torch.testing.assert_close(stages[1].training_lights(batch), blended)  # by the samples' seeds alone
    true = NormalStage(replace(QUICK, light_blend=1.0)).training_lights(batch)
    torch.testing.assert_close(true.directions, batch.directions)


def test_validation_may_see_more_images_than_training(folder: Path, tmp_path: Path) -> None:
    stage = NormalStage(replace(QUICK, validation_images=4))
    assert (stage.sample_options().images, stage.validation_options().images) == (2, 4)
    few, many = (train(NormalStage(replace(QUICK, steps=1, validation_images=count)), folder, tmp_path / str(count))
                 for count in (None, 4))  # fmt: skip
    assert few.metrics["val_normal_mae"] != many.metrics["val_normal_mae"]
    saved = [load_file(result.weights["nenet"]) for result in (few, many)]
    assert all(torch.equal(tensor, saved[1][name]) for name, tensor in saved[0].items())


def test_weights_carry_their_origin(uninterrupted: tuple) -> None:
    model = load_weights(uninterrupted[1].weights["nenet"])
    assert model.metadata["step"] == 8
    assert len(model.metadata["data"]) == 64
    assert build(NormalTraining, model.metadata["config"]) == QUICK
    assert model.augmentation() == QUICK.augmentation


def test_half_precision_weights_load_as_float32(tmp_path: Path) -> None:
    model = TrainedModel("nenet", create("nenet"), {}, {"config": {"augmentation": {}}})
    save_weights(tmp_path / "whole.safetensors", model)
    save_weights(tmp_path / "half.safetensors", model, half=True)
    assert (tmp_path / "half.safetensors").stat().st_size < 0.51 * (tmp_path / "whole.safetensors").stat().st_size
    loaded = load_weights(tmp_path / "half.safetensors").network
    for name, tensor in loaded.state_dict().items():
        assert tensor.dtype == torch.float32
        torch.testing.assert_close(tensor, model.network.state_dict()[name], atol=1e-3, rtol=1e-3)


def test_the_same_model_gives_the_same_bytes(tmp_path: Path) -> None:
    # The library leaves the order of the header to chance: eight tries in fresh hash maps would differ.
    model = TrainedModel("nenet", create("nenet"), {}, {"config": {"augmentation": {}}, "code": "Zürich"})
    files = [tmp_path / f"{number}.safetensors" for number in range(8)]
    for file in files:
        save_weights(file, model)
    assert len({file.read_bytes() for file in files}) == 1
    assert load_weights(files[0]).metadata["code"] == "Zürich"
    (tmp_path / "plain").touch()
    assert files[0].stat().st_mode == (tmp_path / "plain").stat().st_mode  # the library itself: the owner alone


def test_unusable_weights_are_refused_in_one_line(uninterrupted: tuple, tmp_path: Path) -> None:
    weights = uninterrupted[1].weights["nenet"]
    cut, text = tmp_path / "cut.safetensors", tmp_path / "text.safetensors"
    cut.write_bytes(weights.read_bytes()[:-1000])
    text.write_text("not weights")
    misfit = tmp_path / "misfit.safetensors"
    save_weights(
        misfit, TrainedModel("lcnet", create("lcnet"), {"intensity_classes": 10}, {"config": {"augmentation": {}}})
    )
    headless, foreign = tmp_path / "headless.safetensors", tmp_path / "foreign.safetensors"
    save_weights(headless, TrainedModel("nenet", create("nenet"), {}, {}))
    save_weights(foreign, TrainedModel("nenet2", create("nenet"), {}, {"config": {"augmentation": {}}}))
    cases = [
        (cut, "damaged or not a safetensors"),
        (text, "damaged or not a safetensors"),
        (tmp_path / "none.safetensors", "no such weights"),
        (misfit, "do not fit"),
        (headless, "damaged header"),
        (foreign, "a model this version does not know"),
    ]
    for number, (options, message) in enumerate((
        ("abc", "damaged header"), ({"direction_classes": 10**12}, "do not fit"), ({"use_mask": {}}, "damaged header"),
        ({"intensity_range": [[]]}, "damaged header"), ({"none": 1}, "damaged header .*unknown option"),
    )):  # fmt: skip
        odd = tmp_path / f"odd{number}.safetensors"
        save_weights(odd, TrainedModel("lcnet", create("lcnet"), options, {"config": {"augmentation": {}}}))
        cases.append((odd, message))
    for path, message in cases:
        with pytest.raises(InputError, match=message) as error:
            load_weights(path)
        assert "\n" not in str(error.value)
