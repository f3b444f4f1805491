"""The training benchmark: that it measures what it says, on scenes that are real shards. No figure is asserted."""

import argparse
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from lab.bench import bench_train
from lab.bench.bench_scenes import ellipsoid, write_scenes
from lab.bench.bench_train import MUON, ONE_THREAD, OURS, PLAIN, BenchTrainConfig
from render.records.manifest import read_manifest
from render.records.shards import read_shard
from render.shared.errors import InputError
from render.shared.seeds import derive_seed

QUICK = BenchTrainConfig(models=("nenet",), seconds=1e-3, rounds=2, scenes=2, images=2, size=32)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("data")
    write_scenes(path, 2, size=32)
    return path


@pytest.fixture(autouse=True)
def one_thread() -> Iterator[None]:
    """Tiny steps on several threads wait for each other wherever other work runs beside."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


def test_scenes_are_whole_shards_and_seeded(folder: Path, tmp_path: Path) -> None:
    scenes = read_manifest(folder)
    shard = read_shard(folder / scenes[1].file, scenes[1])
    assert shard.images.shape == (64, 32, 32, 3)
    np.testing.assert_allclose(np.linalg.norm(shard.normals[shard.mask], axis=-1), 1.0, atol=1e-5)
    assert not shard.images[:, ~shard.mask].any()
    again = write_scenes(tmp_path, 2, size=32)
    assert again == scenes
    np.testing.assert_array_equal(read_shard(tmp_path / again[1].file).images, shard.images)
    assert write_scenes(tmp_path, 1, size=32, seed=1)[0].lights != scenes[0].lights


def test_normals_of_a_sphere_point_outwards() -> None:
    normals, mask = ellipsoid((64, 64), np.full(3, 0.9))
    places = (np.arange(64) + 0.5) / 32 - 1.0
    np.testing.assert_allclose(normals[..., 0][mask], (np.broadcast_to(places, (64, 64)) / 0.9)[mask], atol=1e-6)
    assert normals[3, 32, 1] > 0.9  # y is up
    assert (normals[mask][:, 2] > 0).all()


def test_every_way_is_measured_and_told(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bench_train.shutil, "which", lambda name: None)  # nothing is compiled in a test
    threads = torch.get_num_threads()
    found = bench_train.measure(QUICK, "nenet", folder)
    assert torch.get_num_threads() == threads
    named = set(found["ways"]) | set(found["skipped"])
    assert {PLAIN, OURS, MUON, "trainer, NCHW", "trainer, float32", "trainer, torch.compile", ONE_THREAD} == named
    assert found["skipped"]["trainer, torch.compile"] == "no C++ compiler"
    assert all(rate["least"] <= rate["median"] <= rate["most"] for rate in found["ways"].values())
    assert all(0.0 <= waited["share"] <= 1.0 for waited in found["waiting"].values())
    machine = {"processor": "one", "instructions": "AVX512", "threads": 1, "torch": "2", "load": None,
               "precision": "bfloat16", "reason": "it is faster",
               "matmul_gflops": {"float32": 50.0, "bfloat16": 100.0}}  # fmt: skip
    text = bench_train.table(
        {
            "kinds": {
                "here": {"machine": machine, "models": {"nenet": found | {"memory_mb": {PLAIN: 900.5, OURS: None}}}}
            }
        }
    )
    for part in (
        "(2.00x)",
        "| at least 2.7 |",
        "under 2%",
        "900.50 MB",
        "skipped: no C++ compiler",
        "2 images of 32x32",
    ):
        assert part in text, part


def test_a_variant_that_spoils_its_weights_is_left_out_and_told() -> None:
    def spoil() -> None:
        raise InputError("the loss became nan at step 2; lower learning_rate")

    ways = {PLAIN: int, OURS: int, "trainer, torch.compile": spoil}
    assert "nan" in bench_train._warm_up(ways)["trainer, torch.compile"]
    assert list(ways) == [PLAIN, OURS]
    with pytest.raises(InputError, match="nan"):
        bench_train._warm_up({OURS: spoil})


def test_both_loops_minimise_the_same(folder: Path, tmp_path: Path) -> None:
    batch = bench_train.first_batch(QUICK, "nenet", folder)
    settings = replace(bench_train.training(QUICK, "nenet"), precision="float32", channels_last=False)
    trainer = bench_train.make_trainer(settings, "nenet", folder, tmp_path)
    torch.manual_seed(derive_seed(QUICK.seed, "weights", "nenet"))  # the weights the stage drew
    step = bench_train.plain_loop("nenet", batch)
    first = step()
    assert trainer.take_step(batch, 0.5)["loss"] == pytest.approx(first, rel=1e-5)
    assert [step() for _ in range(4)][-1] < first


def test_memory_is_that_of_the_process(folder: Path) -> None:
    size = bench_train.peak_memory(QUICK, "nenet", folder, PLAIN)
    assert size is None or size > 50.0


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"models": ("lcnett",)}, "did you mean 'lcnet'"),
        ({"models": ("cnnps",)}, "name models for lights or normals"),
        ({"models": ()}, "at least one"),
        ({"seconds": 0.0}, "seconds must be positive"),
    ],
)
def test_bad_settings_are_refused(changes: dict, message: str) -> None:
    with pytest.raises(InputError, match=message):
        replace(QUICK, **changes)


def test_a_folder_without_data_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"manifest\.jsonl"):
        bench_train.measure(QUICK, "nenet", tmp_path)


def test_flags_follow_the_configuration() -> None:
    parser = argparse.ArgumentParser()
    bench_train.add_arguments(parser)
    args = parser.parse_args(["--models", "lcnet,psfcn", "--seconds", "3", "--out", "here"])
    assert (args.models, args.seconds, args.rounds, args.out) == (("lcnet", "psfcn"), 3.0, 3, Path("here"))
