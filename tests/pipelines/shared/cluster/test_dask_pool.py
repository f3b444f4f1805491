"""Rendering on a Dask cluster: its records are those of a local run, whatever happens to workers and scheduler.

Most tests run processes that only pretend to render, on two workers of this machine.
"""

import contextlib
import json
import multiprocessing
import os
import re
import signal
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import pytest
from pretend_renderer import pretend, stillborn

from pipelines import cli
from pipelines.shared.cluster import link
from pipelines.shared.cluster.cluster_config import ClusterChoice, ClusterConfig
from pipelines.shared.cluster.dask_pool import open_pool
from render.backend import variant
from render.planning import chunks
from render.planning.chunks import Chunk
from render.records import ledger
from render.records.ledger import Ledger
from render.records.manifest import SceneSpec, View
from render.records.shards import file_hash, read_shard
from render.running import cluster_worker
from render.running.cluster_worker import ClusterWorker, make_task
from render.running.protocol import Failure
from render.running.supervisor import RunOptions, RunSummary, render_supervised
from render.running.worker_pool import LocalPool
from render.shared.errors import InputError

distributed = pytest.importorskip("distributed")
LIGHTS = ((0.0, 0.0, 1.0), (0.6, 0.0, 0.8))
HANGS = 3.0  # seconds, which no other scene takes, however busy the machine


def planned(materials: list[list[str]]) -> list[SceneSpec]:
    """Return a plan of one view per inner list, each of a shape of its own, with these materials."""
    return [
        SceneSpec(
            id=f"s{shape}-m{slot}", seed=shape, split="train", shape=f"blobby:{shape}", material=material, view=View(),
            lights=LIGHTS, size=16, spp=4, bounces=0,
        )
        for shape, row in enumerate(materials)
        for slot, material in enumerate(row)
    ]  # fmt: skip


@contextlib.contextmanager
def workers(count: int = 2, **options) -> Iterator[str]:
    """Yield the address of a scheduler with workers."""
    with distributed.LocalCluster(
        n_workers=count, threads_per_worker=1, dashboard_address=":0", silence_logs=50, **options
    ) as cluster:
        yield cluster.scheduler_address


@pytest.fixture(scope="module")
def address() -> Iterator[str]:
    with workers() as found:
        yield found


def run(
    scenes: list[SceneSpec], folder: Path, address: str, serve=pretend, timeout=60.0, patience=300.0, **options
) -> RunSummary:
    choice = ClusterChoice(name=address, config=ClusterConfig(patience=patience))
    with open_pool(choice, folder, timeout=timeout, serve=serve) as pool:
        return render_supervised(scenes, folder, RunOptions(**options), pool=pool)


def files(folder: Path) -> dict[str, str]:
    return {path.name: file_hash(path) for path in (folder / "shards").glob("*.exr")}


def failures(folder: Path) -> dict[str, str]:
    return {line["id"]: line["reason"] for line in map(json.loads, (folder / "failed.jsonl").read_text().splitlines())}


def rendering(address: str) -> int:
    """Return how many rendering processes the cluster has."""
    with distributed.Client(address, set_as_default=False) as client:
        return sum(client.run(lambda: len(multiprocessing.active_children())).values())


def test_records_and_bytes_are_those_of_a_local_run(tmp_path, address):
    scenes = planned([["ok", "raise", "ok"], ["ok", "hang"], ["die", "ok"], ["ok", "quit"], ["ok"] * 4])
    here = render_supervised(scenes, tmp_path / "a", RunOptions(workers=2, timeout=HANGS), serve=pretend)
    there = run(scenes, tmp_path / "b", address, timeout=HANGS)
    assert (there.scenes, there.done, len(there.failed)) == (here.scenes, here.done, len(here.failed)) == (13, 9, 4)
    assert files(tmp_path / "a") == files(tmp_path / "b") and failures(tmp_path / "a") == failures(tmp_path / "b")
    assert len(ledger.survey(tmp_path / "b", scenes).lines) == 9  # all in the ledger, once
    assert there.workers == 2 and {line["worker"] for line in there.lines} <= {0, 1}
    assert rendering(address) == 0  # the cluster is left clean
    again = run(scenes, tmp_path / "b", address)
    assert (again.done, again.skipped, again.lines) == (9, 4, [])
    assert run(scenes, tmp_path / "b", address, timeout=HANGS, retry_failed=True).failed[0]["attempt"] == 2


@pytest.mark.parametrize("name", ["sdps", "fitted materials", "code of the renderer"])
def test_what_differs_is_refused(tmp_path, address, monkeypatch, name):
    there = dict(cluster_worker.describe_installation()) | {name: "other"}
    monkeypatch.setattr(cluster_worker, "describe_installation", lambda: there)
    with pytest.raises(InputError, match=rf"a worker has {name} .*, the run other; install the same sdps on both"):
        run(planned([["ok"]]), tmp_path, address)
    assert not files(tmp_path)


