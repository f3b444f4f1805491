"""Which arithmetic networks compute in: measured where it has to be, decided once per process.

bfloat16 halves the work of processors that multiply it in hardware (AVX-512 BF16, AMX, GPUs from Ampere on) and is many
times slower than float32 on those that do not. So `auto` times a convolution in both, which takes less than half a
second, and takes bfloat16 only where it is clearly faster.
"""

import logging
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import Literal

import torch
from torch.nn import functional

from render.shared.errors import unknown

Precision = Literal["auto", "float32", "bfloat16"]
PRECISIONS: tuple[Precision, ...] = ("auto", "float32", "bfloat16")
"""What may be asked for; `auto` is resolved by `arithmetic`."""

_WORTHWHILE = 1.2
"""bfloat16 must be so many times as fast as float32: it costs digits, and a measurement may be off by some per cent."""
_ROUNDS = 5
_AMPERE = (8, 0)

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Arithmetic:
    """What networks compute in on a device.

    Attributes:
        precision: `float32`, or `bfloat16` for networks under autocast.
        device: Type of the device, `cpu` or `cuda`.
        reason: Why, in words.
    """

    precision: Literal["float32", "bfloat16"]
    device: str
    reason: str

    def autocast(self) -> torch.autocast:
        """Return the context that networks run in."""
        return torch.autocast(self.device, torch.bfloat16, enabled=self.precision == "bfloat16")

    def describe(self) -> str:
        """Return precision and reason in one line."""
        return f"{self.precision} on {self.device}: {self.reason}"


def arithmetic(precision: str = "auto", device: str | torch.device = "cpu") -> Arithmetic:
    """Resolve a precision on a device; the same answer for the whole process.

    Args:
        precision: One of `PRECISIONS`. bfloat16 where it is slow is obeyed, with one warning.
        device: Torch device.

    Raises:
        InputError: an unknown precision.
    """
    check_precision(precision)
    return _resolve(precision, torch.device(device).type)


def check_precision(precision: str) -> None:
    """Refuse a precision that does not exist.

    Raises:
        InputError: with the nearest name.
    """
    if precision not in PRECISIONS:
        raise unknown("precision", str(precision), PRECISIONS)


@cache
def _resolve(precision: str, device: str) -> Arithmetic:
    ratio, source = _speed(device)
    fast = ratio >= _WORTHWHILE
    said = f"bfloat16 is {ratio:.2g} times as fast as float32 here ({source})"
    if precision == "auto":
        return Arithmetic("bfloat16" if fast else "float32", device, said)
    if precision == "bfloat16" and not fast:
        _log.warning("precision bfloat16 was asked for, but %s; use auto or float32", said)
    return Arithmetic("bfloat16" if precision == "bfloat16" else "float32", device, f"asked for; {said}")


@cache
def _speed(device: str) -> tuple[float, str]:
    """Return how many times as fast bfloat16 is as float32, and who says so."""
    if device == "cuda":
        name, capability = torch.cuda.get_device_name(), torch.cuda.get_device_capability()
        ratio = 2.0 if capability >= _AMPERE else 0.5
        return ratio, f"{name}, compute capability {capability[0]}.{capability[1]}; by its kind, not measured"
    if device != "cpu":
        return 0.5, f"not tried on {device}"
    ratio = _measure_ratio(32)
    if ratio > 0.5:  # a larger one tells better, and takes seconds only where bfloat16 is slow
        ratio = _measure_ratio(64)
    return ratio, f"{torch.backends.cpu.get_cpu_capability()}, measured"


def _measure_ratio(side: int) -> float:
    """Return the least time of a step in float32 over the least in bfloat16, taken in turn."""
    with torch.inference_mode(False), torch.enable_grad():  # in any mode of the caller
        ways = {dtype: _convolution_step(dtype, side) for dtype in (torch.float32, torch.bfloat16)}
        least = dict.fromkeys(ways, float("inf"))
        for way in ways.values():
            way()  # kernels are made at their first use
        for _ in range(_ROUNDS):
            for dtype, way in ways.items():
                began = time.perf_counter()
                way()
                least[dtype] = min(least[dtype], time.perf_counter() - began)
    return least[torch.float32] / max(least[torch.bfloat16], 1e-9)


def _convolution_step(dtype: torch.dtype, side: int) -> Callable[[], object]:
    """Return a forward and backward pass through the kind of layer that all networks here are made of."""
    images = torch.ones(4, 64, side, side, dtype=dtype).to(memory_format=torch.channels_last).requires_grad_(True)
    weight = torch.ones(64, 64, 3, 3, dtype=dtype).to(memory_format=torch.channels_last).requires_grad_(True)
    return lambda: functional.conv2d(images, weight, padding=1).sum().backward()
