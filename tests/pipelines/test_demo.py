"""The demo's plan: fitted to the machine, said, kept, and carried out by the commands anyone may run."""

import itertools
from pathlib import Path

import pytest

from pipelines import demo
from pipelines.cli import main
from pipelines.shared import demo_plan, presets
from pipelines.shared.demo_plan import NEEDS, make_plan, plan_of

FAST = {"early": 450.0, "lcnet-soft": 135.0, "nenet-plus": 210.0}


def slower(factor: float) -> dict[str, float]:
    return {name: rate / factor for name, rate in FAST.items()}


def test_slow_machines_get_more_minutes_and_fewer_test_scenes() -> None:
    preset = presets.load("demo")
    plans = [make_plan(preset, slower(factor)) for factor in (1.0, 3.0, 5.5, 50.0)]
    for earlier, later in itertools.pairwise(plans):
        assert all(later.minutes[name] >= minutes for name, minutes in earlier.minutes.items())
        assert later.materials <= earlier.materials and len(later.shipped) <= len(earlier.shipped)
    fast, slow = plans[0], plans[2]
    for plan, most in ((fast, 25.0), (slow, 35.0)):
        assert sum(plan.minutes.values()) + plan.evaluation_minutes + 6.0 < most
        for name, minutes in plan.minutes.items():
            assert 60 * minutes * plan.images_per_second[name] >= 0.8 * NEEDS[name].images
    assert "slower than those" in plans[3].describe(preset) and "slower than those" not in slow.describe(preset)


def test_the_plan_is_settings_of_the_preset() -> None:
    plan = make_plan(presets.load("demo"), slower(6.0))
    preset = presets.load("demo", plan.overrides(presets.load("demo")))
    for name, minutes in plan.minutes.items():
        assert preset.run(name).config.minutes == minutes
    assert len(preset.test.materials) == plan.materials and preset.test.shipped == plan.shipped


def test_a_stopped_demo_goes_on_with_the_same_plan(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    preset = presets.load("demo")
    monkeypatch.setattr(demo_plan, "rates", lambda preset: FAST)
    first = plan_of(preset, tmp_path)
    monkeypatch.setattr(demo_plan, "rates", lambda preset: slower(9))
    assert plan_of(preset, tmp_path) == first
    (tmp_path / "plan.json").write_text("{")
    assert main(["demo", "--out", str(tmp_path)]) == 2


def test_commands_run_in_order_and_stop_at_the_first_failure(tmp_path: Path, monkeypatch, capsys) -> None:
    monkeypatch.setattr(demo_plan, "rates", lambda preset: FAST)
    asked = []
    real = demo.main

    def run(argv: list[str]) -> int:
        asked.append(argv)
        return 3 if argv[0] == "train" else 0

    monkeypatch.setattr("pipelines.cli.main", run)
    parser = demo.argparse.ArgumentParser()
    demo.add_arguments(parser)
    code = real(parser.parse_args(["--out", str(tmp_path), "--set", "data.spp=4"]))
    assert code == 3 and [argv[0] for argv in asked] == ["render-data", "train"]
    assert all(argv[argv.index("data.spp=4") - 1] == "--set" for argv in asked)
    assert "In all about" in capsys.readouterr().out
