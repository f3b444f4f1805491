"""From shards to batches: samples, streams of random numbers, cache, and refusals."""

import json
from dataclasses import replace
from itertools import islice
from multiprocessing import active_children
from pathlib import Path

import numpy as np
import pytest
import torch
from sdps_samples import PLAIN, options, rng
from sdps_scenes import write_data
from stage_scenes import write_stage
from torch.utils.data import DataLoader

from render.records.manifest import read_manifest
from render.records.shards import read_shard
from render.shared.errors import InputError
from render.shared.imaging.scene_mixing import SceneMix
from render.shared.imaging.sensor import SensorModel
from sdps.core.metrics import normal_mae
from sdps.data.augment import Augmentation
from sdps.data.dataset import (
    Batch,
    SampleKey,
    SceneDataset,
    collate,
    make_sample,
)
from sdps.data.order import SampleStream, Windows
from sdps.data.scene_store import StoredScene
from sdps.data.sources import StoredScenes


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("data")
    write_data(path, ("train",) * 5 + ("val",), lights=6, size=32)
    return path


def same(first: Batch, second: Batch) -> bool:
    return all(torch.equal(*pair) for pair in zip(first, second, strict=True))


def test_sample_is_the_shard(folder: Path) -> None:
    dataset = SceneDataset(folder, "train", options(augmentation=PLAIN, images=6), cache=False)
    sample = dataset.sample(SampleKey(2, 0, 7))
    shard = read_shard(folder / dataset.scenes[2].file)
    order = [int(np.argmin(np.abs(shard.light_directions - row).sum(1))) for row in sample.directions.numpy()]
    assert sorted(order) == list(range(6))
    np.testing.assert_array_equal(sample.images.numpy(), shard.images[order].transpose(0, 3, 1, 2))
    np.testing.assert_array_equal(sample.normals.numpy(), shard.normals.transpose(2, 0, 1))
    np.testing.assert_array_equal(sample.mask[0].numpy(), shard.mask)


def test_light_directions_are_those_of_the_manifest_with_which_shards_agree(folder: Path) -> None:
    scenes = read_manifest(folder, "train")
    for scene in scenes:
        np.testing.assert_array_equal(read_shard(folder / scene.file).light_directions, scene.light_directions())
    other = replace(scenes[0], lights=scenes[0].lights[::-1])
    with pytest.raises(InputError, match="light directions differ from the manifest"):
        read_shard(folder / other.file, other)
    with pytest.raises(InputError, match="6 images for 5 lights"):
        stored = StoredScene(*(getattr(read_shard(folder / scenes[0].file), name) for name in StoredScene._fields))
        make_sample(replace(scenes[0], lights=scenes[0].lights[:5]), stored, options(), rng())


def test_other_sizes_are_resized_with_unit_normals(folder: Path) -> None:
    sample = SceneDataset(folder, "train", options(size=16), cache=False).sample(SampleKey(0, 0, 0))
    assert sample.images.shape == (4, 3, 16, 16)
    length = sample.normals.norm(dim=0)
    torch.testing.assert_close(length, sample.mask[0])


def test_cache_gives_the_same_samples_and_notices_a_new_shard(tmp_path: Path) -> None:
    write_data(tmp_path, ("train",), lights=4, size=16)
    key = SampleKey(0, 0, 0)
    direct = SceneDataset(tmp_path, "train", options(size=16), cache=False).sample(key)
    cached = SceneDataset(tmp_path, "train", options(size=16), cache=True)
    for _ in range(2):  # decoded, then mapped
        assert all(torch.equal(*pair) for pair in zip(cached.sample(key), direct, strict=True))
    entry = {path.name.split(".")[-2]: path for path in (tmp_path / "cache").iterdir()}
    assert entry.keys() == {"images", "truth"}
    seen = (read_shard(next(tmp_path.rglob("*.exr"))).images != 0.0).any(axis=(0, 3))
    assert 0 < seen.sum() < seen.size  # there is something black to leave out
    assert np.load(entry["images"]).shape == (4, seen.sum(), 3)
    write_data(tmp_path, ("train",), lights=4, size=16, seed=5)
    renewed = SceneDataset(tmp_path, "train", options(size=16), cache=True).sample(key)
    assert not torch.equal(renewed.directions, direct.directions)