@pytest.mark.parametrize(
    ("shape", "material", "file"),
    [
        ("sphere", "{0}/mine.yaml", "mine.yaml"),
        ("sphere", "patches:7:chrome+{0}/mine.binary", "mine.binary"),
        ("sphere", "procedural:wood:7:{0}/mine.bsdf+chrome", "mine.bsdf"),
        ("sphere", "maps:2:{0}/maps", "maps/brick_diff.png"),
        ("sphere", "{0}/maps", "maps/brick_diff.png"),
        ("{0}/mine.glb", "chrome", "mine.glb"),
        ("meshes:y:0123456789ab:{0}/mine.obj", "chrome", "mine.obj"),
    ],
)
def test_own_files_are_tied_to_their_content(tmp_path, shape, material, file):
    path = tmp_path / file
    path.parent.mkdir(exist_ok=True)
    path.write_text("a")
    (scene,) = planned([["ok"]])
    scene = replace(scene, shape=shape.format(tmp_path), material=material.format(tmp_path))
    (chunk,) = chunks.cut([scene], {scene.id})
    task = make_task("run", chunk, 1.0)
    cluster_worker.check(task)
    path.write_text("other")
    with pytest.raises(cluster_worker.Mismatch, match=rf"has file {tmp_path}.*put it under the same path there"):
        cluster_worker.check(task)
    path.unlink()
    with pytest.raises(cluster_worker.Mismatch, match=rf"has file {tmp_path}.* missing, the run"):
        cluster_worker.check(task)


def test_shards_name_the_commit_of_the_run(tmp_path, monkeypatch):
    monkeypatch.setattr(cluster_worker, "_commit", lambda: "the run's")
    (scene,) = (replace(scene, shape="sphere", material="chrome", size=8) for scene in planned([["ok"]]))
    (chunk,) = chunks.cut([scene], {scene.id})
    worker = ClusterWorker(tmp_path / "worker")
    rendered = worker.render(make_task("run", chunk, 60.0))
    worker.dismiss()
    (tmp_path / "shards").mkdir()
    (tmp_path / scene.file).write_bytes(rendered.shards[scene.id])
    assert read_shard(tmp_path / scene.file).provenance["commit"] == "the run's"


def test_what_concerns_the_whole_run_stops_it(tmp_path, address):
    with pytest.raises(InputError, match=r"worker tcp.*No space left on device"):
        run(planned([["ok"], ["full"]]), tmp_path / "a", address)
    with pytest.raises(InputError, match=r"worker tcp.*did not start \(worker died, exit code 7\)"):
        run(planned([["ok"]]), tmp_path / "b", address, serve=stillborn)
    with pytest.raises(InputError, match=r"the first 20 scenes all failed"):
        run(planned([["raise"] * 16] * 2), tmp_path / "c", address)
    assert rendering(address) == 0


def test_interrupt_cancels_what_is_out_and_keeps_what_is_back(tmp_path, address, monkeypatch):
    scenes, add = planned([["ok"], ["hang"], ["hang"], ["ok"]]), Ledger.add

    def stop(ledger: Ledger, line: dict) -> None:
        add(ledger, line)
        os.kill(os.getpid(), signal.SIGTERM)

    monkeypatch.setattr(Ledger, "add", stop)
    with pytest.raises(KeyboardInterrupt):
        run(scenes, tmp_path, address)
    assert set(files(tmp_path)) == {"s0-m0.exr"}
    end = time.monotonic() + 60
    while rendering(address) and time.monotonic() < end:
        time.sleep(0.2)
    assert rendering(address) == 0


def test_a_killed_worker_costs_no_scene(tmp_path, monkeypatch):
    scenes, add, lines = planned([["slow"] * 3] * 6), Ledger.add, []
    with workers() as address, distributed.Client(address, set_as_default=False) as client:
        pids = list(client.run(os.getpid).values())

        def kill(ledger: Ledger, line: dict) -> None:
            add(ledger, line)
            lines.append(line["id"])
            if len(lines) == 4:
                os.kill(pids[0], signal.SIGKILL)

        monkeypatch.setattr(Ledger, "add", kill)
        summary = run(scenes, tmp_path, address)
    assert summary.done == 18 and not summary.failed and sorted(lines) == sorted(scene.id for scene in scenes)
    assert all((tmp_path / scene.file).read_bytes() == scene.digest().encode() for scene in scenes)


