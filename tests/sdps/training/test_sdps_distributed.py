"""Several processes of `torchrun` take the steps one process takes."""

import json
import os
import runpy
import subprocess
import sys
from pathlib import Path

import pytest
from safetensors.torch import load_file
from sdps_scenes import write_data

from render.shared.errors import InputError
from sdps.training.distributed import team

SCRIPT = """
import os
import signal
import sys
from sdps.training.training_config import NormalTraining
from sdps.training.stages import NormalStage
from sdps.training.trainer import train

config = NormalTraining(
    steps=int(sys.argv[4]), batch_scenes=4, images=2, size=32, crop=16, lights="true", log_every=1, workers=0,
    validation_scenes=2, validate_every=2, schedule=sys.argv[5], clip_gradient=1.0, ema=0.5,
    accumulate=int(sys.argv[3]),
    checkpoint_minutes=1e-9,  # after every step
    precision="float32",  # in bfloat16 the order of a sum, which differs, shows at 2e-4
)


class Dies:  # kills the second process once, at a step
    def log(self, step, values):
        if f"{step} {os.environ.get('RANK')} {os.environ.get('TORCHELASTIC_RESTART_COUNT')}" == f"{sys.argv[6]} 1 0":
            os.kill(os.getpid(), signal.SIGKILL)

    def close(self):
        pass


result = train(NormalStage(config), sys.argv[1], sys.argv[2], loggers=[Dies()])
assert result.steps == int(sys.argv[4]), result
"""


def run(
    folder: Path,
    out: Path,
    processes: int,
    accumulate: int = 1,
    steps: int = 4,
    schedule: str = "cosine",
    dies: int = 0,
) -> list[dict]:
    """Train in this process, or several under torchrun; return the metrics without what measures time."""
    script = out.with_suffix(".py")
    script.write_text(SCRIPT)
    words = [str(script), *map(str, (folder, out, accumulate, steps, schedule, dies))]
    if processes == 1:
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(sys, "argv", words)
            runpy.run_path(str(script))
    else:
        launch = ("-m", "torch.distributed.run", "--standalone", "--max-restarts", "1", "--nproc-per-node")
        environment = os.environ | {"OMP_NUM_THREADS": "1", "TORCH_DISABLE_SHARE_RDZV_TCP_STORE": "1"}
        command = [sys.executable, *launch, str(processes), *words]
        done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr[-2000:]
    lines = [json.loads(line) for line in (out / "metrics.jsonl").read_text().splitlines()]
    timed = {"seconds", "images_per_second", "waiting_share"}
    return [{key: value for key, value in line.items() if key not in timed} for line in lines]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("data")
    write_data(path, ("train",) * 6 + ("val", "val"), lights=4, size=32)
    return path


def test_two_processes_give_the_losses_of_one(folder: Path, tmp_path: Path) -> None:
    alone, together = run(folder, tmp_path / "one", 1), run(folder, tmp_path / "two", 2)
    assert [line["step"] for line in alone] == [line["step"] for line in together]
    for first, second in zip(alone, together, strict=True):
        assert first.keys() == second.keys()
        for key, value in first.items():
            assert second[key] == pytest.approx(value, rel=2e-4, abs=1e-6), (first["step"], key)
    weights = [load_file(tmp_path / name / "nenet.safetensors") for name in ("one", "two")]
    for name, tensor in weights[0].items():
        assert float((tensor - weights[1][name]).abs().max()) < 2e-3, name


@pytest.mark.slow
def test_accumulation_and_another_number_of_processes_keep_the_batch(folder: Path, tmp_path: Path) -> None:
    """Four parts of one scene in one process, for all steps, or for two and then two parts in each of two processes."""
    alone = run(folder, tmp_path / "one", 1, accumulate=4, schedule="constant")
    run(folder, tmp_path / "two", 1, accumulate=4, steps=2, schedule="constant")
    shared = run(folder, tmp_path / "two", 2, accumulate=4, schedule="constant")
    for key, tolerance in (("loss", 2e-4), ("gradient_norm", 2e-3)):
        found, wanted = ({line["step"]: line[key] for line in lines if key in line} for lines in (shared, alone))
        assert len(wanted) == 4 and found == pytest.approx(wanted, rel=tolerance)


@pytest.mark.slow
def test_a_killed_process_is_started_again_and_goes_on_from_the_checkpoint(folder: Path, tmp_path: Path) -> None:
    alone, killed = run(folder, tmp_path / "one", 1, steps=6), run(folder, tmp_path / "two", 2, steps=6, dies=4)
    found, wanted = ([(line["step"], line["loss"]) for line in lines if "loss" in line] for lines in (killed, alone))
    assert [step for step, _ in found] == [step for step, _ in wanted] and found  # every step once
    assert [value for _, value in found] == pytest.approx([value for _, value in wanted], rel=2e-4)


def test_a_batch_that_cannot_be_shared_is_refused(folder: Path, tmp_path: Path) -> None:
    script = tmp_path / "odd.py"
    script.write_text(SCRIPT.replace("batch_scenes=4", "batch_scenes=3"))
    command = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2", str(script)]
    done = subprocess.run(
        [*command, str(folder), str(tmp_path / "out"), "1", "4", "cosine", "0"], capture_output=True, text=True,
        check=False, env=os.environ | {"OMP_NUM_THREADS": "1"},
    )  # fmt: skip
    assert done.returncode != 0
    assert "batch_scenes 3 cannot be shared by 2 processes" in done.stderr  # torchrun's own lines follow at any length


def test_restarts_that_would_hang_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    for name, value in {
        "WORLD_SIZE": "2",
        "TORCHELASTIC_USE_AGENT_STORE": "True",
        "TORCHELASTIC_MAX_RESTARTS": "3",
    }.items():
        monkeypatch.setenv(name, value)
    with pytest.raises(InputError, match="set TORCH_DISABLE_SHARE_RDZV_TCP_STORE=1"), team("cpu"):
        pass