def test_samples_do_not_depend_on_the_number_of_workers(folder: Path) -> None:
    batches = []
    for workers in (0, 2):
        dataset = SceneDataset(folder, "train", options())
        stream = SampleStream(len(dataset), 2, 0)
        loader = iter(DataLoader(dataset, batch_sampler=stream, num_workers=workers, collate_fn=collate))
        batches.append([next(loader) for _ in range(6)])
        del loader
    for first, second in zip(*batches, strict=True):
        assert all(torch.equal(*pair) for pair in zip(first, second, strict=True))


def test_no_random_stream_is_used_twice(folder: Path) -> None:
    dataset = SceneDataset(folder, "train", options())
    samples = [dataset.sample(SampleKey(0, epoch, position)) for epoch in range(3) for position in range(3)]
    drawn = {tuple(sample.intensities.tolist()) for sample in samples}
    assert len(drawn) == 9


def test_stream_visits_every_scene_once_per_epoch_in_a_new_order() -> None:
    stream = iter(SampleStream(5, 2, seed=0))
    keys = [key for _ in range(5) for key in next(stream)]
    assert [key.epoch for key in keys] == [0] * 5 + [1] * 5
    orders = [[key.scene for key in keys if key.epoch == epoch] for epoch in (0, 1)]
    assert sorted(orders[0]) == sorted(orders[1]) == list(range(5))
    assert orders[0] != orders[1]


