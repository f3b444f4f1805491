"""Evaluation and noise on a Dask cluster: what one process finds, and refusals in one line."""

import contextlib
import json
import os
import signal
from collections.abc import Iterator
from pathlib import Path

import pytest
from benchmark_folders import run, write_diligent

from pipelines import cli
from pipelines.evaluate import elsewhere
from pipelines.shared.cluster import mapped
from pipelines.shared.cluster.cluster_config import ClusterChoice
from render.running.cluster_worker import Mismatch
from render.shared.errors import InputError
from sdps.methods.pretrained import shipped_folder

distributed = pytest.importorskip("distributed")


@contextlib.contextmanager
def workers(count: int = 1) -> Iterator[str]:
    """Yield the address of a scheduler with workers."""
    with distributed.LocalCluster(
        n_workers=count, threads_per_worker=1, dashboard_address=":0", silence_logs=50
    ) as cluster:
        yield cluster.scheduler_address


@pytest.fixture(scope="module")
def address() -> Iterator[str]:
    with workers() as found:
        yield found


def squared(number: int) -> int:
    return number * number


def picky(number: int) -> int:
    raise Mismatch(f"refuses {number}") if number == 3 else InputError(f"{number}: bad")


def deadly(folder: Path) -> int:
    """Kill the worker, once."""
    mark = folder / "killed"
    if not mark.exists():
        mark.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return 7


def here() -> str:
    return "same"


def process() -> int:
    return os.getpid()


def test_jobs_come_back_and_what_differs_is_refused(address):
    choice = ClusterChoice(name=address)
    assert sorted(mapped.mapped(choice, squared, iter(range(20)), here)) == [number**2 for number in range(20)]
    with pytest.raises(InputError, match=rf"--cluster {address}: a worker has other versions, code or files"):
        list(mapped.mapped(choice, squared, [1], process))
    with pytest.raises(InputError, match=rf"--cluster {address}: a worker refuses 3"):
        list(mapped.mapped(choice, picky, [3], here))
    with pytest.raises(InputError, match=r"^4: bad$"):
        list(mapped.mapped(choice, picky, [4], here))


def test_a_worker_that_dies_costs_no_job(tmp_path):
    with workers() as address:
        assert list(mapped.mapped(ClusterChoice(name=address), deadly, [tmp_path], here)) == [7]


def test_benchmarks_score_what_one_process_scores(address, tmp_path, monkeypatch, capsys):
    tree = write_diligent(tmp_path / "tree", ("ball", "bear"), "--bits", "16")
    own = tmp_path / "own.safetensors"  # not where workers would look: it travels with the jobs
    own.write_bytes((shipped_folder() / "lcnet.safetensors").read_bytes())
    words = ["eval-diligent", str(tree), "--bits", "16", "--methods", f"least-squares,{own}+least-squares,constant"]
    assert run(*words, "--out", tmp_path / "a") == 0
    words += ["--cluster", address, "--out", str(tmp_path / "b")]
    assert run(*words) == 0
    monkeypatch.setattr(elsewhere, "mapped", None)  # nothing is left to do
    assert run(*words) == 0
    a, b = (json.loads((tmp_path / name / "diligent" / "results.json").read_text())["methods"] for name in "ab")
    assert {name: {key: one["scores"] for key, one in row.items()} for name, row in a.items()} == {
        name: {key: one["scores"] for key, one in row.items()} for name, row in b.items()
    }
    maps = [
        {path.name: path.read_bytes() for path in (tmp_path / name / "diligent" / "cache" / "maps").iterdir()}
        for name in "ab"
    ]
    assert maps[0] == maps[1] and maps[0]


def test_the_kind_of_processor_must_agree(monkeypatch, tmp_path):
    job = elsewhere.Job(None, ((elsewhere.Method(name="constant", normals="constant"), "other"),), {}, None, ())
    with pytest.raises(Mismatch, match="runs constant on another kind of processor"):
        elsewhere.evaluate_there(job)


@pytest.mark.slow
def test_noise_is_what_one_process_measures(address, tmp_path, capsys):
    words = ["noise", "--shapes", "sphere,blobby:1", "--materials", "chrome,nylon", "--spp", "4", "--reference", "16"]
    words += ["--size", "16", "--lights", "2"]
    assert cli.main([*words, "--out", str(tmp_path / "a")]) == 0
    assert cli.main([*words, "--out", str(tmp_path / "b"), "--cluster", address]) == 0
    for name in ("noise.json", "noise.md"):
        assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes()


@pytest.mark.slow
def test_test_scenes_score_what_one_process_scores(address, tmp_path, capsys):
    words = ["eval-merltest", "--preset", "smoke", "--set", "test.size=32", "--set", "test.spp=4"]
    words += [
        "--set",
        "test.materials=[chrome, nylon]",
        "--set",
        "test.repeats=2",
        "--normals",
        "least-squares",
        "--lights",
        "true",
    ]
    assert cli.main([*words, "--out", str(tmp_path / "a")]) == 0
    capsys.readouterr()
    assert cli.main([*words, "--out", str(tmp_path / "b"), "--cluster", address]) == 0
    a, b = (json.loads((tmp_path / name / "eval" / "results.json").read_text()) for name in "ab")
    assert a["scenes"] == b["scenes"] and len(a["scenes"]) > 1 and a["tables"] == b["tables"]
