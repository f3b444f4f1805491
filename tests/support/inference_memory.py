"""Run by a test in a process of its own: estimate a scene made on demand, print the peak memory and the time.

Usage: python tests/support/inference_memory.py COUNT NORMALS [LIGHTING]
"""

import json
import sys
import time

import numpy as np
import torch
from sdps_scenes import hemisphere_lights, shade, sphere_normals

from lab.shared.memory import peak_bytes
from render.shared.config import to_plain
from sdps.data.augment import Augmentation
from sdps.inference.estimator import Estimator
from sdps.models.checkpoint import TrainedModel
from sdps.models.registry import create

SIDE = 256


class SphereSource:
    """Images of a sphere that are rendered when asked for."""

    def __init__(self, count: int) -> None:
        self.normals, self.mask = sphere_normals(SIDE, radius=1.1)
        self.lights = hemisphere_lights(count, np.random.default_rng(0))

    def __len__(self) -> int:
        return len(self.lights)

    def __getitem__(self, part: slice) -> np.ndarray:
        return shade(self.normals, self.lights[part])


def trained(name: str) -> TrainedModel:
    """Return a model with random weights."""
    network = create(name).eval().to(memory_format=torch.channels_last)
    return TrainedModel(name, network, {}, {"config": {"augmentation": to_plain(Augmentation())}})


def main(count: int, normals: str, lighting: str = "") -> None:
    torch.manual_seed(0)
    models = {"normals": normals, "lighting": lighting}
    loaded = {place: trained(name) if name else None for place, name in models.items()}
    estimator = Estimator(**loaded, device=torch.device("cpu"), precision="float32")
    source = SphereSource(count)
    began = time.perf_counter()
    before = peak_bytes()
    estimate = estimator.estimate(source, source.mask)
    result = {
        "before_mib": before / 2**20,
        "peak_mib": peak_bytes() / 2**20,
        "seconds": time.perf_counter() - began,
        "object_share": float(source.mask.mean()),
        "finite": bool(np.isfinite(estimate.normals).all()),
    }
    sys.stdout.write(json.dumps(result) + "\n")


if __name__ == "__main__":
    main(int(sys.argv[1]), *sys.argv[2:])
