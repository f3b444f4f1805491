"""Several processes that train one model, as `torchrun` starts them: gloo on CPUs, NCCL on GPUs."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Literal

import torch
from torch import distributed

from render.shared.errors import InputError
from sdps.core.precision import Arithmetic, arithmetic


@dataclass(frozen=True)
class Team:
    """This process among those that train together.

    Attributes:
        rank: Number of this process; 0 leads: it validates, logs and saves.
        world: Number of processes.
        device: Where this process computes.
    """

    rank: int
    world: int
    device: torch.device

    @property
    def leads(self) -> bool:
        """Whether this process writes files."""
        return self.rank == 0

    def agree(self, values: list[float]) -> list[float]:
        """Return the leader's values in every process."""
        if self.world == 1:
            return values
        tensor = torch.tensor(values, dtype=torch.float64, device=self.device)
        distributed.broadcast(tensor, 0)
        return tensor.tolist()

    def mean(self, values: dict[str, float]) -> dict[str, float]:
        """Return the means of the processes' values."""
        if self.world == 1:
            return values
        tensor = torch.tensor(list(values.values()), dtype=torch.float64, device=self.device)
        distributed.all_reduce(tensor)
        return dict(zip(values, (tensor / self.world).tolist(), strict=True))

    def same_arithmetic(self, precision: str) -> Arithmetic:
        """Resolve a precision as the leader does: a measurement need not come out alike in every process.

        Raises:
            InputError: an unknown precision.
        """
        own = arithmetic(precision, self.device)
        (half,) = self.agree([float(own.precision == "bfloat16")])
        agreed: Literal["float32", "bfloat16"] = "bfloat16" if half else "float32"
        return own if own.precision == agreed else replace(own, precision=agreed, reason="as the leading process")

    def wait(self) -> None:
        """Return once every process has come this far."""
        if self.world > 1:
            distributed.barrier()

    def any(self, flag: bool) -> bool:
        """Return whether the flag is set in any process."""
        return self.mean({"flag": float(flag)})["flag"] > 0.0


@contextmanager
def team(device: str | torch.device | None = None) -> Iterator[Team]:
    """Join the processes `torchrun` started, or stand alone.

    Args:
        device: Torch device; by default CUDA where there is one (each process its own), else CPU.

    Raises:
        InputError: more processes than GPUs, or torchrun may start processes again in a way that fails.
    """
    world = int(os.environ.get("WORLD_SIZE", "1"))
    local = int(os.environ.get("LOCAL_RANK", "0"))
    cuda = torch.cuda.is_available() if device is None else torch.device(device).type == "cuda"
    if world == 1:
        yield Team(0, 1, torch.device(device or ("cuda" if cuda else "cpu")))
        return
    if cuda and local >= torch.cuda.device_count():
        raise InputError(
            f"torchrun started process {local} of this machine, which has {torch.cuda.device_count()} GPUs"
        )
    own = torch.device("cuda", local) if cuda else torch.device("cpu")
    if distributed.is_initialized():  # the caller has a team already, for several runs
        yield Team(distributed.get_rank(), world, own)
        return
    if os.environ.get("TORCHELASTIC_USE_AGENT_STORE") == "True" and os.environ.get("TORCHELASTIC_MAX_RESTARTS") != "0":
        # Processes that are started again would find the addresses of those before them (pytorch issue 135712).
        raise InputError("torchrun --max-restarts: set TORCH_DISABLE_SHARE_RDZV_TCP_STORE=1, or restarts may hang")
    distributed.init_process_group("nccl" if cuda else "gloo")
    try:
        yield Team(distributed.get_rank(), world, own)
    finally:
        distributed.destroy_process_group()
