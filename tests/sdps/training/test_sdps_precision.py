"""Which arithmetic is chosen, that it is said, and that a run survives a change of it."""

import json
import logging
import os
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from sdps_scenes import write_data

from lab.shared.machines import HELD, hold, kinds
from pipelines.cli import main
from render.shared.errors import InputError
from sdps.core import precision
from sdps.core.precision import arithmetic
from sdps.models.checkpoint import load_weights
from sdps.training.stage_factory import create_stage
from sdps.training.trainer import train
from sdps.training.training_config import NormalTraining


@pytest.fixture(autouse=True)
def forgotten() -> Iterator[None]:
    """Let every test, and what follows, measure again."""
    yield
    precision._resolve.cache_clear()
    precision._speed.cache_clear()


def pretend(monkeypatch: pytest.MonkeyPatch, ratio: float) -> None:
    """Let bfloat16 be so many times as fast as float32."""
    precision._resolve.cache_clear()
    precision._speed.cache_clear()
    monkeypatch.setattr(precision, "_measure_ratio", lambda side: ratio)


@pytest.mark.parametrize(("ratio", "chosen"), [(2.3, "bfloat16"), (1.1, "float32"), (0.07, "float32")])
def test_auto_takes_bfloat16_only_where_it_is_clearly_faster(monkeypatch, ratio: float, chosen: str) -> None:
    pretend(monkeypatch, ratio)
    found = arithmetic()
    assert found.precision == chosen and found.device == "cpu"
    assert f"{ratio:.2g} times as fast" in found.describe()
    with found.autocast():
        product = torch.ones(2, 2) @ torch.ones(2, 2)
    assert product.dtype == getattr(torch, chosen)


def test_it_is_measured_once_per_process(monkeypatch: pytest.MonkeyPatch) -> None:
    pretend(monkeypatch, 2.3)
    assert arithmetic() is arithmetic("auto", "cpu")
    monkeypatch.setattr(precision, "_measure_ratio", lambda side: 0.07)
    assert arithmetic("float32").precision == "float32" and arithmetic().precision == "bfloat16"


def test_bfloat16_where_it_is_slow_is_obeyed_with_one_warning(monkeypatch, caplog: pytest.LogCaptureFixture) -> None:
    pretend(monkeypatch, 0.07)
    with caplog.at_level(logging.WARNING):
        assert arithmetic("bfloat16").precision == arithmetic("bfloat16").precision == "bfloat16"
    (record,) = caplog.records
    assert "0.07 times as fast as float32" in record.message and "use auto or float32" in record.message


def test_unknown_precisions_are_one_line(capsys: pytest.CaptureFixture, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="unknown precision 'bfloat'; did you mean 'bfloat16'"):
        arithmetic("bfloat")
    assert main(["infer", str(tmp_path), "--precision", "float33"]) == 2
    message = capsys.readouterr().err
    assert "did you mean 'float32'" in message and message.count("\n") == 1


@pytest.mark.parametrize(("capability", "chosen"), [((7, 5), "float32"), ((8, 0), "bfloat16"), ((9, 0), "bfloat16")])
def test_gpus_have_bfloat16_from_ampere_on(monkeypatch, capability: tuple, chosen: str) -> None:
    monkeypatch.setattr(torch.cuda, "get_device_capability", lambda: capability)
    monkeypatch.setattr(torch.cuda, "get_device_name", lambda: "A GPU")
    precision._speed.cache_clear()
    precision._resolve.cache_clear()
    assert arithmetic("auto", "cuda").precision == chosen
    assert arithmetic("auto", torch.device("cuda", 1)).precision == chosen
    assert "A GPU" in arithmetic("auto", "cuda").reason


def test_the_same_in_inference_mode() -> None:
    with torch.inference_mode():  # which takes no gradients; those of the measurement are taken all the same
        found = arithmetic()
    assert found.reason.endswith("measured)")
    assert found.precision == ("bfloat16" if precision._speed("cpu")[0] >= precision._WORTHWHILE else "float32")


@pytest.mark.skipif(HELD not in kinds(), reason="the processor has nothing beyond AVX2")
def test_held_to_avx2_a_processor_computes_in_float32() -> None:
    code = "from sdps.core.precision import arithmetic; print(arithmetic().describe())"
    with hold(HELD):
        done = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True)
    assert done.stdout.startswith("float32 on cpu") and "AVX2, measured" in done.stdout
    assert os.environ.get("ATEN_CPU_CAPABILITY") != "avx2"  # of this process nothing has changed


def test_a_run_goes_on_in_another_arithmetic_and_says_so(tmp_path: Path, monkeypatch, caplog) -> None:
    data = tmp_path / "data"
    write_data(data, ("train",) * 4, size=16)
    settings = NormalTraining(steps=2, batch_scenes=2, images=4, size=16, lights="true", workers=0, log_every=1,
                              validation_scenes=0, schedule="constant", halve_after=())  # fmt: skip
    pretend(monkeypatch, 2.3)
    train(create_stage("psfcn", "psfcn", settings, {}), data, tmp_path / "run")
    pretend(monkeypatch, 0.07)
    with caplog.at_level(logging.WARNING):
        longer = replace(settings, steps=4)
        train(create_stage("psfcn", "psfcn", longer, {}), data, tmp_path / "run")
    assert any("began in bfloat16 and goes on in float32" in record.message for record in caplog.records)
    metadata = load_weights(tmp_path / "run" / "psfcn.safetensors").metadata
    assert [(part["step"], part["precision"]) for part in metadata["computed"]] == [(0, "bfloat16"), (2, "float32")]
    json.dumps(metadata)
