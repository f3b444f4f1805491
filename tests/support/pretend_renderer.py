"""Rendering processes that only pretend; a small module of their own, so that spawned processes start quickly."""

import os
import signal
import sys
import time

import numpy as np

from render.records import ledger
from render.running.protocol import Failure, Fatal, Finished, Ready, Result, SceneArrays, Started, WorkerConfig
from render.running.worker_process import prepare_process


def pretend(connection, config: WorkerConfig) -> None:
    """Serve like a rendering process, but write a few bytes or send a blank scene, and fail as the material says."""
    prepare_process(config)
    connection.send(Ready())
    while (chunk := connection.recv()) is not None:
        for scene in chunk.scenes():
            if scene.material == "die unbegun":
                os._exit(4)
            connection.send(Started((scene.id,)))
            spec = scene.digest()
            match scene.material:
                case "garbage":
                    connection.send_bytes(b"no pickle")
                case "other type":
                    connection.send({"done": scene.id})
                case "other scene":
                    connection.send(Failure(("nobody",), "ValueError: no", "", 0.1))
                case "no shard":
                    connection.send(_result(scene, config, scene.digest()))
                    time.sleep(60)
                case "other plan":
                    spec = "0" * 64
                case "torn line":
                    connection.send(Result({"id": scene.id}))
                case "torn":  # killed in the middle of a message
                    os.write(connection.fileno(), b"\0\0\1\0torn")
                    os._exit(4)
                case "hang":
                    time.sleep(60)
                case "slow":
                    time.sleep(0.2)
                case "hoard":
                    hoard = bytearray(os.urandom(1 << 20) * 400)
                    time.sleep(60)
                    del hoard
                case "die":
                    os.kill(os.getpid(), signal.SIGSEGV)
                case "quit":
                    os._exit(3)
                case "raise":
                    connection.send(Failure((scene.id,), "ValueError: no", "Traceback\nValueError: no", 0.1))
                    continue
                case "full":
                    connection.send(Fatal("shards/x.exr: cannot be written (No space left on device)"))
                    return
            if config.folder is None:
                connection.send(_result(scene, config, spec, arrays=_blank()))
                continue
            path = config.folder / scene.file
            path.parent.mkdir(parents=True, exist_ok=True)
            text = os.environ["SDPS_VARIANT"] if scene.material == "variant" else scene.digest()
            path.write_bytes(text.encode())
            connection.send(_result(scene, config, spec, len(text)))
        connection.send(Finished(True))


def _blank() -> SceneArrays:
    flat = np.zeros((4, 4), np.float32)
    return SceneArrays(np.zeros((2, 4, 4, 3), np.float16), np.zeros((4, 4, 3), np.float32), np.ones((4, 4), bool), flat)


def _result(scene, config: WorkerConfig, spec: str, size: int = 64, arrays: SceneArrays | None = None) -> Result:
    size = size if arrays is None else sum(array.nbytes for array in arrays)
    return Result({"id": scene.id, "spec": spec, "bytes": size, "seconds": 0.5, "stages": {"render": 0.5},
                 "time": ledger.now(), "worker": config.number}, arrays)  # fmt: skip


def stillborn(connection, config: WorkerConfig) -> None:
    """End before being ready, as a process does whose libLLVM aborts."""
    prepare_process(config)
    os.write(2, b"LLVM ERROR: Cannot select\n")
    os._exit(7)


def listed(connection, config: WorkerConfig) -> None:
    """Fail with the names of the modules that should not be here."""
    found = sorted({"torch", "sdps", "pipelines"} & set(sys.modules))
    connection.send(Fatal(f"loaded: {found}"))


def busy(connection, config: WorkerConfig) -> None:
    """Send one scene, and then be busy for ever."""
    prepare_process(config)
    connection.send(Ready())
    scene = connection.recv().scenes()[0]
    connection.send(_result(scene, config, scene.digest(), arrays=_blank()))
    while True:
        time.sleep(0.01)