def test_a_line_that_is_cut_costs_no_scene(tmp_path, address, monkeypatch):
    scenes, add, connect = planned([["slow"] * 3] * 6), Ledger.add, link.Link.connect
    clients, lines = [], []

    def remember(line: link.Link) -> object:
        clients.append(connect(line))
        return clients[-1]

    def cut(ledger: Ledger, line: dict) -> None:
        add(ledger, line)
        lines.append(line["id"])
        if len(lines) == 4:
            clients[0].loop.add_callback(clients[0].scheduler_comm.comm.abort)  # scheduler and workers go on

    monkeypatch.setattr(link.Link, "connect", remember)
    monkeypatch.setattr(Ledger, "add", cut)
    summary = run(scenes, tmp_path, address)
    assert len(clients) == 2 and summary.done == 18 and not summary.failed
    assert sorted(lines) == sorted(scene.id for scene in scenes)
    assert all((tmp_path / scene.file).read_bytes() == scene.digest().encode() for scene in scenes)


@pytest.mark.slow
def test_a_lost_scheduler_is_waited_for(tmp_path, monkeypatch):
    scenes, add = planned([["slow"] * 2] * 8), Ledger.add
    first = contextlib.ExitStack()
    address = first.enter_context(workers(1))
    again, stop = contextlib.ExitStack(), threading.Event()

    def restart() -> None:
        first.close()
        time.sleep(0.5)
        again.enter_context(workers(1, scheduler_port=int(address.rpartition(":")[2])))

    def lose(ledger: Ledger, line: dict) -> None:
        add(ledger, line)
        if not stop.is_set():
            stop.set()
            threading.Thread(target=restart).start()

    monkeypatch.setattr(Ledger, "add", lose)
    with again:
        summary = run(scenes, tmp_path, address)
    assert summary.done == 16 and len({line["id"] for line in summary.lines}) == len(summary.lines) == 16


def test_a_scheduler_that_stays_away_ends_the_run(tmp_path, monkeypatch):
    scenes, add = planned([["slow"] * 2] * 8), Ledger.add
    stack = contextlib.ExitStack()
    address = stack.enter_context(workers(1))

    def lose(ledger: Ledger, line: dict) -> None:
        add(ledger, line)
        stack.close()
        monkeypatch.setattr(link, "ANSWER", 0.5)  # not before: the first connection may take longer

    monkeypatch.setattr(Ledger, "add", lose)
    with pytest.raises(InputError, match=r"no scheduler for 1 s; .*go on \(\d+ scenes of this run are finished and"):
        run(scenes, tmp_path, address, patience=1.0)
    assert 0 < len(files(tmp_path)) < 16


def test_chunks_that_kill_their_workers_are_taken_apart(tmp_path, address):
    views = [replace(scene, shape="sphere") for scene in planned([["ok", "ok"], ["ok"]])]
    chunk = Chunk("sphere", (tuple(views[:2]), tuple(views[2:])), frozenset(scene.id for scene in views))
    error = type("KilledWorker", (Exception,), {})()
    with open_pool(ClusterChoice(name=address), tmp_path) as pool:
        assert pool._handle_error(chunk, error) == []
        assert [part.scenes() for part in pool.queue] == [views[:2], views[2:]]
        (failed,) = pool._handle_error(pool.queue[0], error)
    assert failed.ids == ("s0-m0", "s0-m1") and failed.reason == "every worker that tried it died"


def test_a_process_that_takes_too_much_memory_costs_its_scene(tmp_path):
    worker = ClusterWorker(tmp_path, memory=300 * 2**20)
    (chunk,) = chunks.cut(planned([["ok", "hoard", "ok"]]), {"s0-m0", "s0-m1", "s0-m2"})
    rendered = worker.render(make_task("run", chunk, 60.0, pretend))
    worker.dismiss()
    assert set(rendered.shards) == {"s0-m0", "s0-m2"}
    (failure,) = [outcome for outcome in rendered.outcomes if isinstance(outcome, Failure)]
    assert failure.reason == "took more than 315 MB of memory"


def test_a_worker_with_a_gpu_renders_on_it_one_chunk_at_a_time(tmp_path, monkeypatch):
    monkeypatch.setattr(variant, "choose", lambda: variant.Choice("cuda_ad_rgb", None, "a GPU"))
    worker, together = ClusterWorker(tmp_path), []
    poll = LocalPool.poll
    monkeypatch.setattr(LocalPool, "poll", lambda local: (together.append(worker.gpu.locked()), poll(local))[1])
    parts = [chunks.cut(planned([["variant"], ["variant"]]), {id})[0] for id in ("s0-m0", "s1-m0")]
    with ThreadPoolExecutor(2) as pool:
        rendered = list(pool.map(lambda part: worker.render(make_task("run", part, 60.0, pretend)), parts))
    assert len(worker.idle) == 1 and all(together)  # one process did both
    worker.dismiss()
    assert [list(each.shards.values()) for each in rendered] == [[b"cuda_ad_rgb"]] * 2


