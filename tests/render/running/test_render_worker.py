"""Rendering a plan: resumable to the byte, never twice, and never half a shard."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from render.planning.chunks import Chunk, view_groups
from render.planning.plan import DataConfig, plan
from render.records.manifest import SceneSpec, View
from render.records.shards import Shard, file_hash, is_whole, read_shard
from render.running import scene_rendering, worker_process
from render.running.protocol import Failure, Message, Result, Started, WorkerConfig
from render.shared.errors import InputError

CONFIG = DataConfig(
    families={"blobby": 2}, views=2, materials_per_view=3, materials=("fabric", "chrome"), light_count=6, size=24, spp=4
)


class Stopped(Exception):
    pass


@pytest.fixture(scope="module")
def scenes() -> list[SceneSpec]:
    return plan(CONFIG)


@pytest.fixture(scope="module")
def whole(scenes, tmp_path_factory) -> dict[str, str]:
    """Render the plan without a break; return the hash of every shard."""
    folder = tmp_path_factory.mktemp("whole")
    assert scene_rendering.render_scenes(scenes, folder) == len(scenes)
    return hashes(folder)


def hashes(folder: Path) -> dict[str, str]:
    return {path.name: file_hash(path) for path in sorted((folder / "shards").iterdir())}


def stop_after(count: int):
    """Return a callback that interrupts the run after `count` shards."""
    written = []

    def on_shard(scene: SceneSpec) -> None:
        written.append(scene.id)
        if len(written) == count:
            raise Stopped

    return on_shard


@pytest.mark.parametrize("count", [1, 3, 5, 11])
def test_interrupted_and_resumed_equals_uninterrupted(scenes, whole, tmp_path, count):
    """Views have three materials, so 1, 5 and 11 stop in the middle of a group that shares rays."""
    with pytest.raises(Stopped):
        scene_rendering.render_scenes(scenes, tmp_path, on_shard=stop_after(count))
    first = {path.name: path.stat().st_mtime_ns for path in (tmp_path / "shards").iterdir()}
    assert len(first) == count
    assert scene_rendering.render_scenes(scenes, tmp_path) == len(scenes) - count
    assert hashes(tmp_path) == whole
    assert all((tmp_path / "shards" / name).stat().st_mtime_ns == time for name, time in first.items())
    assert scene_rendering.render_scenes(scenes, tmp_path) == 0


def test_damaged_and_foreign_shards_are_rendered_again(scenes, whole, tmp_path):
    scene_rendering.render_scenes(scenes[:3], tmp_path)
    first, second, third = (tmp_path / scene.file for scene in scenes[:3])
    first.write_bytes(first.read_bytes()[:-500])
    data = bytearray(second.read_bytes())
    data[len(data) // 2] ^= 1
    second.write_bytes(data)
    third.unlink()
    assert [is_whole(tmp_path / scene.file, scene) for scene in scenes[:3]] == [False, False, False]
    assert scene_rendering.render_scenes(scenes[:3], tmp_path) == 3
    assert hashes(tmp_path) == {name: whole[name] for name in hashes(tmp_path)}


def test_shard_holds_what_the_manifest_says(scenes, whole, tmp_path):
    scene_rendering.render_scenes(scenes[:3], tmp_path)
    shard = read_shard(tmp_path / scenes[1].file, scenes[1])
    assert shard.images.shape == (6, 24, 24, 3) and shard.mask.any()
    assert not shard.images[:, shard.coverage == 0].any()
    expected = {name: getattr(scenes[1], name) for name in ("seed", "shape", "material", "spp", "bounces")}
    assert expected.items() <= shard.provenance.items() and "mitsuba" in shard.provenance
    json.dumps(shard.provenance)


def test_groups_share_rays_only_within_a_view(scenes, monkeypatch):
    monkeypatch.setattr("render.planning.chunks.GROUP_SIZE", 2)
    groups = list(view_groups(scenes))
    assert [len(group) for group in groups] == [2, 1] * 4
    assert [scene for group in groups for scene in group] == scenes
    other = replace(scenes[1], spp=8)
    assert len(list(view_groups([scenes[0], other]))) == 2


def test_lights_brighten_the_side_they_stand_on(tmp_path):
    """End to end, from manifest line to shard: the frame survives every step."""
    lights = ((0.9, 0.0, 0.436), (-0.9, 0.0, 0.436), (0.0, 0.9, 0.436))
    scene = SceneSpec(
        id="sphere", seed=0, split="test", shape="sphere", material="lambertian:0.8", view=View(scale=0.9),
        lights=lights, size=32, spp=16, bounces=1,
    )  # fmt: skip
    scene_rendering.render_scenes([scene], tmp_path)
    shard = read_shard(tmp_path / scene.file, scene)
    expected = 0.8 * np.maximum(np.einsum("hwc,lc->lhw", shard.normals, shard.light_directions), 0)
    inner = shard.normals[..., 2] > 0.4
    np.testing.assert_allclose(shard.images[..., 1].astype(np.float32)[:, inner], expected[:, inner], atol=0.02)


def test_object_outside_the_frame_is_refused(scenes, tmp_path):
    lost = replace(scenes[0], view=View(scale=0.05, offset=(4.0, 0.0)))
    with pytest.raises(InputError, match=r"outside the frame; check view\.scale"):
        scene_rendering.render_scenes([lost], tmp_path)
    assert not (tmp_path / "shards").exists() or not any((tmp_path / "shards").iterdir())


def test_scenes_that_are_not_square_are_refused(scenes, tmp_path):
    with pytest.raises(InputError, match="size is 16x24; only square images"):
        scene_rendering.render_scenes([replace(scenes[0], size=(16, 24))], tmp_path)


# ---- Spatially-varying scenes -----------------------------------------------------------------------

COMPONENTS = ("lambertian:0.9/0.5/0.1", "pink-felt")


def varying(kind: str, folder: Path, **changes) -> tuple[Shard, list[Shard]]:
    """Render a surface of a pattern in direct light, and its materials alone; return their shards."""
    names = (f"{kind}:7:{'+'.join(COMPONENTS)}", *COMPONENTS)
    spec = SceneSpec(
        id="0", seed=3, split="test", shape="blobby:1", material="", view=View(scale=0.9), size=32, spp=16, bounces=0,
        lights=((0.0, 0.0, 1.0), (0.6, 0.0, 0.8), (-0.28, 0.6, 0.7493998)),
    )  # fmt: skip
    scenes = [replace(spec, id=str(number), material=name, **changes) for number, name in enumerate(names)]
    assert scene_rendering.render_scenes(scenes, folder) == 3
    first, *others = (read_shard(folder / scene.file, scene) for scene in scenes)
    return first, others


@pytest.mark.parametrize("kind", ["stripes", "noise", "parts"])
def test_a_varying_surface_is_the_mixture_of_its_materials(tmp_path, kind):
    """In direct light, where a pixel's samples have the same weights: the same paths serve all three."""
    mixed, alone = varying(kind, tmp_path)
    assert mixed.materials == COMPONENTS and mixed.provenance["material"].startswith(f"{kind}:7:")
    assert all(shard.weights is None and shard.materials == () for shard in alone)
    assert mixed.weights.shape == (2, 32, 32) and mixed.weights.min() >= 0
    np.testing.assert_allclose(mixed.weights.sum(0)[mixed.mask], 1, atol=1e-6)
    assert not mixed.weights[:, ~mixed.mask].any()
    assert (mixed.weights.max((1, 2)) > 0.9).all()
    images = [shard.images.astype(np.float32) for shard in alone]
    expected = sum(weight[..., None] * image for weight, image in zip(mixed.weights, images, strict=True))
    error = np.abs(mixed.images.astype(np.float32) - expected).max((0, 3))
    sharp = mixed.mask & (mixed.weights.max(0) == 1) & (mixed.coverage == 1)
    smooth = mixed.mask & (mixed.coverage == 1)
    if kind != "noise":
        assert sharp.sum() > 100 and error[sharp].max() < 2e-3  # half precision
    assert np.median(error[smooth]) < 5e-3 and error[smooth].max() < 0.25
    for plain, image in zip(alone, images, strict=True):  # and each is another picture
        assert np.abs(image - mixed.images.astype(np.float32)).max() > 0.05
        np.testing.assert_array_equal(plain.normals, mixed.normals)


