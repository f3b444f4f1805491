"""Two kinds of processor on one: today's, and the same held to the instructions of older ones, for the benchmarks.

Most desktops and laptops have AVX2 but neither AVX-512 nor bfloat16. Held to AVX2, a newer processor chooses the same
kernels as they do; it stays a faster one.
"""

import os
import platform
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

HERE, HELD = "this machine", "held to AVX2"
_HOLD = {"ONEDNN_MAX_CPU_ISA": "AVX2", "ATEN_CPU_CAPABILITY": "avx2", "MKL_ENABLE_INSTRUCTIONS": "AVX2"}
"""Read by oneDNN, PyTorch and MKL when a process loads them."""


def kinds() -> tuple[str, ...]:
    """Return the kinds there are to measure: one where the processor is not an x86, or has nothing beyond AVX2."""
    import torch

    newer = torch.backends.cpu.get_cpu_capability().startswith("AVX512")
    return (HERE, HELD) if newer else (HERE,)


@contextmanager
def hold(kind: str) -> Iterator[None]:
    """Let processes started inside be of a kind; this one, which has loaded its libraries, is not changed."""
    before = {name: os.environ.get(name) for name in _HOLD}
    if kind == HELD:
        os.environ.update(_HOLD)
    try:
        yield
    finally:
        for name, value in before.items():
            os.environ.pop(name, None)
            if value is not None:
                os.environ[name] = value


def processor() -> str:
    """Return the processor's name."""
    try:
        text = Path("/proc/cpuinfo").read_text(encoding="utf-8")
        return next(line.partition(":")[2].strip() for line in text.splitlines() if line.startswith("model name"))
    except (OSError, StopIteration):
        return platform.processor() or platform.machine()
