"""Trials of `--cluster`: workers or the scheduler killed while scenes render, and what one client and scheduler carry.

    python -m lab.studies.cluster_trials kills --times 10
    python -m lab.studies.cluster_trials schedulers --times 10
    python -m lab.studies.cluster_trials plan --chunks 20000
    python -m lab.studies.cluster_trials load --slots 1000 --seconds 5 --bytes 2000000 --chunks 4000
    python -m lab.studies.cluster_trials load --workers 50 --slots 50 --seconds 1 --bytes 1000 --chunks 400

`kills` renders a tiny preset on two workers, kills one (-9) at a random moment of the rendering, and compares manifest
and shards with an undisturbed local run. `schedulers` kills the scheduler instead, and starts it and its workers anew
three seconds later. `load` has tasks that sleep instead of rendering and return random bytes; with `--workers 50` the
workers live in the process of the scheduler and the client, each with a connection and heartbeats of its own.
`plan` tells what a scene of 64 lights takes in the manifest and in the memory of who reads it.
"""

import argparse
import contextlib
import os
import random
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
import tracemalloc
from collections.abc import Callable, Iterator
from pathlib import Path

import dask
import distributed

from lab.shared.memory import resident_bytes
from pipelines.rendering.render_data import plan_scenes
from pipelines.shared import presets
from pipelines.shared.cluster import dask_pool
from pipelines.shared.cluster.cluster_config import ClusterChoice
from render.planning.chunks import Chunk
from render.records import manifest
from render.records.ledger import now, read_runs
from render.records.manifest import SceneSpec, View
from render.records.shards import file_hash
from render.running.cluster_worker import Task, TaskResult
from render.running.protocol import Result
from render.running.supervisor import render_supervised

TINY = ["data.size=32", "data.spp=16", "data.light_count=8", "data.materials_per_view=4", "data.views=1"]


def kills(times: int, seed: int, disturbed: Callable[[presets.Preset, Path, random.Random], int]) -> int:
    """Disturb each of several runs; return 1 if one of them differs from the local run."""
    rng, preset, bad = random.Random(seed), presets.load("smoke", TINY), 0
    with tempfile.TemporaryDirectory() as temporary:
        plain = Path(temporary) / "plain"
        scenes = plan_scenes(preset, plain)
        render_supervised(scenes, plain)
        expected = content(plain)
        for number in range(times):
            folder = Path(temporary) / f"run-{number}"
            done = disturbed(preset, folder, rng)
            found = content(folder)
            wrong = [name for name in sorted(expected | found) if found.get(name) != expected.get(name)]
            if not list_once(folder, scenes):
                wrong.append("ledger")
            bad += bool(wrong)
            said = f"DIFFERS ({', '.join(wrong)})" if wrong else "the bytes of the local run"
            sys.stdout.write(f"run {number + 1}: {done} of {len(scenes)} scenes, {said}\n")
            sys.stdout.flush()
    return int(bad > 0)


def kill_run(preset: presets.Preset, folder: Path, rng: random.Random) -> int:
    """Render on two workers, one of which is killed while scenes are at work; return how many scenes are done."""
    scenes = plan_scenes(preset, folder)
    with cluster(2, 1) as (address, client):
        pids, moments = list(client.run(os.getpid).values()), []

        def kill() -> None:
            while not any(client.run(busy).values()):
                time.sleep(0.1)
            time.sleep(rng.uniform(0.5, 4.0))
            os.kill(rng.choice(pids), signal.SIGKILL)
            moments.append(time.monotonic())

        killer = threading.Thread(target=kill)
        killer.start()
        with dask_pool.open_pool(ClusterChoice(name=address), folder) as pool:
            summary = render_supervised(scenes, folder, pool=pool)
        assert moments, "the run ended before a worker was killed; give it more scenes"
        killer.join()
    return summary.done


