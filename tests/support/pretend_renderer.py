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
            connection.send(Begun((scene.id,)))
            match scene.material:
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
            variant = scene.material == "variant"
            path.write_bytes((os.environ["SDPS_VARIANT"] if variant else scene.digest()).encode())
            line = {"id": scene.id, "spec": scene.digest(), "bytes": 64, "seconds": 0.5, "stages": {"render": 0.5},
                    "time": ledger.now(), "worker": config.number}  # fmt: skip
            connection.send(Done(line))
        connection.send(Ended(True))


def stillborn(connection, config: WorkerConfig) -> None:
    """End before being ready, as a process does whose libLLVM aborts."""
    settle(config)
    os.write(2, b"LLVM ERROR: Cannot select\n")
    os._exit(7)
