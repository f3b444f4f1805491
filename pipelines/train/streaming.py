"""Training on scenes that a process of its own renders meanwhile.

Between `render.running.scene_stream` and `sdps.data.streamed_scenes`. The trainer's process never loads mitsuba, and
the renderer's never loads torch.
"""

import multiprocessing
import threading
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from pipelines.rendering.render_data import planned_scenes
from pipelines.shared.presets import Preset
from pipelines.shared.stream_config import StreamConfig
from render.planning import budget
from render.records.manifest import MANIFEST, SceneSpec, read_manifest
from render.running.scene_stream import StreamWorkerConfig, serve
from render.running.supervisor import render_supervised
from render.shared.errors import InputError
from sdps.data.dataset import SampleOptions
from sdps.data.scene_store import StoredScene
from sdps.data.streamed_scenes import StreamedScenes
from sdps.training.distributed import Team
from sdps.training.stages import Stage


class RenderStream:
    """The scenes of a plan from number `start` on, endlessly, from a process of its own; a `SceneStream`.

    Args:
        scenes: The plan, views whole and the views of a shape together.
        seed: Seed of the order.
        start: Number of the first scene.
        config: How to render.
        serve: What the rendering process runs, a module-level function.

    Raises:
        InputError: from `next`: a scene cannot be rendered, or the process died or hangs.
    """

    def __init__(
        self,
        scenes: Sequence[SceneSpec],
        seed: int,
        start: int,
        config: StreamConfig,
        serve: Callable[..., None] = serve,
    ) -> None:
        self._scenes, self._by_id = scenes, {scene.id: scene for scene in scenes}
        self._seed, self._number, self._config, self._serve = seed, start, config, serve
        self._lock, self._closed = threading.Lock(), False
        self._start()

    def _start(self) -> None:
        """Start a process at the next scene, unless the stream has been closed meanwhile."""
        config = self._config
        worker = StreamWorkerConfig(
            scenes=self._scenes, seed=self._seed, start=self._number, count=config.recycle, depth=config.depth,
            threads=config.threads or max(1, budget.cores() // 2),
        )  # fmt: skip
        context = multiprocessing.get_context("spawn")  # a fork would inherit torch and its threads
        with self._lock:
            if self._closed:
                raise InputError("the stream of rendered scenes is closed")
            self._connection, theirs = context.Pipe(duplex=False)
            self._process = context.Process(target=self._serve, args=(theirs, worker), daemon=True)
            self._process.start()
            theirs.close()  # so that the pipe ends when the process does

    def __iter__(self) -> "RenderStream":
        return self

    def __next__(self) -> tuple[SceneSpec, StoredScene]:
        message = self._receive()
        while message[0] == "end":
            self._stop()
            self._start()
            message = self._receive()
        if message[0] == "failed":
            self.close()
            raise InputError(f"rendering while training: {message[1]}")
        _, id, arrays = message
        self._number += 1
        return self._by_id[id], StoredScene(*arrays)

    def _receive(self) -> tuple[Any, ...]:
        """Wait for the next message of the process."""
        timeout = self._config.timeout
        try:
            if self._connection.poll(timeout or None):
                return self._connection.recv()
        except (EOFError, OSError):
            self._process.join()
            raise InputError(
                f"rendering while training: the renderer died ({_end(self._process.exitcode)}) at scene "
                f"{self._number}; run `sdps doctor`, or render the plan with `sdps render-data`"
            ) from None
        self.close()
        raise InputError(
            f"rendering while training: no scene within {timeout:g} s; raise stream.timeout, or lower data.spp"
        )

    def _stop(self) -> None:
        # It holds nothing that would need to be finished.
        self._process.kill()
        self._process.join()

    def close(self) -> None:
        """End the process at once; may be called from another thread than waits for a scene."""
        with self._lock:
            self._closed = True
            self._stop()  # the pipe closes with it, and stays open on this side as long as somebody may be reading


def _end(code: int | None) -> str:
    return f"signal {-code}" if code is not None and code < 0 else f"exit code {code}"


def open_streamed(
    scenes: Sequence[SceneSpec], options: SampleOptions, config: StreamConfig, *, batch: int, **places: Any
) -> StreamedScenes:
    """Return the source of batches that renders the training scenes of a plan; its renderer starts with `batches`.

    Args:
        scenes: The plan, views whole and the views of a shape together; only those of split `train` are rendered.
        options: How samples are made of scenes; the seed orders the scenes, too.
        config: How scenes are rendered and kept.
        batch: Samples per batch, of all processes together.
        places: Options of `StreamedScenes` about this process and those that train with it.

    Raises:
        InputError: no training scene, or what `StreamedScenes` refuses.
    """
    scenes = [scene for scene in scenes if scene.split == "train"]
    return StreamedScenes(
        scenes, lambda start: RenderStream(scenes, options.seed, start, config), options, batch=batch,
        window=min(config.window, max(len(scenes), batch)), fresh=config.fresh, **places,
    )  # fmt: skip


def streamed(preset: Preset, data: Path, stage: Stage, here: Team, config: StreamConfig) -> StreamedScenes:
    """Return the source that renders a preset's training scenes while `stage` learns from them.

    Only the plan is written to `data`, and the shards of the scenes held out for validation, if the stage validates.

    Args:
        preset: What to render, unless `data` holds a plan already.
        data: Data folder.
        stage: Says how samples are made and how many make a batch.
        here: This process among those that train together.
        config: How scenes are rendered and kept.

    Raises:
        InputError: an unusable plan, held-out scenes that cannot be rendered, or what `StreamedScenes` refuses.
    """
    if here.leads:
        _prepare(preset, data, validate=stage.config.validation_scenes > 0)
    here.wait()
    return open_streamed(
        read_manifest(data), stage.sample_options(), config, batch=stage.config.batch_scenes,
        pin_memory=here.device.type == "cuda", rank=here.rank, world=here.world,
    )  # fmt: skip


def _prepare(preset: Preset, data: Path, *, validate: bool) -> None:
    """Write the plan, and render the scenes held out."""
    scenes = read_manifest(data) if (data / MANIFEST).is_file() else planned_scenes(preset, data)
    held_out = [scene for scene in scenes if scene.split == "val"]
    if validate and held_out:
        render_supervised(held_out, data)
