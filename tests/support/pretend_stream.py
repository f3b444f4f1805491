"""Streaming processes that only pretend; a small module of their own, so that spawned processes start quickly."""

import os
import signal
import sys
import time

import numpy as np

from render.running import scene_stream
from render.running.scene_stream import RenderedScene, StreamWorkerConfig


def _blank() -> RenderedScene:
    return RenderedScene(np.zeros((2, 4, 4, 3), np.float16), np.zeros((4, 4, 3), np.float32), np.ones((4, 4), bool))


def pretend(connection, config: StreamWorkerConfig) -> None:
    """Send blank scenes in the order of the stream; die, hang or fail where the material says."""
    order = (
        scene
        for group, skip in scene_stream.stream_order(config.scenes, seed=config.seed, start=config.start)
        for scene in group[skip:]
    )
    for _, scene in zip(range(config.count), order, strict=False):
        match scene.material:
            case "die":
                os.kill(os.getpid(), signal.SIGSEGV)
            case "quit":
                os._exit(3)
            case "hang":
                time.sleep(60)
            case "torn":  # killed in the middle of a message
                os.write(connection.fileno(), b"\0\0\1\0torn")
                os._exit(4)
        connection.send(("scene", scene.id, _blank()))
    connection.send(("end",))


def listed(connection, config: StreamWorkerConfig) -> None:
    """Fail with the names of the modules that should not be here."""
    found = sorted({"torch", "sdps", "pipelines"} & set(sys.modules))
    connection.send(("failed", f"loaded: {found}"))


def busy(connection, config: StreamWorkerConfig) -> None:
    """Serve like `render.running.scene_stream.serve`, but busy for ever after its first scene."""

    def render(config, outbox):
        outbox.put(("scene", "s0", _blank()))
        while True:
            time.sleep(0.01)

    scene_stream._render = render
    scene_stream.serve(connection, config)
