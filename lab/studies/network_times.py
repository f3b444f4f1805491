"""Print the processor time of normal networks on one object, beside the first one's.

    OMP_NUM_THREADS=1 python -m lab.studies.network_times nenet-plus frames

With `ONEDNN_MAX_CPU_ISA=AVX2 ATEN_CPU_CAPABILITY=avx2` before it the processor is held to AVX2. The networks have
random weights and true lights and take turns, so that other jobs disturb them alike. Only this thread is timed: on
more threads than one it tells too little.
"""

import argparse
import sys
import time

import numpy as np
import torch

from render.shared.config import to_plain
from sdps.core.precision import arithmetic
from sdps.data.augment import Augmentation
from sdps.inference.estimator import Estimator
from sdps.models.checkpoint import TrainedModel
from sdps.models.registry import create


def estimator(name: str, precision: str) -> Estimator:
    """Return a network with random weights, as `sdps infer` would use it."""
    network = create(name).eval().to(memory_format=torch.channels_last)
    model = TrainedModel(name, network, {}, {"config": {"augmentation": to_plain(Augmentation())}})
    return Estimator(lighting=None, normals=model, device=torch.device("cpu"), precision=precision)


def main() -> int:
    """Time the networks named and print a line for each."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="+", help="normal models of `sdps list models`")
    parser.add_argument("--images", type=int, default=96)
    parser.add_argument("--side", type=int, default=96, help="pixels")
    parser.add_argument("--rounds", type=int, default=3)
    args = parser.parse_args()
    rng = np.random.default_rng(0)
    images = rng.random((args.images, args.side, args.side, 3), dtype=np.float32)
    mask = np.ones((args.side, args.side), bool)
    lights = rng.normal(size=(args.images, 3)) + np.array([0.0, 0.0, 3.0])
    lights /= np.linalg.norm(lights, axis=1, keepdims=True)
    precision = arithmetic("auto").precision
    networks = {name: estimator(name, precision) for name in args.names}
    least = dict.fromkeys(networks, float("inf"))
    for _ in range(args.rounds):
        for name, network in networks.items():
            began = time.thread_time()
            network.estimate(images, mask, lights, np.ones(args.images))
            least[name] = min(least[name], time.thread_time() - began)
    sys.stdout.write(f"{precision}, {torch.backends.cpu.get_cpu_capability()}, {args.images} images\n")
    for name, seconds in least.items():
        sys.stdout.write(f"{name}: {seconds:.2f} s, {seconds / least[args.names[0]]:.2f}\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