class Idle:
    """Stands for a process that a worker keeps."""

    serve, commit, timeout = staticmethod(pretend), cluster_worker._commit(), 60.0

    def __init__(self, errors: Path) -> None:
        self.errors, self.closed = errors, threading.Event()

    def close(self) -> None:
        self.closed.set()


def test_processes_end_when_they_were_idle_for_a_while_and_only_those(tmp_path, monkeypatch):
    monkeypatch.setattr(cluster_worker, "IDLE", 0.2)
    worker, (chunk,) = ClusterWorker(tmp_path), chunks.cut(planned([["ok"]]), {"s0-m0"})
    task = make_task("run", chunk, 60.0, pretend)
    first, second = Idle(tmp_path / "1"), Idle(tmp_path / "2")
    worker._keep(first)
    worker._keep(second)
    assert worker._borrow(task) is first
    assert second.closed.wait(20) and not first.closed.is_set()
    worker._keep(first)
    assert first.closed.wait(20) and not worker.idle
    worker._keep(second)
    worker.dismiss()
    assert not worker.idle


def test_chunks_of_a_cluster_are_bounded_in_bytes():
    scenes = [replace(scene, shape="sphere", size=512) for scene in planned([["ok"]] * 64)]
    whole, bounded = (chunks.cut(scenes, {scene.id for scene in scenes}, 1, limit) for limit in (0, 20_000_000))
    assert max(len(chunk.groups) for chunk in whole) == chunks.VIEWS_PER_CHUNK
    assert max(len(chunk.groups) for chunk in bounded) == 4
    assert [scene for chunk in bounded for scene in chunk.scenes()] == scenes
    assert bounded[0].only(bounded[0].groups[1]).scenes() == list(bounded[0].groups[1])


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (["--cluster", "tcp://127.0.0.1:1"], "no Dask scheduler answers there"),
        (["--cluster", "tcp://nowhere"], "expected tcp://HOST:PORT"),
        (["--cluster", "local:0"], "local:N, N from 1"),
        (["--cluster", "slum"], "did you mean 'slurm'"),
        (["--cluster", "slurm"], "needs --cluster-config FILE"),
        (["--cluster", "slurm", "--cluster-config", "{tmp}/none.yaml"], "no such file"),
        (["--cluster", "slurm", "--cluster-config", "{tmp}/key.yaml"], "key.yaml: .*'job'"),
        (["--cluster", "kubernetes", "--cluster-config", "{tmp}/good.yaml"], "needs the package dask-kubernetes"),
        (["--cluster-config", "x.yaml"], "goes with --cluster"),
        (["--cluster", "local:2", "--workers", "3"], "the cluster decides"),
    ],
)
def test_mistakes_are_one_line(tmp_path, capsys, monkeypatch, flags, message):
    monkeypatch.setattr(link, "ANSWER", 0.3)
    (tmp_path / "key.yaml").write_text("jop: {cores: 1}\n")
    (tmp_path / "good.yaml").write_text("job: {image: some}\n")
    words = [word.format(tmp=tmp_path) for word in flags]
    assert cli.main(["render-data", "--preset", "smoke", "--out", str(tmp_path / "out"), *words]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1 and not (tmp_path / "out").exists()
    assert re.search(message, error), error


def test_ctrl_c_stays_ours(tmp_path, monkeypatch):
    pytest.importorskip("dask_jobqueue")
    before = signal.getsignal(signal.SIGINT)
    monkeypatch.setattr(link.shutil, "which", lambda command: None)
    with pytest.raises(InputError, match="no command sbatch here"):
        link.Link(ClusterChoice(name="slurm", config=ClusterConfig(job={"cores": 1})))
    assert signal.getsignal(signal.SIGINT) is before


@pytest.mark.slow
def test_real_renders_have_the_bytes_of_a_local_run(tmp_path):
    words = ["render-data", "--preset", "smoke", "--set", "data.size=32", "--set", "data.spp=4"]
    assert cli.main([*words, "--out", str(tmp_path / "a")]) == 0
    assert cli.main([*words, "--out", str(tmp_path / "b"), "--cluster", "local:2"]) == 0
    assert files(tmp_path / "a" / "data") == files(tmp_path / "b" / "data")
    a, b = ((tmp_path / name / "data" / "manifest.jsonl").read_bytes() for name in "ab")
    assert a == b


@pytest.mark.slow
def test_test_scenes_have_the_bytes_of_a_plain_run(tmp_path, capsys):
    words = ["regenerate", "--shapes", "sphere", "--materials", "chrome,lambertian:0.5", "--set", "test.size=16"]
    words += ["--set", "test.spp=4"]
    assert cli.main([*words, "--out", str(tmp_path / "a")]) == 0
    assert cli.main([*words, "--out", str(tmp_path / "b"), "--cluster", "local:1"]) == 0
    assert "2 rendered now" in capsys.readouterr().out
    assert files(tmp_path / "a") == files(tmp_path / "b")