@pytest.mark.parametrize("taken", [0, 4, 6, 34])
def test_stream_resumes_where_it_stopped(taken: int) -> None:
    whole, rest = iter(SampleStream(5, 2, seed=3)), iter(SampleStream(5, 2, seed=3, taken=taken))
    for _ in range(taken // 2):
        next(whole)
    assert [next(whole) for _ in range(6)] == [next(rest) for _ in range(6)]


def test_the_order_of_a_packed_set_is_a_permutation_that_uses_few_tars_at_a_time() -> None:
    tars = [np.arange(start, start + 20) for start in range(0, 2000, 20)]
    stream = SampleStream(2000, 8, seed=1, windows=Windows(tars, 200))
    first, second = stream.order(0), stream.order(1)
    for order in (first, second):
        assert sorted(order) == list(range(2000))
        places = [np.flatnonzero(np.isin(order, tar)) for tar in tars]
        alive = sum((np.arange(2000) >= found[0]) & (np.arange(2000) <= found[-1]) for found in places)
        assert alive.max() <= 200 / 20 + 2
        assert np.mean([found[-1] - found[0] for found in places]) > 100  # no tar comes in one piece
    assert not np.array_equal(first, second) and np.array_equal(first, stream.order(0))


def test_crops_hold_enough_of_the_object(folder: Path) -> None:
    dataset = SceneDataset(folder, "train", options(crop=12, min_object=0.5))
    corners = set()
    for position in range(40):
        sample = dataset.sample(SampleKey(position % 5, 0, position))
        row, column = sample.corner.tolist()
        corners.add((row, column))
        assert 0 <= row <= 20
        assert 0 <= column <= 20
        assert sample.mask[0, row : row + 12, column : column + 12].mean() >= 0.5
    assert len(corners) > 20


def test_normals_of_all_samples_face_as_the_light_says(folder: Path) -> None:
    # Least squares on an augmented sample recovers its normals, so images, lights and normals belong together.
    from sdps.classical.least_squares import least_squares

    config = Augmentation(noise=0.0, symmetries=True, clip=1e6)
    sample = SceneDataset(folder, "train", options(augmentation=config, images=6)).sample(SampleKey(1, 0, 3))
    images, mask = sample.images.numpy().transpose(0, 2, 3, 1), sample.mask[0].numpy() > 0
    mask &= images.min((0, 3)) > 1e-4  # lit by all
    normals = sample.normals.numpy().transpose(1, 2, 0)
    estimate = least_squares(images, mask, sample.directions.numpy(), sample.intensities.numpy())
    assert normal_mae(estimate.normals, normals, mask) < 0.3


def test_shard_that_differs_from_the_manifest_is_refused_in_one_line(tmp_path: Path) -> None:
    write_data(tmp_path, ("train", "train"), lights=4, size=16)
    first, second = (tmp_path / scene.file for scene in read_manifest(tmp_path))
    first.write_bytes(second.read_bytes())
    dataset = SceneDataset(tmp_path, "train", options(size=16))
    with pytest.raises(InputError, match="the manifest says") as error:
        dataset.sample(SampleKey(0, 0, 0))
    assert "\n" not in str(error.value)
    # A worker hands the same one-line error through the batch.
    loader = DataLoader(dataset, batch_sampler=[[SampleKey(1, 0, 0), SampleKey(0, 0, 1)]], num_workers=1,
                        collate_fn=collate)  # fmt: skip
    assert "the manifest says" in str(next(iter(loader)))


def test_truncated_and_missing_shards_are_refused(tmp_path: Path) -> None:
    scenes = write_data(tmp_path, ("train", "train", "train"), lights=4, size=16)
    path = tmp_path / scenes[0].file
    path.write_bytes(path.read_bytes()[:-100])
    with pytest.raises(InputError, match="render it again"):
        SceneDataset(tmp_path, "train", options(size=16)).sample(SampleKey(0, 0, 0))
    (tmp_path / scenes[1].file).unlink()
    with pytest.raises(InputError, match="1 of 3 shards"):
        SceneDataset(tmp_path, "train", options(size=16))
    assert len(SceneDataset(tmp_path, "train", options(size=16), skip_missing=True)) == 2
    with pytest.raises(InputError, match="no scene of split 'val'"):
        SceneDataset(tmp_path, "val", options(size=16))


def test_scenes_that_could_not_be_rendered_are_left_out_with_one_warning(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    scenes = write_data(tmp_path, ("train",) * 4 + ("val",), lights=4, size=16)
    for scene in scenes[:2]:
        (tmp_path / scene.file).unlink()
    failure = {"id": scenes[0].id, "time": "2024-01-01T00:00:00+00:00", "reason": "outside the frame"}
    (tmp_path / "failed.jsonl").write_text(json.dumps(failure) + "\n")
    with pytest.raises(InputError, match="2 of 4 shards"):  # one of them is still to be rendered
        SceneDataset(tmp_path, "train", options(size=16))
    with open(tmp_path / "failed.jsonl", "a") as handle:
        handle.write(json.dumps(failure | {"id": scenes[1].id}) + "\n")
    assert len(SceneDataset(tmp_path, "train", options(size=16))) == 2
    (record,) = caplog.records
    assert "2 of 4 scenes of split 'train' could not be rendered" in record.getMessage()
    SceneDataset(tmp_path, "val", options(size=16))
    assert len(caplog.records) == 1


# ---- Seeds of samples, and crops of large scenes -----------------------------------------------------


def test_every_sample_has_a_seed_of_its_own_that_its_crop_does_not_change(folder: Path) -> None:
    plain, cropped = (SceneDataset(folder, "train", options(**changes)) for changes in ({}, {"crop": 12}))
    keys = [SampleKey(0, epoch, position) for epoch in range(3) for position in range(3)]
    seeds = [plain.sample(key).seed for key in keys]
    assert len({int(seed) for seed in seeds}) == 9
    assert all(seed.dtype == torch.int64 and seed >= 0 for seed in seeds)
    assert [cropped.sample(key).seed for key in keys] == seeds
    other = SceneDataset(folder, "train", options(seed=1))
    assert other.sample(keys[0]).seed != seeds[0]
    assert collate([plain.sample(key) for key in keys]).seed.tolist() == [int(seed) for seed in seeds]


def ramp(height: int, width: int) -> StoredScene:
    """Return a scene whose images tell which row and column a pixel had, with all normals tilted alike."""
    rows, columns = np.meshgrid(np.arange(height), np.arange(width), indexing="ij")
    image = np.stack([rows, columns, np.ones_like(rows)], axis=-1) / 64.0
    normals = np.tile(np.array([0.6, 0.0, 0.8], np.float32), (height, width, 1))
    depth = np.zeros((height, width), np.float32)
    return StoredScene(np.repeat(image[None], 4, 0).astype(np.float16), normals, depth == 0.0, depth)


@pytest.mark.parametrize(("height", "width"), [(64, 64), (48, 80)])
def test_large_scenes_are_rescaled_by_one_factor_and_cropped(folder: Path, height: int, width: int) -> None:
    (scene,) = read_manifest(folder, "train")[:1]
    scene = replace(scene, lights=scene.lights[:4])
    config = options(augmentation=PLAIN, rescale=True)
    steps, starts = [], []
    for number in range(60):
        sample = make_sample(scene, ramp(height, width), config, rng(number))
        assert sample.images.shape == (4, 3, 32, 32)
        inner = 64.0 * sample.images[0, :2, 1:-1, 1:-1]  # antialiasing flattens the border of the ramp
        down, right = inner[0].diff(dim=0).mean(), inner[1].diff(dim=1).mean()
        assert down == pytest.approx(float(right), rel=0.05)
        assert inner[0].max() <= height and inner[1].max() <= width
        steps.append(float(down))
        starts.append((round(float(inner[0].min())), round(float(inner[1].min()))))
        torch.testing.assert_close(sample.normals, torch.tensor([0.6, 0.0, 0.8])[:, None, None].expand(3, 32, 32))
    most = min(height, width) / 32
    assert 1.0 <= min(steps) < 1.1 and 0.95 * most < max(steps) <= most + 0.01
    assert len(set(starts)) > 30
    repeated = [make_sample(scene, ramp(height, width), config, rng(7)) for _ in range(2)]
    assert same(*repeated)


def test_rescaling_leaves_scenes_alone_that_are_not_larger(folder: Path) -> None:
    key = SampleKey(1, 0, 3)
    for size in (32, 48):
        plain, rescaled = (
            SceneDataset(folder, "train", options(size=size, rescale=rescale)).sample(key) for rescale in (False, True)
        )
        assert same(plain, rescaled)


def test_rescaled_scenes_still_obey_lamberts_law(tmp_path: Path) -> None:
    from sdps.classical.least_squares import least_squares

    write_data(tmp_path, ("train",), lights=6, size=96)
    config = options(augmentation=Augmentation(noise=0.0, symmetries=True, clip=1e6), images=6, rescale=True)
    for position in range(4):
        sample = SceneDataset(tmp_path, "train", config).sample(SampleKey(0, 0, position))
        images, mask = sample.images.numpy().transpose(0, 2, 3, 1), sample.mask[0].numpy() > 0
        mask &= images.min((0, 3)) > 1e-2  # lit by all
        normals = sample.normals.numpy().transpose(1, 2, 0)
        estimate = least_squares(images, mask, sample.directions.numpy(), sample.intensities.numpy())
        assert mask.mean() > 0.1
        assert normal_mae(estimate.normals, normals, mask) < 1.0


# ---- The source of stored batches --------------------------------------------------------------------


def test_stored_batches_resume_and_do_not_depend_on_the_workers(folder: Path) -> None:
    dataset = SceneDataset(folder, "train", options())
    whole = list(islice(StoredScenes(dataset, batch=2).batches(0), 6))
    source = StoredScenes(dataset, batch=2, workers=2)
    resumed = list(islice(source.batches(4), 4))
    assert all(same(*pair) for pair in zip(whole[2:], resumed, strict=True))
    assert len(active_children()) == 2
    again = next(source.batches(2))  # another place: the first loader ends
    assert same(again, whole[1])
    assert len(active_children()) == 2
    source.close()
    source.close()
    assert not active_children()


def test_processes_share_every_batch(folder: Path) -> None:
    dataset = SceneDataset(folder, "train", options())
    whole = islice(StoredScenes(dataset, batch=4).batches(8), 3)
    parts = [islice(StoredScenes(dataset, batch=4, rank=rank, world=2).batches(8), 3) for rank in range(2)]
    for batch, *shares in zip(whole, *parts, strict=True):
        assert [len(share.images) for share in shares] == [2, 2]
        assert same(batch, Batch(*(torch.cat(tensors) for tensors in zip(*shares, strict=True))))
    with pytest.raises(InputError, match="batch_scenes 4 cannot be shared by 3 processes"):
        StoredScenes(dataset, batch=4, world=3)
    with pytest.raises(InputError, match="rank must be from 0 to 1"):
        StoredScenes(dataset, batch=4, rank=2, world=2)


def test_identity_tells_data_sets_apart(folder: Path, tmp_path: Path) -> None:
    source = StoredScenes(SceneDataset(folder, "train", options()), batch=2)
    assert (source.scenes, source.identity()["scenes"]) == (5, 5)
    write_data(tmp_path, ("train",) * 5 + ("val",), lights=6, size=32, seed=1)
    other = StoredScenes(SceneDataset(tmp_path, "train", options()), batch=2)
    assert other.identity()["data"] != source.identity()["data"]
    json.dumps(source.identity())


def test_stored_batches_hand_on_mistakes(tmp_path: Path) -> None:
    scenes = write_data(tmp_path, ("train", "train"), lights=4, size=16)
    path = tmp_path / scenes[1].file
    path.write_bytes(path.read_bytes()[:-100])
    source = StoredScenes(SceneDataset(tmp_path, "train", options(size=16)), batch=2, workers=1)
    assert "render it again" in str(next(source.batches(0)))
    source.close()


# --- cameras ---


@pytest.mark.parametrize("exposure", ["mean", "paper"])
def test_a_camera_changes_no_other_draw_of_a_sample(folder: Path, exposure: str) -> None:
    plain = Augmentation(exposure=exposure, noise=0.0, symmetries=True)
    recorded = replace(plain, sensor=SensorModel())
    first, second = (
        SceneDataset(folder, "train", options(augmentation=one, crop=16), cache=False).sample(SampleKey(1, 0, 3))
        for one in (plain, recorded)
    )
    assert not torch.equal(first.images, second.images)
    for name in ("mask", "normals", "directions", "intensities", "corner", "seed"):
        assert torch.equal(getattr(first, name), getattr(second, name)), name
    again = SceneDataset(folder, "train", options(augmentation=recorded, crop=16), cache=False)
    assert same(second, again.sample(SampleKey(1, 0, 3)))


# --- mixed light ---


def test_mixed_light_is_drawn_again_and_the_same_from_shards_and_cache(tmp_path: Path) -> None:
    write_stage(tmp_path)
    alone = SceneMix(environments=("constant",), environment=1.0, directional=0.0, lamp=0.0, area=0.0)
    config = options(augmentation=replace(PLAIN, mixed=alone), images=5, size=24)
    batch = SceneDataset(tmp_path, "train", config, cache=False).sample(SampleKey(1, 0, 0))
    expected = (1 + batch.normals[2]) / 4  # (1 + n_z) / 2 of the whole hemisphere, whose weights sum to 2
    inside = batch.mask[0] > 0
    assert torch.allclose(batch.images[:, :, inside], expected[inside].expand(5, 3, -1), rtol=0.02)
    assert batch.directions[:, 2].min() > 0.999
    assert torch.allclose(batch.intensities, torch.tensor(0.5), rtol=0.02), "as a lamp that lights what faces it alike"
    config = replace(config, augmentation=replace(PLAIN, mixed=SceneMix()))
    plain, cached = (SceneDataset(tmp_path, "train", config, cache=cache) for cache in (False, True))
    cached.sample(SampleKey(0, 0, 0))
    assert same(plain.sample(SampleKey(0, 0, 0)), cached.sample(SampleKey(0, 0, 0)))
    assert not torch.equal(plain.sample(SampleKey(0, 0, 0)).images, plain.sample(SampleKey(0, 1, 0)).images)


def test_mixed_light_needs_a_light_stage(folder: Path) -> None:
    config = options(augmentation=Augmentation(mixed=SceneMix()))
    with pytest.raises(InputError, match="6 lights are too few to mix light from, 128 are needed"):
        SceneDataset(folder, "train", config, cache=False)
    with pytest.raises(InputError, match="set biased and frontal to 0"):
        Augmentation(mixed=SceneMix(), biased=0.5)
