"""Training on scenes that a process of its own renders meanwhile.

Between `render.running.scene_stream` and `sdps.data.streamed_scenes`. The trainer's process never loads mitsuba, and
the renderer's never loads torch.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from pipelines.rendering.render_data import plan_scenes
from pipelines.shared.presets import Preset
from pipelines.shared.stream_config import StreamConfig
from render.records.manifest import MANIFEST, SceneSpec, read_manifest
from render.running.scene_stream import RenderedStream
from render.running.supervisor import render_supervised
from sdps.data.dataset import SampleOptions
from sdps.data.streamed_scenes import StreamedScenes
from sdps.training.distributed import Team
from sdps.training.stages import Stage


def stream_scenes(
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

    def start_stream(start: int) -> RenderedStream:
        return RenderedStream(
            scenes, seed=options.seed, start=start, depth=config.depth, threads=config.threads, recycle=config.recycle,
            timeout=config.timeout,
        )  # fmt: skip

    return StreamedScenes(
        scenes, start_stream, options, batch=batch, window=min(config.window, max(len(scenes), batch)),
        fresh=config.fresh, **places,
    )  # fmt: skip


def open_stream(preset: Preset, data: Path, stage: Stage, here: Team, config: StreamConfig) -> StreamedScenes:
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
    return stream_scenes(
        read_manifest(data), stage.sample_options(), config, batch=stage.config.batch_scenes,
        pin_memory=here.device.type == "cuda", rank=here.rank, world=here.world,
    )  # fmt: skip


def _prepare(preset: Preset, data: Path, *, validate: bool) -> None:
    """Write the plan, and render the scenes held out."""
    scenes = read_manifest(data) if (data / MANIFEST).is_file() else plan_scenes(preset, data)
    held_out = [scene for scene in scenes if scene.split == "val"]
    if validate and held_out:
        render_supervised(held_out, data)
