"""What a GPU must do as the CPU does: rendering, training, inference. `make test-gpu` runs them where there is one."""

import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from sdps_scenes import hemisphere_lights, shade, sphere_normals, write_data

from render.backend.variant import has_cuda_driver, works
from render.records.manifest import read_manifest
from render.records.shards import read_shard
from render.shared.imaging.sensor import SensorModel
from sdps.core.precision import arithmetic
from sdps.data.augment import Augmentation
from sdps.inference.estimator import Estimator
from sdps.inference.inference_config import InferenceConfig
from sdps.methods.parse import parse
from sdps.methods.pretrained import require
from sdps.methods.runner import Runner
from sdps.training.stage_factory import create_stage
from sdps.training.trainer import train
from sdps.training.training_config import LightingTraining, NormalTraining

pytestmark = pytest.mark.gpu
needs_torch = pytest.mark.skipif(not torch.cuda.is_available(), reason="torch sees no CUDA device")
COMMON = {"steps": 6, "batch_scenes": 2, "images": 4, "workers": 1, "validation_scenes": 2, "log_every": 1,
          "schedule": "constant", "halve_after": (), "precision": "float32"}  # fmt: skip


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("gpu") / "data"
    write_data(folder, ("train",) * 4 + ("val",) * 2)
    return folder


@pytest.mark.skipif(not has_cuda_driver() or not works("cuda_ad_rgb"), reason="no CUDA device with OptiX")
def test_both_variants_render_the_same(tmp_path: Path) -> None:
    """Pixel filters draw other samples on a GPU, so images agree up to noise, and ground truth up to rounding."""
    for variant in ("cuda_ad_rgb", "llvm_ad_rgb"):
        command = [sys.executable, "-m", "pipelines.cli", "regenerate", "--preset", "smoke", "--shapes", "sphere,bunny",
                   "--materials", "lambertian:0.5,chrome", "--out", str(tmp_path / variant),
                   "--set", "test.spp=64"]  # fmt: skip
        subprocess.run(command, check=True, env=os.environ | {"SDPS_VARIANT": variant})
    folders = [next((tmp_path / variant).rglob("manifest.jsonl")).parent for variant in ("cuda_ad_rgb", "llvm_ad_rgb")]
    for scene in read_manifest(folders[0]):
        gpu, cpu = (read_shard(folder / scene.file, scene) for folder in folders)
        both = gpu.mask & cpu.mask
        assert (gpu.mask ^ cpu.mask).mean() < 1e-3
        assert (gpu.normals * cpu.normals).sum(-1)[both].min() > 0.99
        bright = [shard.images[:, both].astype(np.float64).clip(0.0, 1.0).mean(axis=(1, 2)) for shard in (gpu, cpu)]
        np.testing.assert_allclose(*bright, rtol=0.02, atol=1e-3)


@needs_torch
@pytest.mark.parametrize("model", ["lcnet-soft", "psfcn"])
def test_training_takes_the_steps_of_the_cpu(data: Path, tmp_path: Path, model: str) -> None:
    settings = LightingTraining(**COMMON) if model == "lcnet-soft" else NormalTraining(**COMMON, lights="true")
    for device in ("cpu", "cuda"):
        train(create_stage(model, model, settings, {}), data, tmp_path / device, device=device)
    lines = [(tmp_path / device / "metrics.jsonl").read_text().splitlines() for device in ("cpu", "cuda")]
    losses = [[float(line.split('"loss": ')[1].split(",")[0]) for line in some if '"loss"' in line] for some in lines]
    np.testing.assert_allclose(*losses, rtol=5e-3)
    longer = replace(settings, steps=8)
    resumed = train(create_stage(model, model, longer, {}), data, tmp_path / "cpu", device="cuda")
    assert resumed.steps == 8  # begun on a CPU, gone on with on a GPU


@needs_torch
def test_auto_precision_trains_and_stays_finite(data: Path, tmp_path: Path) -> None:
    settings = NormalTraining(**(COMMON | {"precision": "auto", "optimiser": "muon"}), lights="true")
    result = train(create_stage("psfcn", "psfcn", settings, {}), data, tmp_path, device="cuda")
    assert all(np.isfinite(value) for value in result.metrics.values())
    assert arithmetic("auto", "cuda").device == "cuda"


@needs_torch
@pytest.mark.parametrize("model", ["lightset", "frames"])
def test_scenes_in_the_gpus_memory_are_trained_on(data: Path, tmp_path: Path, model: str) -> None:
    cameras = Augmentation(sensor=SensorModel(), noise=0.0)
    shared = COMMON | {"resident": True, "fewest_images": 2, "augmentation": cameras}
    config = NormalTraining(**shared, crop=32, lights="true")
    if model == "lightset":
        config = LightingTraining(**shared, size=64)
    result = train(create_stage(model, model, config, {}), data, tmp_path)
    assert result.steps == 6 and all(np.isfinite(value) for value in result.metrics.values())


@needs_torch
@pytest.mark.parametrize("method", ["sdps-plus", "lcnet+psfcn", "true+psfcn", "true+frames", "lightset+frames"])
def test_inference_gives_what_the_cpu_does(method: str) -> None:
    normals, mask = sphere_normals(96, radius=0.7)
    lights = hemisphere_lights(12, np.random.default_rng(0))
    images = shade(normals, lights)
    runner = Runner(parse(method, require), require, InferenceConfig(precision="float32"))
    found = []
    for device in ("cpu", "cuda"):
        models = {place: getattr(runner.estimator, place) for place in ("lighting", "normals")}
        for model in models.values():
            if model is not None:
                model.network.to(device)
        estimator = Estimator(**models, device=torch.device(device), **runner.config.options())
        given = (lights, np.ones(12)) if method.startswith("true") else ()
        found.append(estimator.estimate(images, mask, *given))
    gpu, cpu = found
    assert np.degrees(np.arccos((gpu.normals * cpu.normals).sum(-1)[mask].clip(-1, 1))).mean() < 0.1
    np.testing.assert_allclose(gpu.light_directions, cpu.light_directions, atol=2e-3)
