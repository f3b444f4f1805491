"""Rendering processes that only pretend; a small module of their own, so that spawned processes start quickly."""

import os
import signal
import time

from render.records import ledger
from render.running.isolation import settle
from render.running.messages import Begun, Done, Ended, Failed, Fatal, Ready, WorkerConfig


def pretend(connection, config: WorkerConfig) -> None:
    """Serve as a rendering process does, but only write a few bytes per scene, and fail as the material says."""
    settle(config)
    connection.send(Ready())
    while (chunk := connection.recv()) is not None:
        for scene in chunk.scenes():
            if scene.material == "die unbegun":
                os._exit(4)
            connection.send(Begun((scene.id,)))
            told = scene.digest()
            match scene.material:
                case "garbage":
                    connection.send_bytes(b"no pickle")
                case "other type":
                    connection.send({"done": scene.id})
                case "other scene":
                    connection.send(Failed(("nobody",), "ValueError: no", "", 0.1))
                case "no shard":
                    connection.send(_done(scene, config, scene.digest()))
                    time.sleep(60)
                case "other plan":
                    told = "0" * 64
                case "torn line":
                    connection.send(Done({"id": scene.id}))
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
                    connection.send(Failed((scene.id,), "ValueError: no", "Traceback\nValueError: no", 0.1))
                    continue
                case "full":
                    connection.send(Fatal("shards/x.exr: cannot be written (No space left on device)"))
                    return
            path = config.folder / scene.file
            path.parent.mkdir(parents=True, exist_ok=True)
            text = os.environ["SDPS_VARIANT"] if scene.material == "variant" else scene.digest()
            path.write_bytes(text.encode())
            connection.send(_done(scene, config, told, len(text)))
        connection.send(Ended(True))


def _done(scene, config: WorkerConfig, spec: str, size: int = 64) -> Done:
    return Done({"id": scene.id, "spec": spec, "bytes": size, "seconds": 0.5, "stages": {"render": 0.5},
                 "time": ledger.now(), "worker": config.number})  # fmt: skip


def stillborn(connection, config: WorkerConfig) -> None:
    """End before being ready, as a process does whose libLLVM aborts."""
    settle(config)
    os.write(2, b"LLVM ERROR: Cannot select\n")
    os._exit(7)
