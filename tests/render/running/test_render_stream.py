"""Rendering without storing: the scenes of the shards, in a seeded order, from a process that ends when it should."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import replace
from itertools import islice, pairwise
from multiprocessing import active_children
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from pretend_renderer import busy, listed, pretend

from pipelines.shared.stream_config import StreamConfig
from pipelines.train.streaming import open_stream, stream_scenes
from render.planning.plan import DataConfig, plan
from render.records.manifest import SceneSpec, View, write_manifest
from render.records.shards import read_shard
from render.running import rendered_view, scene_rendering
from render.running.protocol import Failure, Result, WorkerConfig
from render.running.scene_stream import RenderedStream, stream_chunks
from render.running.worker_process import ChunkRenderer, serve
from render.shared.errors import InputError
from sdps.data.augment import Augmentation
from sdps.data.dataset import SampleOptions

CONFIG = DataConfig(families={"blobby": 3}, views=2, materials_per_view=2, light_count=4, size=32, validation=0)
PLAIN = Augmentation(exposure="paper", exposure_range=(1.0, 1.0), intensity_range=(1.0, 1.0), noise=0.0, clip=1e6)
LIGHTS = ((0.0, 0.0, 1.0), (0.6, 0.0, 0.8))


@pytest.fixture(scope="module")
def scenes() -> list[SceneSpec]:
    return plan(CONFIG)


def planned(*materials: str) -> list[SceneSpec]:
    """Return a plan of one scene of each material, on a shape of its own."""
    return [
        SceneSpec(
            id=f"s{shape}", seed=shape, split="train", shape=f"blobby:{shape}", material=material, view=View(),
            lights=LIGHTS, size=16, spp=2, bounces=0,
        )
        for shape, material in enumerate(materials)
    ]  # fmt: skip


def ids(scenes: list[SceneSpec], count: int, **options) -> list[str]:
    order = (scene.id for chunk in stream_chunks(scenes, **options) for scene in chunk.scenes())
    return list(islice(order, count))


@pytest.fixture
def opened() -> Iterator:
    """Yield what opens a stream, closing it in the end."""
    streams = []

    def open_stream(scenes: list[SceneSpec], serve=pretend, **options) -> RenderedStream:
        streams.append(RenderedStream(scenes, seed=0, serve=serve, **options))
        return streams[-1]

    yield open_stream
    for stream in streams:
        stream.close()
    assert not active_children()


# ---- Order -----------------------------------------------------------------------------------------


def test_a_pass_has_every_scene_once_and_shapes_together(scenes):
    passes = [ids(scenes, 12, seed=0, start=start) for start in (0, 12, 24)]
    assert all(sorted(one) == sorted(scene.id for scene in scenes) for one in passes)
    assert passes[0] != passes[1] != passes[2]
    assert passes[0] == ids(scenes, 12, seed=0) != ids(scenes, 12, seed=1)
    for one in passes:
        assert sum(first[:-6] != second[:-6] for first, second in pairwise(one)) == 2  # three shapes, two changes
    assert len({tuple(id[-5:-3] for id in one) for one in passes}) > 1  # the views of a shape change places, too


def test_any_place_can_be_the_start(scenes):
    whole = ids(scenes, 40, seed=3)
    for start in range(28):
        assert ids(scenes, 10, seed=3, start=start) == whole[start : start + 10]


# ---- Rendering -------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def simple() -> list[SceneSpec]:
    """Return a plan that is rendered quickly: two views of a sphere and one of a blob, of two materials each."""
    views = [("sphere", View()), ("sphere", View(scale=0.6)), ("blobby:3", View())]
    return [
        replace(planned(material)[0], id=f"v{seed}-m{slot}", seed=seed, shape=shape, view=view, size=32)
        for seed, (shape, view) in enumerate(views)
        for slot, material in enumerate(("lambertian:0.8", "lambertian:0.2"))
    ]


@pytest.fixture(scope="module")
def shards(simple, tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("shards")
    scene_rendering.render_scenes(simple, folder)
    return folder


def assert_is_shard(folder: Path, scene: SceneSpec, arrays) -> None:
    shard = read_shard(folder / scene.file, scene)
    for name in ("images", "normals", "mask"):
        mine, theirs = getattr(arrays, name), getattr(shard, name)
        assert mine.dtype == theirs.dtype
        np.testing.assert_array_equal(mine, theirs)


@pytest.mark.parametrize("start", [0, 3])  # 3 lies inside of a view
def test_streamed_scenes_are_the_shards(simple, shards, opened, start):
    streamed = list(islice(opened(simple, serve=serve, start=start, threads=1), 8 - start))  # beyond one pass
    assert [scene.id for scene, _ in streamed] == ids(simple, 8, seed=0)[start:]
    for scene, arrays in streamed:
        assert_is_shard(shards, scene, arrays)


def test_batches_are_made_of_what_a_process_renders(simple, shards):
    """The whole way, from plan to batch, with a real renderer."""
    options = SampleOptions(seed=0, images=2, size=32, augmentation=PLAIN)
    source = stream_scenes(simple, options, StreamConfig(window=3, threads=1), batch=2)
    batch = next(source.batches(4))  # the window holds the scenes 2, 3 and 4
    source.close()
    assert not active_children()
    files = {scene.id: read_shard(shards / scene.file, scene).images for scene in simple}
    window = [files[id] for id in ids(simple, 3, seed=0, start=2)]
    for images, directions in zip(batch.images.numpy(), batch.directions.numpy(), strict=True):
        order = [LIGHTS.index(tuple(row)) for row in directions.round(6).astype(float).round(6).tolist()]
        found = [np.array_equal(images.transpose(0, 2, 3, 1), stored[order]) for stored in window]
        assert sum(found) == 1


def render_in_place(scenes: list[SceneSpec]) -> list:
    """Render the first chunk of the stream as its process would; return the results and failures."""
    sent: list = []
    config = WorkerConfig(folder=None, number=0, threads=1, variant="", llvm=None, errors=Path("errors"))
    ChunkRenderer(sent.append, next(stream_chunks(scenes, seed=0)), config).run()
    return [message for message in sent if isinstance(message, Result | Failure)]


def test_images_that_are_not_finite_are_refused(simple, monkeypatch):
    monkeypatch.setattr(rendered_view, "to_half", lambda stack: np.full(stack.shape, np.nan, np.float16))
    (first, *_) = render_in_place(simple)
    assert first.reason == f"scene {ids(simple, 1, seed=0)[0]}: the images have infinite or NaN values"


# ---- The process -----------------------------------------------------------------------------------


def test_mistakes_in_the_plan_are_one_line(opened):
    with pytest.raises(InputError, match=r"^rendering while training: .*no-such-stuff") as mistake:
        next(opened(planned("no-such-stuff"), serve=serve))
    assert "\n" not in str(mistake.value)


def test_defects_in_the_renderer_are_one_line(simple, monkeypatch):
    def defect(*_):
        raise RuntimeError("drjit: first line\nsecond line")

    monkeypatch.setattr(scene_rendering, "build", defect)
    (failure,) = render_in_place(simple)
    assert failure.reason == "RuntimeError: drjit: first line" and "in defect" in failure.traceback


@pytest.mark.parametrize(
    ("material", "reason"), [("die", "signal 11"), ("quit", "exit code 3"), ("torn", "exit code 4")]
)
def test_death_of_the_renderer_is_one_line(opened, material, reason):
    scenes = planned("ok", material, "ok")
    order = ids(scenes, 3, seed=0)
    stream = opened(scenes)
    for id in order[: order.index("s1")]:
        assert next(stream)[0].id == id
    with pytest.raises(InputError, match=rf"scene s1: worker died, {reason}; `sdps render-data`"):
        next(stream)


def test_hanging_renderer_is_given_up(opened):
    with pytest.raises(InputError, match=r"scene s0: timed out after 0\.2 s; raise stream\.timeout"):
        next(opened(planned("hang"), timeout=0.2))
    assert not active_children()


def test_processes_follow_each_other_without_a_gap(opened):
    scenes = planned(*["ok"] * 5)
    stream = opened(scenes, start=2, recycle=2)
    assert [next(stream)[0].id for _ in range(5)] == ids(scenes, 5, seed=0, start=2)


def test_closed_stream_stays_closed(opened):
    stream = opened(planned("ok"))
    stream.close()
    stream.close()
    with pytest.raises(InputError):
        next(stream)
    assert not active_children()


def test_neither_side_loads_the_other(opened):
    with pytest.raises(InputError, match=r"loaded: \[\]"):
        next(opened(planned("ok"), serve=listed))
    code = "import sys, pipelines.train.streaming; sys.exit(bool({'mitsuba', 'drjit'} & set(sys.modules)))"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def alive(pid: int) -> bool:
    """Tell whether a process runs; one that has ended but was not waited for does not."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