def test_a_pattern_of_one_material_twice_is_that_material(tmp_path):
    spec = SceneSpec(
        id="a", seed=3, split="test", shape="blobby:1", material="stripes:1:pink-felt+pink-felt", view=View(), size=24,
        spp=8, bounces=2, lights=((0.0, 0.0, 1.0), (0.6, 0.0, 0.8)),
    )  # fmt: skip
    plain = replace(spec, id="b", material="pink-felt")
    for scene in (spec, plain):
        scene_rendering.render_scenes([scene], tmp_path)
    twice, once = (read_shard(tmp_path / scene.file, scene) for scene in (spec, plain))
    assert twice.materials == ("pink-felt", "pink-felt")
    np.testing.assert_allclose(twice.images.astype(np.float32), once.images.astype(np.float32), rtol=5e-3, atol=2e-3)


def test_bounces_add_light_to_a_varying_surface(tmp_path):
    """Interreflections only brighten, and leave the weights alone."""
    direct, _ = varying("stripes", tmp_path / "direct", shape="sculpture:5")
    bounced, _ = varying("stripes", tmp_path / "bounced", shape="sculpture:5", bounces=2)
    gain = (bounced.images.astype(np.float32) - direct.images.astype(np.float32))[:, direct.coverage == 1]
    assert gain.mean() > 0.002 and gain.min() > -2e-3
    np.testing.assert_array_equal(bounced.weights, direct.weights)


