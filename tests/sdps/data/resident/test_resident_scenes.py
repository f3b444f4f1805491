"""Scenes in memory as a source of batches: the same ones again, folders that grow, refusals."""

import shutil
import time
from itertools import islice
from pathlib import Path

import pytest
import torch
from sdps_samples import options
from sdps_scenes import write_data

from render.shared.errors import InputError
from sdps.data.augment import Augmentation
from sdps.data.dataset import Batch
from sdps.data.resident import resident_scenes as resident
from sdps.data.resident.resident_scenes import ResidentScenes
from sdps.training.stages import NormalStage
from sdps.training.trainer import train
from sdps.training.training_config import NormalTraining

DEVICE = torch.device("cpu")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("data")
    write_data(path, ("train",) * 5 + ("val", "val"), lights=4, size=32)
    return path


def some(source: ResidentScenes, taken: int, count: int) -> list[Batch]:
    return list(islice(source.batches(taken), count))


def test_the_same_place_gives_the_same_batch_and_processes_share_it(folder: Path) -> None:
    sources = [ResidentScenes(folder, options(), batch=4, device=DEVICE, workers=1, rank=rank, world=world)
               for rank, world in ((0, 1), (0, 2), (1, 2))]  # fmt: skip
    try:
        whole, first, second = (some(source, 0, 3) for source in sources)
        again = some(sources[0], 8, 1)[0]
    finally:
        for source in sources:
            source.close()
    assert all(torch.equal(*pair) for pair in zip(whole[2], again, strict=True))
    assert len(whole[0].seed) == 4 and len(first[0].seed) == len(second[0].seed) == 2
    assert not torch.equal(whole[0].images, whole[1].images)


def test_a_folder_that_grows_is_trained_on_meanwhile(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(resident, "_LOOK_EVERY", 0.05)
    shutil.copytree(folder, tmp_path / "data")
    late = sorted((tmp_path / "data" / "shards").iterdir())[:2]
    for file in late:
        file.rename(tmp_path / file.name)
    with pytest.raises(InputError, match="2 of 5 shards"):
        ResidentScenes(tmp_path / "data", options(), batch=1, device=DEVICE)
    source = ResidentScenes(tmp_path / "data", options(), batch=1, device=DEVICE, growing=True)
    monkeypatch.setattr(resident, "_ENOUGH", 2)
    try:
        batches = source.batches(0)
        next(batches)
        for file in late:
            (tmp_path / file.name).rename(file)
        until = time.monotonic() + 60.0
        while source.held.count < 5 and time.monotonic() < until:
            time.sleep(0.05)
        assert source.held.count == 5
        next(batches)
    finally:
        source.close()


def test_scenes_that_do_not_fit_or_cannot_be_read_end_in_a_line(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shutil.copytree(folder, tmp_path / "data")
    shard = sorted((tmp_path / "data" / "shards").iterdir())[1]
    shard.write_bytes(shard.read_bytes()[:500])
    source = ResidentScenes(tmp_path / "data", options(), batch=2, device=DEVICE)
    try:
        assert isinstance(some(source, 0, 1)[0], InputError)
    finally:
        source.close()
    monkeypatch.setattr(resident, "free_memory", lambda _: 100_000)
    with pytest.raises(InputError, match="do not fit into the memory of cpu; lower batch_scenes"):
        ResidentScenes(folder, options(), batch=4, device=DEVICE)


def test_a_run_trains_on_scenes_in_memory_and_goes_on(folder: Path, tmp_path: Path) -> None:
    config = NormalTraining(
        steps=6, batch_scenes=2, images=4, fewest_images=2, size=32, crop=16, lights="true", log_every=1, workers=1,
        validation_scenes=2, resident=True, augmentation=Augmentation(symmetries=True),
    )  # fmt: skip
    result = train(NormalStage(config), folder, tmp_path)
    assert result.steps == 6 and result.metrics["val_normal_mae"] > 0.0
    with pytest.raises(InputError, match="fewest_images 2 needs resident: true"):
        NormalTraining(fewest_images=2)