PARENT = """
import time
from pretend_renderer import busy
from render.records.manifest import SceneSpec, View
from render.running.scene_stream import RenderedStream

if __name__ == "__main__":
    scene = SceneSpec(id="s0", seed=0, split="train", shape="blobby:0", material="ok", view=View(),
                      lights=((0.0, 0.0, 1.0),), size=16, spp=2, bounces=0)
    stream = RenderedStream([scene], seed=0, serve=busy)
    next(stream)
    print(stream._pool.workers[0].process.pid, flush=True)
    time.sleep(60)
"""


@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="reads process states from /proc")
def test_renderer_ends_with_a_killed_parent(tmp_path):
    script = tmp_path / "parent.py"
    script.write_text(PARENT)
    paths = os.pathsep.join([str(Path(__file__).parents[2] / "support"), os.environ.get("PYTHONPATH", "")])
    parent = subprocess.Popen([sys.executable, script], stdout=subprocess.PIPE, env=os.environ | {"PYTHONPATH": paths})
    child = int(parent.stdout.readline())
    assert alive(child)
    parent.kill()
    parent.wait()
    parent.stdout.close()
    deadline = time.monotonic() + 20
    while alive(child) and time.monotonic() < deadline:
        time.sleep(0.02)
    assert not alive(child)