def restart_run(preset: presets.Preset, folder: Path, rng: random.Random) -> int:
    """Render while the scheduler is killed and, with its workers, started again; return how many scenes are done."""
    scenes = plan_scenes(preset, folder)
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        address = f"tcp://127.0.0.1:{probe.getsockname()[1]}"
    with contextlib.ExitStack() as first, contextlib.ExitStack() as second:
        (scheduler, *_) = first.enter_context(processes(address))
        moments = []

        def kill() -> None:
            with distributed.Client(address, set_as_default=False) as client:
                while not any(client.run(busy).values()):
                    time.sleep(0.1)
            time.sleep(rng.uniform(0.5, 4.0))
            scheduler.kill()
            moments.append(time.monotonic())
            time.sleep(3.0)
            second.enter_context(processes(address))

        killer = threading.Thread(target=kill)
        killer.start()
        with dask_pool.open_pool(ClusterChoice(name=address), folder) as pool:
            summary = render_supervised(scenes, folder, pool=pool)
        assert moments, "the run ended before the scheduler was killed; give it more scenes"
        killer.join()
    return summary.done


@contextlib.contextmanager
def processes(address: str) -> Iterator[list["subprocess.Popen[bytes]"]]:
    """Start a scheduler and two workers as an operator would; yield the processes, and end them."""
    words = (["scheduler", "--port", address.rpartition(":")[2]], *[["worker", address, "--nthreads", "1"]] * 2)
    started = [
        subprocess.Popen(
            [sys.executable, "-m", "dask", *part, "--no-dashboard"],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        for part in words
    ]
    try:
        with distributed.Client(address, timeout=60, set_as_default=False) as client:
            client.wait_for_workers(2, timeout=60)
        yield started
    finally:
        for process in started:
            process.terminate()
            process.wait()


def busy(dask_worker: distributed.Worker) -> bool:
    """Tell, on a worker, whether it has a task at work."""
    return dask_worker.state.executing_count > 0


def content(folder: Path) -> dict[str, str]:
    """Return the hash of the manifest and of every shard."""
    return {path.name: file_hash(path) for path in [folder / "manifest.jsonl", *(folder / "shards").iterdir()]}


def list_once(folder: Path, scenes: list[SceneSpec]) -> bool:
    """Tell whether every scene stands in the ledger once."""
    ids = [line["id"] for lines in read_runs(folder) for line in lines]
    return sorted(ids) == sorted(scene.id for scene in scenes)


def sleeping(task: Task) -> tuple[str, TaskResult]:
    """Sleep instead of rendering: the shape's name is `SECONDS:BYTES` of the chunk's only scene."""
    seconds, size = task.chunk.shape.split(":")
    time.sleep(float(seconds))
    (scene,) = task.chunk.scenes()
    line = {"id": scene.id, "spec": scene.digest(), "bytes": int(size), "seconds": float(seconds), "stages": {},
            "time": now(), "worker": 0}  # fmt: skip
    return distributed.get_worker().address, TaskResult([Result(line)], {scene.id: os.urandom(int(size))})


def load(slots: int, chunks: int, seconds: float, size: int, workers: int) -> int:
    """Send sleeping chunks through one client; print what it and the scheduler carry."""
    scenes = [
        SceneSpec(id=f"s{number}", seed=0, split="train", shape=f"{seconds}:{size}", material="none", view=View(),
                  lights=((0.0, 0.0, 1.0),) * 64, size=128, spp=1, bounces=0)
        for number in range(chunks)
    ]  # fmt: skip
    parts = [Chunk(scene.shape, ((scene,),), frozenset([scene.id])) for scene in scenes]
    dask_pool.render_task = sleeping
    processes = workers or max(2, min(4, slots // 250))
    with tempfile.TemporaryDirectory() as folder, cluster(processes, slots // processes, not workers) as (address, _):
        before, idle = resident_bytes() or 0, idle_share()
        with dask_pool.open_pool(ClusterChoice(name=address), Path(folder)) as pool:
            assert pool is not None
            start, processor, done = time.monotonic(), time.process_time(), 0
            pool.submit(parts)
            while pool.busy():
                done += len(pool.poll())
            passed, processor = time.monotonic() - start, time.process_time() - processor
            pool.close()
        after = resident_bytes("VmHWM") or 0
    ideal = chunks * seconds / slots
    who = "client, scheduler and workers" if workers else "client and scheduler"
    sys.stdout.write(
        f"{done} chunks of {size / 1e6:g} MB, {slots} slots of {processes} Dask workers, {seconds:g} s each: "
        f"{passed:.1f} s ({ideal:.1f} s without overhead), {done / passed:.0f} chunks/s, "
        f"{done * size / passed / 1e6:.0f} MB/s; {who} in one process: {1e3 * processor / done:.2f} ms of a core per "
        f"chunk, {before / 1e6:.0f} MB before, {after / 1e6:.0f} MB at most; idle {100 * idle:.1f} % of a core\n"
    )
    return 0


def idle_share(seconds: float = 20.0) -> float:
    """Return the share of a core that this process takes while nothing is asked of it."""
    before = time.process_time()
    time.sleep(seconds)
    return (time.process_time() - before) / seconds


def plan(count: int) -> int:
    """Write and read a manifest; print its bytes and those of memory."""
    rng = random.Random(0)
    with tempfile.TemporaryDirectory() as folder:
        manifest.claim(Path(folder), [
            SceneSpec(id=f"s{number}", seed=number, split="train", shape=f"sculpture:{number}", material="none",
                      view=View(rotation=(0.36, 0.48, -0.8, -0.8, 0.6, 0.0, 0.48, 0.64, 0.6)),
                      lights=tuple((round(rng.random(), 6), round(rng.random(), 6), 0.123457) for _ in range(64)),
                      size=128, spp=64, bounces=2)
            for number in range(count)
        ])  # fmt: skip
        tracemalloc.start()
        scenes = manifest.read_manifest(Path(folder))
        held = tracemalloc.get_traced_memory()[0]
        size = (Path(folder) / manifest.MANIFEST).stat().st_size
        sys.stdout.write(
            f"{len(scenes)} scenes: {size / count:.0f} bytes a line, {held / count:.0f} bytes of memory a scene\n"
        )
    return 0


@contextlib.contextmanager
def cluster(workers: int, threads: int, processes: bool = True):
    """Yield the address of a scheduler in this process, with workers in theirs or in this one, and a client."""
    # Of workers in this process only what the scheduler hears of is to be measured, not how they watch themselves.
    quiet = {} if processes else {
        "distributed.worker.profile.enabled": False, "distributed.admin.system-monitor.interval": "60s",
    }  # fmt: skip
    with (
        dask.config.set(quiet),
        distributed.LocalCluster(
            n_workers=workers,
            threads_per_worker=threads,
            processes=processes,
            protocol="tcp://",
            dashboard_address=":0",
            silence_logs=50,
        ) as made,
        distributed.Client(made, set_as_default=False) as client,
    ):
        yield made.scheduler_address, client


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("trial", choices=("kills", "schedulers", "load", "plan"))
    parser.add_argument("--times", type=int, default=10)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--slots", type=int, default=1000)
    parser.add_argument(
        "--workers", type=int, default=0, help="Dask workers, in this process (default: a few processes)"
    )
    parser.add_argument("--chunks", type=int, default=4000)
    parser.add_argument("--seconds", type=float, default=5.0)
    parser.add_argument("--bytes", type=int, default=2_000_000)
    flags = parser.parse_args()
    if flags.trial in ("kills", "schedulers"):
        sys.exit(kills(flags.times, flags.seed, kill_run if flags.trial == "kills" else restart_run))
    if flags.trial == "plan":
        sys.exit(plan(flags.chunks))
    sys.exit(load(flags.slots, flags.chunks, flags.seconds, flags.bytes, flags.workers))
