"""Run by a test in a process of its own: normals of an object that fills its frame, in tiles; print the peak memory.

Usage: python tests/support/large_memory.py SIDE TILE_MIB
"""

import json
import sys

import numpy as np
import torch
from sdps_scenes import hemisphere_lights

from lab.shared.memory import peak_bytes
from render.shared.config import to_plain
from sdps.data.augment import Augmentation
from sdps.inference import estimator as estimators
from sdps.models.checkpoint import TrainedModel
from sdps.models.registry import create


def main(side: int, mebibytes: int) -> None:
    """Estimate, and print one line of JSON."""
    torch.manual_seed(0)
    network = create("frames", width=8, blocks=1).eval().to(memory_format=torch.channels_last)
    model = TrainedModel("frames", network, {}, {"config": {"augmentation": to_plain(Augmentation())}})
    estimator = estimators.Estimator(lighting=None, normals=model, device=torch.device("cpu"), precision="float32")
    images = np.random.default_rng(0).random((4, side, side, 3), dtype=np.float32)
    lights = hemisphere_lights(4, np.random.default_rng(0))
    mask = np.ones((side, side), bool)
    estimator.estimate(images[:, :64, :64], mask[:64, :64], lights)  # loads and makes all kernels
    estimators.TILE_BYTES = mebibytes * 2**20
    before = peak_bytes()
    estimator.estimate(images, mask, lights)
    sys.stdout.write(json.dumps({"more_mib": (peak_bytes() - before) / 2**20}) + "\n")


if __name__ == "__main__":
    main(int(sys.argv[1]), int(sys.argv[2]))