def test_interrupt_is_left_to_the_parent(opened):
    stream = opened(planned("ok"), serve=busy)
    next(stream)
    process = stream._pool.workers[0].process
    os.kill(process.pid, signal.SIGINT)
    process.join(0.3)
    assert process.is_alive()
    os.kill(process.pid, signal.SIGTERM)
    process.join(20)
    assert not process.is_alive()


# ---- The source ------------------------------------------------------------------------------------


def test_only_training_scenes_are_streamed(scenes):
    marked = [replace(scene, split="val") if scene.id.startswith("blobby-00001") else scene for scene in scenes]
    options = SampleOptions(seed=0, images=4, size=32, augmentation=Augmentation())
    source = stream_scenes(marked, options, StreamConfig(window=4), batch=2)
    assert (source.scenes, source.window) == (8, 4)
    assert stream_scenes(marked, options, StreamConfig(), batch=2).window == 8  # more would hold scenes twice
    assert stream_scenes(marked, options, StreamConfig(), batch=10).window == 10
    with pytest.raises(InputError, match=r"stream\.window 4 must be at least batch_scenes 5"):
        stream_scenes(scenes, options, StreamConfig(window=4), batch=5)


@pytest.mark.parametrize(("field", "value"), [("window", 0), ("fresh", 0), ("depth", -1), ("threads", -1)])
def test_configuration_is_checked(field, value):
    with pytest.raises(InputError, match=rf"stream\.{field} must"):
        StreamConfig(**{field: value})


def test_plan_in_the_data_folder_is_streamed_and_nothing_is_stored(scenes, tmp_path):
    write_manifest(tmp_path, scenes)
    config = SimpleNamespace(batch_scenes=4, validation_scenes=2)
    options = SampleOptions(seed=5, images=4, size=32, augmentation=PLAIN)
    stage = SimpleNamespace(config=config, sample_options=lambda: options)
    here = SimpleNamespace(leads=True, wait=lambda: None, rank=1, world=2, device=SimpleNamespace(type="cpu"))
    source = open_stream(SimpleNamespace(), tmp_path, stage, here, StreamConfig(window=8, fresh=0.5))
    assert (source.scenes, source.batch, source.window, source.fresh) == (12, 4, 8, 0.5)
    assert source.identity()["stream_seed"] == 5
    assert [path.name for path in tmp_path.iterdir()] == ["manifest.jsonl"]