def test_an_unknown_part_of_a_pattern_is_refused(scenes, tmp_path):
    with pytest.raises(InputError, match="did you mean 'chrome'"):
        scene_rendering.render_scenes([replace(scenes[0], material="stripes:1:crome+nylon")], tmp_path)


# ---- One process's work, isolated ------------------------------------------------------------------


def work(scenes: list[SceneSpec], folder: Path) -> tuple[bool, list[Message]]:
    """Render one chunk as a rendering process does; return whether it is still sound, and what it sent."""
    groups = tuple(tuple(group) for group in view_groups(scenes))
    chunk = Chunk(scenes[0].shape, groups, frozenset(scene.id for scene in scenes))
    sent: list[Message] = []
    config = WorkerConfig(folder=folder, number=3, threads=1, variant="", llvm=None, errors=folder / "errors")
    return worker_process.ChunkRenderer(sent.append, chunk, config).run(), sent


def fail_writing(monkeypatch: pytest.MonkeyPatch, scene: SceneSpec, error: Exception) -> None:
    """Let the shard of one scene fail to be written."""
    real = scene_rendering.write_shard

    def write(path: Path, shard) -> None:
        if shard.scene_id == scene.id:
            raise error
        real(path, shard)

    monkeypatch.setattr(scene_rendering, "write_shard", write)


def test_a_scene_that_fails_leaves_the_bytes_of_its_neighbours(scenes, whole, tmp_path, monkeypatch):
    fail_writing(monkeypatch, scenes[1], InputError("the image has infinite values"))
    sound, sent = work(scenes[:3], tmp_path)
    assert sound and [type(message) for message in sent] == [Started, Started, Result, Failure, Started, Result]
    assert (sent[3].ids, sent[3].reason) == ((scenes[1].id,), "the image has infinite values")
    assert hashes(tmp_path) == {f"{scenes[k].id}.exr": whole[f"{scenes[k].id}.exr"] for k in (0, 2)}
    line = sent[2].line
    assert line["id"] == scenes[0].id and line["spec"] == scenes[0].digest() and line["worker"] == 3
    assert line["bytes"] == (tmp_path / scenes[0].file).stat().st_size
    assert line["seconds"] == pytest.approx(sum(line["stages"].values()), abs=1e-3)


def test_a_defect_ends_the_process_with_a_traceback(scenes, tmp_path, monkeypatch):
    fail_writing(monkeypatch, scenes[0], RuntimeError("internal"))
    sound, sent = work(scenes[:3], tmp_path)
    assert not sound and [type(message) for message in sent] == [Started, Started, Failure]
    assert sent[-1].reason == "RuntimeError: internal" and "in write" in sent[-1].traceback


def test_a_disk_that_refuses_concerns_the_whole_run(scenes, tmp_path):
    (tmp_path / "shards").write_text("")  # a file where the folder should be
    with pytest.raises(scene_rendering.Unwritable, match="cannot be written"):
        work(scenes[:3], tmp_path)


def test_shapes_and_views_that_fail_take_their_scenes_along(scenes, tmp_path):
    sound, sent = work([replace(scene, shape="gone.obj") for scene in scenes[:3]], tmp_path)
    assert sound and sent[-1].ids == tuple(scene.id for scene in scenes[:3]) and "gone.obj" in sent[-1].reason
    lost = View(scale=0.05, offset=(4.0, 0.0))
    sound, sent = work([replace(scenes[0], view=lost, id="a"), scenes[3]], tmp_path)
    (failed,) = [message for message in sent if isinstance(message, Failure)]
    assert sound and failed.ids == ("a",) and "outside the frame" in failed.reason
    assert (tmp_path / scenes[3].file).is_file()
